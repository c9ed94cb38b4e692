// Analyses beside the simulation: the mechanism held still over a turn, natural modes, the steady cycle.
function analysedCases(result) {
  return asEntries(result.cases).filter(([, one]) => one && typeof one === "object" && !Array.isArray(one));
}

function finiteList(value) {
  return Array.isArray(value) && value.length > 0 && value.every((one) => one === null || Number.isFinite(one));
}

// ---- the kinetostatic turn ----
function turnQuantities(cases) {
  const found = new Map();
  for (const [, one] of cases) {
    const curve = one.curves || {};
    for (const [key, words, unitName] of [["force", "Force in", "N"], ["moment", "Moment in", "N m"], ["stress", "Stress in", "Pa"]]) {
      for (const [name, values] of asEntries(curve[key])) {
        if (finiteList(values)) found.set(`${key} ${name}`, { label: `${words} ${name}`, unit: unitName, of: (c) => ((c.curves || {})[key] || {})[name] });
      }
    }
    for (const [key, words, unitName] of [["shaking_force", "Force on the base", "N"], ["shaking_moment", "Moment on the base", "N m"]]) {
      for (const axis of ["x", "y", "z"]) {
        if (curve[key] && finiteList(curve[key][axis])) found.set(`${key} ${axis}`, { label: `${words}, ${axis}`, unit: unitName, of: (c) => ((c.curves || {})[key] || {})[axis] });
      }
    }
    for (const [key, words, unitName] of [["place", "Place", "mm"], ["angles", "Angle", "deg"]]) {
      for (const [name, vectors] of asEntries(curve[key])) {
        for (const axis of ["x", "y", "z"]) {
          if (vectors && finiteList(vectors[axis])) found.set(`${key} ${name} ${axis}`, { label: `${words} of ${name}, ${axis}`, unit: unitName, of: (c) => turnPoint(c, key, name, axis) });
        }
      }
    }
    if (finiteList(curve.holding)) found.set("holding", { label: "What the drive holds with", unit: "", of: (c) => (c.curves || {}).holding });
  }
  return found;
}

// A coordinate of a point at all positions, in mm, or an angle of its link there, in deg.
function turnPoint(one, key, name, axis) {
  const vectors = ((one.curves || {})[key] || {})[name], scale = key === "place" ? 1000 : 180 / Math.PI;
  return vectors && finiteList(vectors[axis]) ? vectors[axis].map((value) => (value === null ? null : value * scale)) : null;
}

// Where points go while the drive takes its positions, seen along the axis across which they move least.
function turnPaths(cases) {
  const names = [...new Set(cases.flatMap(([, one]) => asEntries((one.curves || {}).place).map(([name]) => name)))];
  if (!names.length) return null;
  const holder = make("div", { id: "turn-path" });
  const show = (name) => {
    const found = cases.map(([of, one], index) => ({ name: of, index, x: turnPoint(one, "place", name, "x"), y: turnPoint(one, "place", name, "y"), z: turnPoint(one, "place", name, "z") }))
      .filter((one) => one.x && one.y && one.z);
    const ranges = ["x", "y", "z"].map((axis) => finiteRange(found.flatMap((one) => one[axis]).filter((value) => value !== null)));
    const spread = ranges.map(([low, high]) => high - low);
    const across = spread[1] <= spread[2] ? "z" : "y";
    const up = ranges[across === "z" ? 2 : 1];
    const half = 0.54 * Math.max(spread[0], up[1] - up[0], 1e-9);
    const around = ([low, high]) => [(low + high) / 2 - half, (low + high) / 2 + half];
    const number = (values) => values.map((value) => (value === null ? NaN : value));
    const drawn = found.map((one) => ({ name: one.name, index: one.index, x: number(one.x), y: number(one[across]), class: `curve case-${one.index % 7}`, dash: caseDash(one.index) }));
    clear(holder).append(lineChart(drawn, `x of ${name}, mm`, `${across} of ${name}, mm`, `Path of ${name}, held still`,
      { width: 460, height: 454, xRange: around(ranges[0]), yRange: around(up) }), lineLegend(found.map((one) => [one.name, one.index])));
  };
  show(names[0]);
  return section("Paths of points", choice("Point", names.map((name) => [name, name]), names[0], show, { id: "turn-point" }), holder);
}

