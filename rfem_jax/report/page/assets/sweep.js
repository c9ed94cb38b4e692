// A sweep: metrics over each quantity with the response surface, over two quantities as a map, and how good the surface is.
function readPoints(packed) {
  const rows = unpackRows(packed.values);
  const status = unpack(packed.status).values;
  const quantities = packed.quantities.map((one, i) => {
    const [unitName, factor] = asSpecified(one.unit);
    return { ...one, unit: unitName, factor, values: Array.from(rows[i], (value) => Number((factor * value).toPrecision(7))) };
  });
  const metrics = packed.metrics.map((one, i) => ({ ...one, values: Array.from(rows[quantities.length + i], (value, row) => (status[row] === 0 ? value : NaN)) }));
  return { quantities, metrics, count: status.length, failed: status.filter((one) => one !== 0).length };
}

function sweepPage(task) {
  const { result } = task;
  const surface = surfaceTable(result);
  if (!task.points) return surface ? [section("Response surface", surface)] : null;
  const points = readPoints(task.points);
  if (!points.quantities.length || !points.metrics.length) return null;
  const places = make("div", { id: "sweep-responses", class: "charts" });
  const map = make("div", { id: "sweep-map" });
  const last = Math.min(1, points.quantities.length - 1);
  const chosen = { metric: 0, x: 0, y: last };
  const show = () => {
    const metric = points.metrics[chosen.metric];
    clear(places).append(...points.quantities.map((quantity) => responseChart(result, metric, quantity, points)));
    if (last) clear(map).append(mapChart(metric, points.quantities[chosen.x], points.quantities[chosen.y]));
  };
  const numbered = (columns) => columns.map((one, i) => [String(i), one.name]);
  const choose = (words, columns, key) => choice(words, numbered(columns), String(chosen[key]), (value) => { chosen[key] = Number(value); show(); }, { id: `sweep-${key}` });
  show();
  const fixed = asEntries((result.task || {}).at).map(([name, value]) => `${name} ${showError(value, errorUnit(name))}`).join(", ");
  const words = `${points.count} points, ${points.failed} of them failed${fixed ? `; with ${fixed}` : ""}. Quantities are changes from the description. Circles: points; curve: the quadratic surface with the other quantities in the middle.`;
  return [
    section("Responses", make("p", { class: "hint" }, words), choose("Show", points.metrics, "metric"), places),
    last ? section("Map over two quantities", make("div", { class: "controls" }, choose("Across", points.quantities, "x"), choose("Up", points.quantities, "y")), map) : null,
    surface ? section("Response surface", surface) : null,
  ];
}

// Value of the quadratic surface of a metric where one quantity (in its SI unit) is given and the others are in the middle.
function surfaceAt(surface, fit, name, value) {
  const names = Object.keys(surface.middle);
  const away = value - surface.middle[name];
  const at = names.indexOf(name);
  return fit.value + fit.gradient[name] * away + 0.5 * fit.hessian[at][at] * away * away;
}

function responseChart(result, metric, quantity, points) {
  const [low, high] = finiteRange(quantity.values);
  const series = [{ x: quantity.values, y: metric.values, marks: true, name: metric.name }];
  const fit = (((result.surface || {}).metrics || {})[metric.name]) || null;
  if (fit && result.surface.middle) {
    const x = Array.from({ length: 41 }, (_, i) => low + ((high - low) * i) / 40);
    series.push({ x, y: x.map((one) => surfaceAt(result.surface, fit, quantity.name, one / quantity.factor)), class: "curve" });
  }
  const title = columnTitle(quantity);
  return make("figure", {}, lineChart(series, title, metric.unit || metric.name, `${metric.name} over ${title}`, { width: 420, height: 280 }));
}

// Cells of a grid, else marks, shaded by the metric; where other quantities vary too, by its mean.
function mapChart(metric, across, up) {
  const width = 520;
  const height = 380;
  const svg = chart(width, height, `${metric.name} over ${columnTitle(across)} and ${columnTitle(up)}`);
  const cells = new Map();
  metric.values.forEach((value, i) => {
    const key = `${across.values[i]} ${up.values[i]}`;
    const cell = cells.get(key) || { x: across.values[i], y: up.values[i], values: [] };
    if (Number.isFinite(value)) cell.values.push(value);
    cells.set(key, cell);
  });
  const known = [...cells.values()].map((one) => ({ ...one, value: one.values.length ? one.values.reduce((a, b) => a + b) / one.values.length : NaN }));
  const [low, high] = finiteRange(known.map((one) => one.value).filter(Number.isFinite));
  const columns = [...new Set(across.values)].sort((a, b) => a - b);
  const rows = [...new Set(up.values)].sort((a, b) => a - b);
  const grid = columns.length * rows.length === cells.size && cells.size > 1;
  const margin = (values) => (grid ? 0.5 * (values[values.length - 1] - values[0]) / Math.max(values.length - 1, 1) : 0.02 * (values[values.length - 1] - values[0]));
  const [dx, dy] = [margin(columns), margin(rows)];
  const x = scale(columns[0] - dx, columns[columns.length - 1] + dx, 62, width - 20);
  const y = scale(rows[0] - dy, rows[rows.length - 1] + dy, height - 46, 24);
  for (const one of known) {
    const failed = !Number.isFinite(one.value);
    const share = failed ? 0 : (one.value - low) / (high - low || 1);
    const box = { x: x(one.x - dx), y: y(one.y + dy), width: x(one.x + dx) - x(one.x - dx), height: y(one.y - dy) - y(one.y + dy) };
    const mark = grid ? draw("rect", { ...box, class: failed ? "cell failed" : "cell" }) : draw("circle", { cx: x(one.x), cy: y(one.y), r: 6, class: failed ? "cell failed" : "cell" });
    mark.style.setProperty("--share", `${Math.round(8 + 92 * share)}%`);
    mark.append(draw("title", {}, `${failed ? "failed" : withUnit(one.value, metric.unit)} at ${showNumber(one.x)}, ${showNumber(one.y)}`));
    svg.append(mark);
  }
  svg.append(axisBelow(x, height - 42, ticks(columns[0], columns[columns.length - 1], 5), columnTitle(across)),
    axisLeft(56, y, ticks(rows[0], rows[rows.length - 1], 5), columnTitle(up), null, 14));
  const mean = known.some((one) => one.values.length > 1) ? "means over the other quantities, " : "";
  const words = `${metric.name}: ${mean}pale ${withUnit(low, metric.unit)}, dark ${withUnit(high, metric.unit)}${known.some((one) => !one.values.length) ? "; dashed: failed" : ""}`;
  return make("figure", {}, make("figcaption", {}, words), svg);
}

function surfaceTable(result) {
  const fits = asEntries((result.surface || {}).metrics);
  if (!fits.length) return result.surface_note ? make("p", { class: "hint" }, String(result.surface_note)) : null;
  const columns = [
    { label: "metric", value: (row) => row.name }, { label: "unit", value: (row) => metricUnit(result, row.name || "") },
    { label: "in the middle", value: (row) => row.one && row.one.value },
    { label: "explained, %", title: "of the variance of the points", value: (row) => row.one && 100 * row.one.explained },
    { label: "residual", title: "root mean square at the points", value: (row) => row.one && row.one.residual },
    { label: "error at points left out", title: "root mean square of the cross-validation", value: (row) => row.one && row.one.cross_validated_error },
  ];
  return sortableTable(`A quadratic surface through ${result.surface.samples} points`, columns, fits.map(([name, one]) => ({ name, one })), { id: "surface" });
}
