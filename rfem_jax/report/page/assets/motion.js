// Where a case's mechanism is at a time: places of the perfect mechanism and exaggerated deviations from them.
class Motion {
  constructor(packed) {
    this.parts = Object.fromEntries(Object.entries(packed).map(([name, one]) => [name, unpack(one)]));
    this.times = this.parts.times.values;
  }

  get end() {
    return this.times[this.times.length - 1];
  }

  // The frame before a time, and the share of the way to the next one.
  seek(time) {
    const last = this.times.length - 1;
    let [low, high] = [0, last];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle;
      else high = middle;
    }
    const span = this.times[high] - this.times[low];
    return { low, high, share: span > 0 ? Math.min(Math.max((time - this.times[low]) / span, 0), 1) : 0 };
  }

  // The n numbers of item i of a part, interpolated; quaternions keep their sides together.
  read(name, i, n, at) {
    const { shape, values } = this.parts[name];
    const [a, b] = [(at.low * shape[1] + i) * n, (at.high * shape[1] + i) * n];
    let sign = 1;
    if (n === 4) {
      let product = 0;
      for (let k = 0; k < 4; k++) product += values[a + k] * values[b + k];
      sign = product < 0 ? -1 : 1;
    }
    const found = new Array(n);
    for (let k = 0; k < n; k++) found[k] = (1 - at.share) * values[a + k] + at.share * sign * values[b + k];
    return found;
  }

  nominalPoint(i, at) {
    return this.read("nominal", i, 3, at);
  }

  point(i, at, factor) {
    return plus(this.nominalPoint(i, at), this.read("deviation", i, 3, at), factor);
  }

  // Where the point of a path is.
  pathPoint(p, at, factor) {
    return plus(this.read("nominal_path", p, 3, at), this.read("deviation_path", p, 3, at), factor);
  }

  // All places of a path; kept, since they do not change with time.
  path(p, factor) {
    this.drawnPaths = this.drawnPaths || new Map();
    const key = `${p} ${factor}`;
    if (!this.drawnPaths.has(key)) {
      this.drawnPaths.set(key, Array.from(this.times, (_, i) => this.pathPoint(p, { low: i, high: i, share: 0 }, factor)));
    }
    return this.drawnPaths.get(key);
  }

  centre(j, at, factor) {
    return plus(this.read("nominal_centre", j, 3, at), this.read("deviation_centre", j, 3, at), factor);
  }

  // Axes of the frame that loads of a joint are in; `factor` exaggerates its deviation.
  axes(j, at, factor = 1) {
    const axes = axesOf(this.read("rotation", j, 4, at));
    if (factor === 1) return axes;
    const more = scaled(this.read("deviation_rotation", j, 3, at), factor - 1);
    const size = length(more);
    const turn = size > 1.2 ? scaled(more, 1.2 / size) : more;
    return axes.map((axis) => turnedBy(turn, axis));
  }

  seatAxes(j, at) {
    return axesOf(this.read("seat_rotation", j, 4, at));
  }

  boreAxes(j, at) {
    return axesOf(this.read("bore_rotation", j, 4, at));
  }

  // Every coordinate of the ends of springs at points, with the number of its axis.
  springEnds(visit) {
    const forces = content.animation.forces || [];
    for (const name of ["force_first", "force_place"]) {
      if (this.parts[name]) this.parts[name].values.forEach((value, i) => forces[Math.floor(i / 3) % forces.length].kind === "spring" && visit(value, i % 3));
    }
  }

  // The largest deviation [m], and a box around the perfect mechanism's motion.
  extent() {
    let largest = 0;
    const deviation = this.parts.deviation.values;
    for (let i = 0; i < deviation.length; i += 3) {
      const size = Math.hypot(deviation[i], deviation[i + 1], deviation[i + 2]);
      if (size > largest) largest = size;
    }
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (const name of ["nominal", "nominal_centre", "seat_centre", "nominal_path"]) {
      this.parts[name].values.forEach((value, i) => {
        if (value < low[i % 3]) low[i % 3] = value;
        if (value > high[i % 3]) high[i % 3] = value;
      });
    }
    this.springEnds((value, k) => {
      if (value < low[k]) low[k] = value;
      if (value > high[k]) high[k] = value;
    });
    return { largest, low, high };
  }
}

// Curves of the CSV files: values of a quantity in a case, by time.
class Curves {
  constructor(packed) {
    this.quantities = packed.quantities;
    this.byCase = new Map(packed.cases.map((one) => [one.case, { times: unpack(one.times).values, columns: unpackRows(one.values) }]));
  }

  // Values over time of one component (its number), or of the resultant (-1).
  values(name, quantity, part) {
    const found = this.byCase.get(name);
    if (!found) return null;
    const columns = quantity.columns.map((column) => found.columns[column]);
    if (columns.length === 1) return columns[0];
    if (part >= 0) return columns[part];
    return columns[0].map((_, i) => Math.hypot(...columns.map((column) => column[i])));
  }

  times(name) {
    const found = this.byCase.get(name);
    return found ? found.times : null;
  }

  loadOf(joint, load) {
    return this.quantities.find((one) => one.joint === joint && one.load === load);
  }
}

// A curve's value at a time, between its points on a line.
function valueAt(times, values, time) {
  let [low, high] = [0, times.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  const span = times[high] - times[low];
  const share = span > 0 ? Math.min(Math.max((time - times[low]) / span, 0), 1) : 0;
  return (1 - share) * values[low] + share * values[high];
}

const curves = content.histories ? new Curves(content.histories) : null;
const motions = content.animation ? content.animation.motions.map((one) => new Motion(one)) : [];