function turnPage(task) {
  const { result } = task;
  const cases = analysedCases(result);
  const quantities = turnQuantities(cases);
  const unitName = (result.units || {}).max_force_at === "m" ? "mm" : "deg";
  const factor = unitName === "mm" ? 1000 : DEGREES;
  const columns = [
    { label: "case", value: (row) => row.name }, { label: "joint", value: (row) => row.joint },
    { label: "largest force", unit: "N", loads: true, value: (row) => row.one.max_force },
    { label: "at", unit: unitName, value: (row) => row.one.max_force_at * factor },
    { label: "largest moment", unit: "N m", loads: true, value: (row) => row.one.max_moment },
    { label: "at", unit: unitName, value: (row) => row.one.max_moment_at * factor },
  ];
  const rows = cases.flatMap(([name, one]) => [...asEntries(one.joints), ["on the base", one.shaking]].filter(([, joint]) => joint && typeof joint === "object")
    .map(([joint, entry]) => ({ name, joint, one: entry })));
  const table = sortableTable("Largest loads of the mechanism held still", columns, rows, { id: "turn-loads" });
  if (!quantities.size) return [section("Held still over the range of the drive", table)];
  const holder = make("div", { id: "turn-curves" });
  const show = (key) => {
    const quantity = quantities.get(key);
    const unitText = quantity.unit || ((result.units || {}).holding === "N" ? "N" : "N m");
    const series = cases.map(([name, one], index) => ({ name, index, x: (one.curves || {}).position, y: quantity.of(one) }))
      .filter((one) => finiteList(one.x) && finiteList(one.y) && one.x.length === one.y.length)
      .map((one) => ({ ...one, x: one.x.map((value) => value * factor), y: one.y.map((value) => (value === null ? NaN : value)) }));
    const drawn = series.map((one) => ({ ...one, class: `curve case-${one.index % 7}`, dash: caseDash(one.index) }));
    clear(holder).append(lineChart(drawn, `position of the drive, ${unitName}`, unitText, `${quantity.label}, held still`, { width: 760, height: 320 }),
      lineLegend(series.map((one) => [one.name, one.index])));
  };
  const first = largestTurn(rows, quantities);
  show(first);
  const select = choice("Show", [...quantities].map(([key, one]) => [key, one.label]), first, show, { id: "turn-quantity" });
  return [section("Held still over the range of the drive", select, holder), turnPaths(cases), section("Largest loads", table)];
}

// The moment of the joint that has the largest one, else the first curve.
function largestTurn(rows, quantities) {
  const known = rows.filter((row) => quantities.has(`moment ${row.joint}`) && Number.isFinite(row.one.max_moment));
  known.sort((a, b) => b.one.max_moment - a.one.max_moment);
  return known.length ? `moment ${known[0].joint}` : quantities.keys().next().value;
}

function lineLegend(entries) {
  return make("div", { class: "legend" }, entries.map(([name, index]) => make("span", { class: "entry" },
    draw("svg", { viewBox: "0 0 30 8", width: 30, height: 8, "aria-hidden": "true" },
      draw("line", { x1: 0, x2: 30, y1: 4, y2: 4, class: `curve case-${index % 7}`, "stroke-dasharray": caseDash(index).join(" ") || null })), name)));
}

