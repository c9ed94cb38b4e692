// A Monte Carlo study: statistics, histograms and a scatter plot from which samples are picked, yield over the samples.
function readSamples(packed) {
  const rows = unpackRows(packed.values);
  const status = unpack(packed.status).values;
  const good = [];
  status.forEach((one, i) => { if (one === 0) good.push(i); });
  const errors = packed.errors.map((one, i) => {
    const [unitName, factor] = asSpecified(one.unit);
    return { name: one.name, unit: unitName, error: true, values: rows[i].map((value) => factor * value) };
  });
  const metrics = packed.metrics.map((one, i) => ({ ...one, values: rows[errors.length + i] }));
  return { errors, metrics, columns: [...errors, ...metrics], good, number: unpack(packed.number).values, count: status.length, all: packed.all };
}

function columnTitle(column) {
  return column.unit ? `${column.name}, ${column.unit}` : column.name;
}

function samplesPage(task) {
  const { result } = task;
  const indices = (one, kind) => Object.fromEntries(asEntries(one[kind]).map(([factor, index]) => [factor, index && numberOr(100 * index.value, null)]));
  const parts = [section("Statistics", statisticsTable(result)),
    contributionsSection(asEntries(result.metrics), (one) => indices(one, "total_indices"), () => null, result)];
  const bands = bandSection(result);
  if (bands) parts.push(bands);
  const without = (words) => [...parts, section("Scatter and histograms of samples", make("p", { class: "hint", id: "no-samples" }, words))];
  if (!task.samples) return without("There is no scatter plot and no histogram: this folder has no monte_carlo.csv, or another file of that name.");
  const samples = readSamples(task.samples);
  if (!samples.good.length) return without("There is no scatter plot and no histogram: no sample is good.");
  if (!samples.columns.length) return without("There is no scatter plot and no histogram: monte_carlo.csv has neither errors nor metrics.");
  const picked = { chosen: new Set(), listeners: [] };
  const pick = (indices) => { picked.chosen = new Set(indices); picked.listeners.forEach((one) => one()); };
  parts.push(section("Scatter of samples",
    make("p", { class: "hint" }, `Drag over points, or over a histogram, to pick samples; their errors are listed below. Escape lets them go.${samples.count < samples.all ? ` Shown are ${samples.count} of ${samples.all} samples.` : ""}`),
    make("div", { class: "columns" }, scatterPlot(samples, result, picked, pick), histograms(samples, result, picked, pick)), pickedTable(samples, picked, pick)));
  const yields = yieldSection(samples, result);
  if (yields) parts.push(yields);
  return parts;
}

function interval(one) {
  if (!one || typeof one !== "object") return "n/a";
  if (one.low === null && one.high === null) return showNumber(one.value);
  if (one.low === null) return `${showNumber(one.value)} (up to ${showNumber(one.high)})`;
  if (one.high === null) return `${showNumber(one.value)} (from ${showNumber(one.low)})`;
  return `${showNumber(one.value)} (${showNumber(one.low)} to ${showNumber(one.high)})`;
}

function statisticsTable(result) {
  const metrics = asEntries(result.metrics);
  const quantiles = [...new Set(metrics.flatMap(([, one]) => Object.keys(one.quantiles || {})))];
  const value = (one) => one && one.value;
  const shown = (read) => ({ value: (row) => row.one && value(read(row.one)), show: (_, row) => interval(read(row.one)) });
  const columns = [
    { label: "metric", value: (row) => row.name },
    { label: "unit", value: (row) => metricUnit(result, row.name || "") },
    { label: "mean", ...shown((one) => one.mean) },
    { label: "standard deviation", ...shown((one) => one.std) },
    ...quantiles.map((q) => ({ label: `${showNumber(100 * Number(q), 3)} % quantile`, ...shown((one) => (one.quantiles || {})[q]) })),
    { label: "largest", value: (row) => row.one && row.one.largest },
    { label: "yield of all", ...shown((one) => one.yield_of_all) },
  ];
  const failures = asEntries(result.failures).map(([name, count]) => `${name}: ${count}`).join(", ");
  const words = `${result.samples} samples, ${result.good} of them good${failures ? ` (failed: ${failures})` : ""}; in brackets the ${showNumber(100 * result.confidence, 3)} % confidence intervals.`;
  const joint = result.joint_yield_of_all ? make("p", {}, `All limits together are kept by a share of ${interval(result.joint_yield_of_all)}.`) : null;
  const remark = result.remark ? make("p", {}, String(result.remark)) : null;
  return make("div", {}, make("p", { class: "hint" }, words), remark, joint,
    sortableTable("Statistics of the metrics", columns, metrics.map(([name, one]) => ({ name, one })), { id: "statistics" }));
}

