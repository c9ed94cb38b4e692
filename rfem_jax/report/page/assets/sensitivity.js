// A sensitivity study: heat map of every error's effect on every metric, tornado chart of one metric.
function asEntries(value) {
  return value && typeof value === "object" && !Array.isArray(value) ? Object.entries(value) : [];
}

// Unit of a metric, "" where it has none.
function metricUnit(result, name) {
  const found = (result.units || {})[name];
  return !found || found === "1" ? "" : String(found);
}

function splitMetric(name) {
  const at = name.lastIndexOf(".");
  return at < 0 ? ["-", name] : [name.slice(0, at), name.slice(at + 1)];
}

function errorUnit(name) {
  return /(^|\.)(delta_[xyz]|pin_tilt_[xz]|twist)$/.test(name) ? "rad" : "m";
}

function sensitivityPage(task) {
  const { result } = task;
  const metrics = asEntries(result.metrics);
  const errors = Array.isArray(result.errors) ? result.errors : [];
  if (!metrics.length || !errors.length) return null;
  const kinds = new Map();
  metrics.forEach(([name, values]) => {
    const key = splitMetric(name)[1];
    kinds.set(key, [...(kinds.get(key) || []), [name, values]]);
  });
  const maps = [...kinds].map(([kind, entries]) => heatMap(kind, entries, errors, result));
  const holder = make("div", { id: "tornado" });
  const show = (name) => clear(holder).append(tornado(name, result.metrics[name], errors, result));
  show(metrics[0][0]);
  const select = choice("Metric", metrics.map(([name]) => [name, name]), metrics[0][0], show, { id: "tornado-metric" });
  return [
    section("Effect of each error alone", make("p", { class: "hint" }, "Largest change of a metric while one error is anywhere within its tolerance; the darker, the larger. Of a mean square the change of its root, the RMS value, is shown."), ...maps),
    section("Both ends of every tolerance", select, holder),
    contributionsSection(metrics, (one) => one.variance_total_percent, (one) => one.variance_linear_percent, result),
  ];
}

// Whether a metric is a square, whose root people think in: the name and the unit of the root, else null.
function rootOf(name, unitName) {
  const found = /^(.*\.)?(mean_square_(force|moment)|preload_(force|moment)_square)$/.exec(name);
  if (!found) return null;
  const root = found[2].replace("mean_square_", "rms_").replace("_square", "");
  return { name: `${found[1] || ""}${root}`, unit: unitName.replace(/^\((.*)\)\^2$/, "$1").replace(/\^2$/, "") };
}

// The change of the root of a value, by that of the value.
function rootChange(value, change) {
  return Math.sqrt(Math.max(value + change, 0)) - Math.sqrt(Math.max(value, 0));
}

// The value of a metric, 0 where it is rounding.
function startOf(one) {
  return one.character === "kink" ? 0 : one.value;
}

// Largest change of the root of a metric by each error: at the ends of its tolerance.
function rootEffects(one, errors, result) {
  const ends = new Map(endChanges(one, errors, result).map((row) => [row.error, row]));
  return errors.map((error) => {
    const row = ends.get(error);
    if (!Number.isFinite((one.effects || {})[error]) || !Number.isFinite(one.value)) return null;
    return Math.max(...[row.low, row.high].map((change) => Math.abs(rootChange(startOf(one), change))));
  });
}

// A factor of the scatter: an error, a group, or a zone of the drawing by its name.
function factorName(result, factor) {
  const zone = (result.zone_names || {})[factor];
  return zone ? String(zone) : factor.split("+").join(" + ");
}

// What every error and every zone contributes to the variance of each metric; by a second reading where there is no first.
function contributionsSection(metrics, total, linear, result) {
  const known = metrics.map(([name, one]) => {
    const finite = (parts) => asEntries(parts).some(([, part]) => Number.isFinite(part));
    const whole = finite(total(one));
    return [name, whole ? total(one) : finite(linear(one)) ? linear(one) : null, whole];
  }).filter(([, parts]) => parts);
  if (!known.length) return null;
  const factors = [...new Set(known.flatMap(([, parts]) => Object.keys(parts)))];
  const columns = [
    { label: "error or zone", value: (factor) => factorName(result, factor) },
    ...known.map(([name, parts, whole]) => ({
      label: name, unit: whole ? "%" : "% (gradients alone)", value: (factor) => numberOr(parts[factor], null), show: (value) => showBeside(value, 100, 3),
    })),
  ];
  const words = "Share of the variance of a metric that vanishes with an error, or with all errors of a zone; effects together with others count for each, so that a column may add up to more than 100 %.";
  return section("Contributions to the scatter", make("p", { class: "hint" }, words),
    heated(sortableTable("Contributions to the variance", columns, factors, { class: "tabled heat", id: "contributions" }), 100));
}