// ---- natural modes ----
function modesPage(task) {
  const { result } = task;
  const cases = analysedCases(result).filter(([, one]) => Array.isArray(one.modes) && one.modes.length);
  if (!cases.length) return null;
  const count = Math.max(...cases.map(([, one]) => one.modes.length));
  const rows = Array.from({ length: count }, (_, i) => i);
  const of = (c, i) => cases[c][1].modes[i] || {};
  const remark = (i) => (of(0, i).stable === false ? "unstable, or a free motion" : of(0, i).repeated ? "repeated" : "");
  const columns = [
    { label: "mode", value: (i) => i + 1 },
    ...cases.map(([name, one], c) => ({ label: hasFailed(one) ? `${name}*` : name, unit: "Hz", value: (i) => of(c, i).frequency })),
    { label: "damping ratio", value: (i) => of(0, i).damping_ratio }, { label: "remark", value: remark },
  ];
  const errors = Object.keys(of(0, 0).derivatives || {});
  const perUnit = (error) => (errorUnit(error) === "rad" ? [1 / DEGREES, "Hz/deg"] : [1e-3, "Hz/mm"]);
  const slopes = errors.map((error) => ({
    label: error, unit: perUnit(error)[1],
    value: (i) => { const found = (of(0, i).derivatives || {})[error]; return Number.isFinite(found) ? found * perUnit(error)[0] : null; },
    show: (value, i) => showBeside(value, of(0, i).frequency, 5),
  }));
  return [
    shapesSection(result, (i) => of(0, i).frequency),
    section("Natural frequencies", sortableTable("Natural frequencies about the assembled mechanism", columns, rows, { id: "frequencies" }),
      failedNote(cases.map(([name, one]) => ({ name, status: one.status }))),
      errors.length ? sortableTable(`Derivatives of the frequencies of ${cases[0][0]}`, [columns[0], ...slopes], rows) : null),
  ];
}

function readShapes(result) {
  const triples = (value) => Array.isArray(value) && value.every((one) => Array.isArray(one) && one.length === 3 && one.every(Number.isFinite));
  const links = asEntries((result.shapes || {}).links)
    .filter(([, one]) => one && triples(one.points) && Array.isArray(one.moves) && one.moves.every((move) => triples(move) && move.length === one.points.length))
    .map(([name, one]) => ({ name, ...one }));
  const count = Math.min(...links.map((one) => one.moves.length));
  return links.length && count > 0 ? { links, count, name: (result.shapes || {}).case } : null;
}

function shapesSection(result, frequency) {
  const shapes = readShapes(result);
  if (!shapes) return null;
  const view = new ModeView(shapes);
  const title = (i) => `mode ${i + 1}: ${showNumber(frequency(i), 5)} Hz`;
  const options = Array.from({ length: shapes.count }, (_, i) => [String(i), title(i)]);
  const select = choice("Mode", options, "0", (value) => view.choose(Number(value)), { id: "mode" });
  const sides = switcher("View", [["2", "from the side (x, z)"], ["1", "from above (x, y)"]], String(view.across), (value) => view.turn(Number(value)), { id: "mode-view" });
  view.sides = sides;
  view.choose(0);
  const play = make("button", { type: "button", class: "chip", id: "mode-play" }, "Play");
  play.addEventListener("click", () => { play.textContent = view.play(!view.playing) ? "Pause" : "Play"; });
  return section(`Modes${shapes.name ? ` of ${shapes.name}` : ""}`, make("div", { class: "controls" }, select, sides, play), view.element,
    make("p", { class: "hint" }, "Grey: at rest. The amplitude is arbitrary, the time slowed down."));
}

// Lines of the links at rest and swinging in one mode.
class ModeView {
  constructor(shapes) {
    Object.assign(this, { shapes, mode: 0, across: 2, phase: Math.PI / 2, playing: false, sides: null });
    this.element = chart(640, 360, "Shape of the mode", { id: "mode-shape" });
  }

  choose(mode) {
    this.mode = mode;
    const largest = (axis) => Math.max(...this.shapes.links.flatMap((one) => one.moves[mode].map((move) => Math.abs(move[axis]))));
    this.turn(largest(1) > Math.max(largest(0), largest(2)) ? 1 : 2);
  }

  turn(across) {
    this.across = across;
    if (this.sides) this.sides.querySelectorAll("button").forEach((one) => one.setAttribute("aria-pressed", String(one.dataset.value === String(across))));
    const all = this.shapes.links.flatMap((one) => one.points);
    const range = [0, 1, 2].map((axis) => finiteRange(all.map((point) => point[axis])));
    const size = Math.max(...range.map(([low, high]) => high - low)) || 1;
    const most = Math.max(1e-300, ...this.shapes.links.flatMap((one) => one.moves[this.mode].flat().map(Math.abs)));
    this.factor = (0.12 * size) / most;
    const spread = [0, across].map((axis) => range[axis][1] - range[axis][0] + 0.3 * size);
    const zoom = Math.min(600 / spread[0], 330 / spread[1]);
    const middle = [0, across].map((axis) => (range[axis][0] + range[axis][1]) / 2);
    this.place = (point, move, share) => {
      const at = (axis) => point[axis] + share * this.factor * move[axis];
      return `${(320 + zoom * (at(0) - middle[0])).toFixed(1)},${(180 - zoom * (at(across) - middle[1])).toFixed(1)}`;
    };
    clear(this.element).append(draw("title", {}, `Shape of mode ${this.mode + 1}`),
      ...this.shapes.links.map((one) => draw("polyline", { class: "span still", points: this.points(one, 0), fill: "none" })));
    this.moving = this.shapes.links.map((one, i) => {
      const line = draw("polyline", { class: "curve", points: "" }, draw("title", {}, one.name));
      this.element.append(line);
      return [line, i];
    });
    this.draw();
  }

