// An optimisation: dimensions and tolerances before and after, limits, the way of the search, the Pareto front. Tables of
// an allocation are the same.
function designRows(result) {
  const rows = asEntries(result.designs).map(([name, after]) =>
    ({ name, kind: "dimension", before: (result.initial || {})[name], after, bounds: (result.bounds || {})[name] }));
  const before = result.tolerances_before || (result.before || {}).tolerances || {};
  const widths = asEntries(result.tolerances).map(([name, after]) =>
    ({ name, kind: "tolerance", before: before[name], after, bounds: (result.tolerance_bounds || {})[name] }));
  return [...rows, ...widths].map((row) => ({ ...row, unit: String((result.units || {})[row.name] || "") }));
}

function beforeAndAfter(caption, rows, result, id) {
  const shown = (value, row) => (Number.isFinite(value) ? showError(value, row.unit) : "n/a");
  const kinds = new Set(rows.map((row) => row.kind)).size > 1 ? [{ label: "kind", value: (row) => row.kind }] : [];
  const columns = [
    { label: rows.every((row) => row.kind === "tolerance") ? "tolerance of" : "number", value: (row) => row.name }, ...kinds,
    { label: "before", value: (row) => row.before, show: shown }, { label: "after", value: (row) => row.after, show: shown },
    { label: "at bound", value: (row) => (result.at_bounds || {})[row.name] || (result.at_bounds || {})[`tolerance of ${row.name}`] || "" },
  ];
  return sortableTable(caption, columns, rows, { id });
}

const limitsOf = (result) => (Array.isArray(result.limits) ? result.limits : []);

function limitsTable(result, id) {
  const limits = limitsOf(result);
  const columns = [
    { label: "metric", value: (row) => row.metric }, { label: "unit", value: (row) => (row.unit === "1" ? "" : row.unit) },
    { label: "side", value: (row) => row.side }, { label: "limit", value: (row) => row.limit },
    { label: "perfect mechanism", value: (row) => row.nominal }, { label: "predicted", value: (row) => row.predicted },
    { label: "verified", value: (row) => row.verified },
    { label: "margin", value: (row) => (row.margin === undefined ? row.verified_margin : row.margin) },
    { label: "shadow price", title: "change of the objective if the limit is relaxed by one unit", value: (row) => row.shadow_price },
  ];
  return limits.length ? sortableTable("Limits, and what was verified", columns, limits, { id }) : null;
}

const statusText = (result) => [String(result.criterion || "").replace(/_/g, " "), `status ${result.status}`].filter(Boolean).join(", ");

const answerText = (said, result) => [make("p", {}, `${said.filter(Boolean).join(", ")}.`),
  result.message ? make("p", { class: "hint" }, String(result.message)) : null];

function optimisePage(task) {
  const { result } = task;
  const rows = designRows(result);
  if (!rows.length) return null;
  const terms = asEntries(result.terms).map(([name, value]) => `${name} ${showNumber(value)}`).join(", ");
  const said = [`Objective ${showNumber(result.objective)}${terms ? ` (${terms})` : ""}`, statusText(result)];
  return [
    section("The best design", ...answerText(said, result), boundsChart(rows), beforeAndAfter("Before and after", rows, result, "designs"),
      limitsTable(result, "design-limits")),
    searchSection(result, "objective", "search"), designFront(result),
  ];
}

// Every number between its bounds: before as an open mark, after as a filled one.
function boundsChart(rows) {
  const known = rows.filter((row) => Array.isArray(row.bounds) && row.bounds.every(Number.isFinite) && row.bounds[1] > row.bounds[0]);
  if (!known.length) return null;
  const nameOf = (row) => (row.kind === "tolerance" ? `${row.name} (tol.)` : row.name);
  const [width, step] = [640, 46];
  const room = roomForNames(rows.map(nameOf), 0.4 * width);
  const left = room + 24;
  const x = scale(0, 1, left, width - 90);
  const svg = chart(width, known.length * step + 10, "Numbers between their bounds, before and after", { id: "bounds" });
  known.forEach((row, i) => {
    const y = 30 + i * step;
    const at = (value) => x((value - row.bounds[0]) / (row.bounds[1] - row.bounds[0]));
    svg.append(nameLabel(left - 14, y + 4, nameOf(row), room),
      draw("line", { x1: x(0), x2: x(1), y1: y, y2: y, class: "span" }),
      label(x(0), y + 17, showError(row.bounds[0], row.unit), { "text-anchor": "start", class: "tick" }),
      label(x(1), y + 17, showError(row.bounds[1], row.unit), { "text-anchor": "end", class: "tick" }));
    [["before", 0], ["after", 1]].filter(([key]) => Number.isFinite(row[key])).forEach(([key, index]) => {
      const mark = caseMark(index, at(row[key]), y, 6);
      mark.append(draw("title", {}, `${row.name}, ${key}: ${showError(row[key], row.unit)}`));
      svg.append(mark);
    });
    if (Number.isFinite(row.after)) svg.append(label(at(row.after), y - 11, showError(row.after, row.unit), { "text-anchor": "middle", class: "tick" }));
  });
  return make("figure", {}, svg, caseLegend(["before", "after"]));
}

function caseLegend(names) {
  return make("div", { class: "legend" }, names.map((name, i) => make("span", { class: "entry" },
    draw("svg", { viewBox: "0 0 16 16", width: 14, height: 14 }, caseMark(i, 8, 8, 5)), name)));
}

// Objective or cost, and largest violation, of every solution of the search.
function searchSection(result, what, id) {
  const rows = (Array.isArray(result.history) ? result.history : []).filter((one) => Array.isArray(one) && one.length === 2 && one.every(Number.isFinite));
  if (rows.length < 2) return null;
  const x = rows.map((_, i) => i + 1);
  const draws = [[0, what, `${what[0].toUpperCase()}${what.slice(1)} of every solution`], [1, "largest constraint, normalised", "Largest constraint of every solution"]];
  const parts = draws.map(([place, words, title]) => {
    const lines = place === 1 ? [{ label: "kept below", value: 0 }] : [];
    return make("figure", {}, make("figcaption", {}, title),
      lineChart([{ x, y: rows.map((row) => row[place]), mark: place, name: words }], "solution", words, title, { points: rows.length <= 60, lines }));
  });
  return section("The way of the search", make("div", { class: "columns", id }, ...parts));
}

function designFront(result) {
  const front = (Array.isArray(result.front) ? result.front : []).filter((one) => one && one.terms && one.status === "ok");
  const names = front.length ? Object.keys(front[0].terms) : [];
  if (front.length < 2 || names.length !== 2) return null;
  const [first, second] = names;
  const series = [{ x: front.map((one) => one.terms[first]), y: front.map((one) => one.terms[second]), mark: 2, name: second }];
  const columns = [
    { label: `weight of ${second}`, value: (row) => row.weight }, ...names.map((name) => ({ label: name, value: (row) => row.terms[name] })),
    ...Object.keys(front[0].designs || {}).map((name) => ({
      label: name, value: (row) => (row.designs || {})[name], show: (value) => showError(value, String((result.units || {})[name] || "")),
    })),
  ];
  return section("What one costs of the other", make("figure", {}, lineChart(series, first, second, `${second} against ${first}`, { points: true })),
    sortableTable("Pareto front", columns, front, { id: "front" }));
}