function toleranceText(result, error) {
  const width = (result.half_widths || {})[error];
  return typeof width === "number" ? `+-${showError(width, errorUnit(error))}` : "";
}

function heatMap(kind, entries, errors, result) {
  const squared = metricUnit(result, entries[0][0]);
  const root = rootOf(kind, squared);
  const unitName = root ? root.unit : squared;
  const effects = entries.map(([, one]) => (root ? rootEffects(one, errors, result) : errors.map((error) => (one.effects || {})[error])));
  const largest = Math.max(1e-300, ...effects.flat().filter(Number.isFinite));
  const title = `Change of ${(root ? root.name : kind).replace(/_/g, " ")}${unitName ? `, ${unitName}` : ""}`;
  const columns = [
    { label: "joint", value: (row) => row.joint },
    ...errors.map((error, i) => ({
      label: `${error} ${toleranceText(result, error)}`, value: (row) => row.effects && row.effects[i],
      show: (value) => (Number.isFinite(value) && value < 1e-6 * largest ? "0" : showNumber(value, 3)),
    })),
  ];
  const rows = entries.map(([name], i) => ({ joint: splitMetric(name)[0], effects: effects[i] }));
  return heated(sortableTable(title, columns, rows, { class: "tabled heat" }), largest);
}

// A table whose numbers are shaded, also after it was sorted; the first column has names.
function heated(table, largest) {
  const shade = () => table.querySelectorAll("tbody tr").forEach((line) => {
    [...line.cells].slice(1).forEach((cell) => {
      const share = Math.min(Math.max(Number(cell.textContent) / largest, 0), 1) || 0;
      cell.style.setProperty("--share", `${Math.round(100 * share)}%`);
      cell.classList.toggle("strong", share > 0.6);
    });
  });
  shade();
  table.addEventListener("click", shade);
  return table;
}

// Changes at the lower and the upper end of a tolerance by the quadratic model.
function endChanges(one, errors, result) {
  return errors.map((error, i) => {
    const width = numberOr((result.half_widths || {})[error], 0);
    const slope = numberOr((one.gradient || {})[error], 0) * width;
    const row = Array.isArray(one.hessian) && Array.isArray(one.hessian[i]) ? one.hessian[i] : [];
    const curved = 0.5 * numberOr(row[i], 0) * width * width;
    return { error, low: curved - slope, high: curved + slope };
  }).sort((a, b) => Math.max(Math.abs(b.low), Math.abs(b.high)) - Math.max(Math.abs(a.low), Math.abs(a.high)));
}

function tornado(name, one, errors, result) {
  const root = rootOf(name, metricUnit(result, name));
  const change = (by) => (root ? rootChange(startOf(one), by) : by);
  const rows = endChanges(one, errors, result).map((row) => ({ error: row.error, low: change(row.low), high: change(row.high) }));
  const unitName = root ? root.unit : metricUnit(result, name);
  const shown = root ? root.name : name;
  const [low, high] = finiteRange([0, ...rows.flatMap((row) => [row.low, row.high])]);
  const [width, step] = [640, 40];
  const room = roomForNames(errors, 0.4 * width);
  const left = room + 20;
  const bottom = rows.length * step + 12;
  const marks = ticks(low, high, 6);
  const x = scale(Math.min(low, marks[0]), Math.max(high, marks[marks.length - 1]), left, width - 30);
  const start = root ? Math.sqrt(Math.max(startOf(one), 0)) : startOf(one);
  const svg = chart(width, bottom + 44, `${shown} at both ends of every tolerance`);
  svg.append(axisBelow(x, bottom, marks, `change of ${shown} from ${withUnit(start, unitName)}${unitName ? `, ${unitName}` : ""}`, 4));
  rows.forEach((row, i) => {
    const y = 10 + i * step;
    svg.append(nameLabel(left - 10, y + 20, row.error, room));
    [["low", "lower"], ["high", "upper"]].forEach(([key, words], k) => {
      const [from, to] = [x(0), x(row[key])].sort((a, b) => a - b);
      const bar = draw("rect", { x: from, y: y + 14 * k, width: Math.max(to - from, 1), height: 13, class: `bar-${key}` },
        draw("title", {}, `${row.error}, ${words} end of the tolerance: ${withUnit(row[key], unitName)}`));
      svg.append(bar);
    });
  });
  svg.append(draw("line", { x1: x(0), x2: x(0), y1: 4, y2: bottom, class: "zero" }));
  const legend = make("p", { class: "legend" }, make("span", { class: "swatch low" }), " lower end ", make("span", { class: "swatch high" }), " upper end of the tolerance");
  return make("div", {}, svg, legend);
}