// A plot on a canvas with a rectangle that picks: `inside(x0, x1, y0, y1)` in pixels.
function brushed(canvas, drawAll, inside) {
  let from = null;
  let to = null;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const redraw = () => {
    const context = fitCanvas(canvas);
    if (!context) return;
    drawAll(context, canvas.clientWidth, canvas.clientHeight);
    if (!from || !to) return;
    context.strokeStyle = palette.accent;
    context.setLineDash([4, 3]);
    context.strokeRect(Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]));
    context.setLineDash([]);
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); from = place(event); to = null; });
  canvas.addEventListener("pointermove", (event) => { if (from && event.buttons) { to = place(event); redraw(); } });
  canvas.addEventListener("pointerup", () => {
    if (from && to) inside(Math.min(from[0], to[0]), Math.max(from[0], to[0]), Math.min(from[1], to[1]), Math.max(from[1], to[1]));
    else inside(0, 0, 0, 0);
    from = null;
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  theme.listeners.push(redraw);
  return redraw;
}

function fitCanvas(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  if (!canvas.clientWidth) return null;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return context;
}

function axesOnCanvas(context, x, y, xs, ys, xTitle, yTitle, width, height) {
  context.font = "12px system-ui, sans-serif";
  context.lineWidth = 1;
  context.strokeStyle = palette.line;
  context.fillStyle = palette.quiet;
  context.textAlign = "center";
  const [below, beside] = [tickTexts(xs), tickTexts(ys)];
  xs.forEach((value, i) => {
    context.strokeRect(x(value), 14, 0, height - 58);
    context.fillText(below[i], x(value), height - 28);
  });
  context.textAlign = "right";
  ys.forEach((value, i) => {
    context.strokeRect(54, y(value), width - 66, 0);
    context.fillText(beside[i], 50, y(value) + 4);
  });
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText(xTitle, (54 + width - 12) / 2, height - 8);
  context.textAlign = "left";
  context.fillText(yTitle, 6, 10);
}

function hasLimits(result, column) {
  return Array.isArray(((result.metrics || {})[column.name] || {}).limits);
}

function scatterPlot(samples, result, picked, pick) {
  const canvas = make("canvas", { class: "scatter", id: "scatter", role: "img", "aria-label": "Scatter plot of samples" });
  const chosen = { x: 0, y: samples.errors.length };
  if (!samples.metrics.length) chosen.y = Math.min(1, samples.columns.length - 1);
  const limited = samples.columns.findIndex((one) => !one.error && hasLimits(result, one));
  if (limited >= 0) chosen.y = limited;
  let scales = null;
  const redraw = brushed(canvas, (context, width, height) => {
    const [a, b] = [samples.columns[chosen.x], samples.columns[chosen.y]];
    const ranges = [a, b].map((one) => finiteRange(samples.good.map((i) => one.values[i])));
    const x = scale(...ranges[0], 62, width - 20);
    const y = scale(...ranges[1], height - 50, 22);
    scales = { x, y };
    axesOnCanvas(context, x, y, ticks(...ranges[0], 5), ticks(...ranges[1], 5), columnTitle(a), columnTitle(b), width, height);
    const size = samples.good.length > 1500 ? 1.6 : 2.6;
    for (const on of [false, true]) {
      context.fillStyle = on ? palette.error : palette.accent;
      context.globalAlpha = on ? 1 : 0.55;
      for (const i of samples.good) {
        if (picked.chosen.has(i) !== on) continue;
        context.beginPath();
        context.arc(x(a.values[i]), y(b.values[i]), on ? size + 1 : size, 0, 2 * Math.PI);
        context.fill();
      }
    }
    context.globalAlpha = 1;
  }, (x0, x1, y0, y1) => {
    const [a, b] = [samples.columns[chosen.x].values, samples.columns[chosen.y].values];
    const within = (i) => scales.x(a[i]) >= x0 && scales.x(a[i]) <= x1 && scales.y(b[i]) >= y0 && scales.y(b[i]) <= y1;
    pick(x1 > x0 ? samples.good.filter(within) : []);
  });
  picked.listeners.push(redraw);
  const options = samples.columns.map((one, i) => [String(i), one.name]);
  const select = (axis) => choice(axis === "x" ? "Across" : "Up", options, String(chosen[axis]), (value) => { chosen[axis] = Number(value); redraw(); }, { id: `scatter-${axis}` });
  return make("div", { class: "scatter-frame" }, make("div", { class: "controls" }, select("x"), select("y")), canvas);
}

function histograms(samples, result, picked, pick) {
  const limited = samples.columns.findIndex((one) => !one.error && hasLimits(result, one));
  const chosen = { index: limited >= 0 ? limited : Math.min(samples.errors.length, samples.columns.length - 1) };
  const canvas = make("canvas", { class: "scatter", id: "histogram", role: "img", "aria-label": "Histogram of samples" });
  let x = null;
  const redraw = brushed(canvas, (context, width, height) => {
    const column = samples.columns[chosen.index];
    const values = samples.good.map((i) => column.values[i]);
    const [low, high] = finiteRange(values);
    const bins = Math.min(Math.max(Math.round(2 * Math.cbrt(values.length)), 5), 60);
    const counts = [new Array(bins).fill(0), new Array(bins).fill(0)];
    const binOf = (value) => Math.min(bins - 1, Math.floor(((value - low) / (high - low || 1)) * bins));
    samples.good.forEach((i) => {
      counts[0][binOf(column.values[i])] += 1;
      if (picked.chosen.has(i)) counts[1][binOf(column.values[i])] += 1;
    });
    const most = Math.max(...counts[0]);
    x = scale(low, high, 62, width - 20);
    const y = scale(0, most, height - 50, 22);
    axesOnCanvas(context, x, y, ticks(low, high, 5), ticks(0, most, 4), columnTitle(column), "samples", width, height);
    const wide = (x(high) - x(low)) / bins;
    [palette.accent, palette.error].forEach((colour, k) => {
      context.fillStyle = colour;
      context.globalAlpha = k ? 1 : 0.55;
      counts[k].forEach((count, i) => context.fillRect(x(low) + i * wide + 0.5, y(count), wide - 1, y(0) - y(count)));
    });
    context.globalAlpha = 1;
    drawMarks(context, x, height, histogramMarks(column, result));
  }, (x0, x1) => {
    const { values } = samples.columns[chosen.index];
    pick(x1 > x0 ? samples.good.filter((i) => x(values[i]) >= x0 && x(values[i]) <= x1) : []);
  });
  picked.listeners.push(redraw);
  const options = samples.columns.map((one, i) => [String(i), one.name]);
  const select = choice("Histogram of", options, String(chosen.index), (value) => { chosen.index = Number(value); redraw(); }, { id: "histogram-of" });
  return make("div", { class: "scatter-frame" }, make("div", { class: "controls" }, select), canvas);
}

// Mean, quantiles and limits of a metric, on its histogram.
function histogramMarks(column, result) {
  const one = column.error ? null : (result.metrics || {})[column.name];
  if (!one) return [];
  const marks = [["mean", one.mean && one.mean.value, []]];
  asEntries(one.quantiles).forEach(([q, estimate]) => marks.push([`${showNumber(100 * Number(q), 3)} %`, estimate.value, [4, 3]]));
  (one.limits || []).forEach((limit) => marks.push(["limit", limit, [9, 3], true]));
  return marks.filter((mark) => Number.isFinite(mark[1]));
}

function drawMarks(context, x, height, marks) {
  marks.forEach(([words, value, dash, limit], i) => {
    const at = x(value);
    stroke(context, [{ x: at, y: 22 }, { x: at, y: height - 50 }], { colour: limit ? palette.error : palette.ink, width: limit ? 2 : 1.2, dash });
    const right = at > context.canvas.clientWidth - 60;
    write(context, words, at + (right ? -4 : 4), 34 + 15 * (i % 5), limit ? palette.error : palette.ink, "11px system-ui, sans-serif", right ? "right" : "left");
  });
}

function pickedTable(samples, picked, pick) {
  const holder = make("div", { id: "picked" });
  const fill = () => {
    clear(holder);
    if (!picked.chosen.size) return;
    const columns = [
      { label: "sample", value: (i) => samples.number[i], digits: 8 },
      ...samples.columns.map((one) => ({ label: one.name, unit: one.unit, value: (i) => one.values[i] })),
    ];
    const rows = [...picked.chosen];
    const shown = rows.slice(0, 500);
    const text = `${rows.length} samples picked${rows.length > shown.length ? `, the first ${shown.length} shown` : ""}`;
    holder.append(make("button", { type: "button", class: "small", id: "let-go", onclick: () => pick([]) }, "Let go"), sortableTable(text, columns, shown));
  };
  picked.listeners.push(fill);
  document.addEventListener("keydown", (event) => { if (event.key === "Escape" && picked.chosen.size) pick([]); });
  return holder;
}

// Share of samples within limits against their number, with E. B. Wilson's interval of 95 % (1927).
function runningYield(samples, keeps) {
  const [x, y, low, high] = [[], [], [], []];
  let kept = 0;
  const every = Math.max(1, Math.floor(samples.count / 400));
  const good = new Set(samples.good);
  for (let i = 0; i < samples.count; i++) {
    if (good.has(i) && keeps(i)) kept += 1;
    const n = i + 1;
    if (n % every && n !== samples.count) continue;
    const [p, z] = [kept / n, 1.96];
    const middle = (p + (z * z) / (2 * n)) / (1 + (z * z) / n);
    const half = (z * Math.sqrt((p * (1 - p)) / n + (z * z) / (4 * n * n))) / (1 + (z * z) / n);
    x.push((n * samples.all) / samples.count);
    y.push(100 * p);
    low.push(100 * (middle - half));
    high.push(100 * (middle + half));
  }
  return { x, y, band: [low, high] };
}

function yieldSection(samples, result) {
  const limited = samples.metrics.filter((one) => hasLimits(result, one));
  if (!limited.length) return null;
  const within = (one) => {
    const [low, high] = result.metrics[one.name].limits;
    return (i) => (low === null || one.values[i] >= low) && (high === null || one.values[i] <= high);
  };
  const tests = limited.map((one) => [one.name, within(one)]);
  if (tests.length > 1) tests.unshift(["all limits together", (i) => limited.every((one) => within(one)(i))]);
  const holder = make("div", { id: "yield" });
  const show = (name) => {
    const run = runningYield(samples, tests.find((one) => one[0] === name)[1]);
    clear(holder).append(lineChart([run], "number of samples", "yield of all samples, %", `Yield against the number of samples: ${name}`),
      make("p", { class: "hint" }, `In the end ${showNumber(run.y[run.y.length - 1], 4)} %, by ${samples.all} samples; the band is the 95 % confidence interval.`));
  };
  show(tests[0][0]);
  return section("Convergence of the yield", choice("Limit", tests.map(([name]) => [name, name]), tests[0][0], show, { id: "yield-of" }), holder);
}