  points(one, share) {
    return one.points.map((point, i) => this.place(point, one.moves[this.mode][i], share)).join(" ");
  }

  draw() {
    const share = Math.sin(this.phase);
    this.moving.forEach(([line, i]) => line.setAttribute("points", this.points(this.shapes.links[i], share)));
  }

  play(on) {
    this.playing = on;
    let last = null;
    const step = (now) => {
      if (!this.playing) return;
      if (last !== null && this.element.getClientRects().length) { this.phase += (now - last) / 320; this.draw(); }
      last = now;
      requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
    return on;
  }
}

// ---- the steady cycle ----
function cyclePage(task) {
  const { result } = task;
  const cases = analysedCases(result);
  if (!cases.length) return null;
  const columns = [
    { label: "case", value: (row) => row[0] }, { label: "repeats", value: (row) => (row[1].converged === true ? "yes" : "not yet") },
    { label: "revolutions simulated", value: (row) => row[1].revolutions }, { label: "largest change over the last one", value: (row) => row[1].residual },
  ];
  return [orbitSection(), rmsOfCycle(), section("How the cycle was found", sortableTable("Steady cycle of every case", columns, cases, { id: "cycles" }))];
}

function rmsOfCycle() {
  const rows = content.cases.flatMap((one) => one.joints.map((joint) => ({ name: one.name, joint })));
  if (!rows.length) return null;
  const columns = [
    { label: "case", value: (row) => shownCase(row.name) }, { label: "joint", value: (row) => row.joint.name },
    { label: "RMS force", unit: "N", loads: true, value: (row) => row.joint.rms_force }, { label: "RMS moment", unit: "N m", loads: true, value: (row) => row.joint.rms_moment },
  ];
  return section("Loads of one revolution", sortableTable("RMS of one revolution of the cycle", columns, rows, { id: "cycle-loads" }));
}

// Force of a joint as a closed curve across its axis: where on the bearing the load acts.
function orbitSection() {
  const names = curves ? [...new Set(content.cases.flatMap((one) => one.joints.map((joint) => joint.name)))].filter((name) => curves.loadOf(name, "force")) : [];
  if (!names.length) return null;
  const holder = make("div", { id: "orbit" });
  const show = (name) => {
    const quantity = curves.loadOf(name, "force");
    const found = content.cases.map((one, index) => ({ name: one.name, index })).filter((one) => curves.byCase.has(one.name))
      .map((one) => ({ ...one, x: Array.from(curves.values(one.name, quantity, 0)), y: Array.from(curves.values(one.name, quantity, 2)) }));
    const most = Math.max(1e-300, ...found.flatMap((one) => [...one.x, ...one.y].map(Math.abs)).filter(Number.isFinite)) * 1.08;
    const drawn = found.map((one) => ({ ...one, class: `curve case-${one.index % 7}`, dash: caseDash(one.index) }));
    clear(holder).append(lineChart(drawn, `force x of ${name}, N`, `force z of ${name}, N`, `Force in ${name} over one revolution`,
      { width: 460, height: 454, xRange: [-most, most], yRange: [-most, most] }), lineLegend(found.map((one) => [shownCase(one.name), one.index])));
  };
  show(names[0]);
  return section("Force of a joint over one revolution", choice("Joint", names.map((name) => [name, name]), names[0], show, { id: "orbit-joint" }), holder,
    make("p", { class: "hint" }, "In the frame of the joint, across its axis y: the direction is where the bearing is pressed."));
}
