// An allocation: tolerances before and after, cost against the limit, and what was verified.
function allocationPage(task) {
  const { result } = task;
  const before = (result.before || {}).tolerances || {};
  const rows = asEntries(result.tolerances).map(([name, after]) => ({ name, after }));
  if (!rows.length) return null;
  const columns = [
    { label: "error", value: (row) => row.name },
    { label: "tolerance before", value: (row) => before[row.name], show: (value, row) => showError(value, errorUnit(row.name)) },
    { label: "tolerance after", value: (row) => row.after, show: (value, row) => showError(value, errorUnit(row.name)) },
    { label: "at bound", value: (row) => (result.at_bounds || {})[row.name] || "" },
  ];
  const limits = Array.isArray(result.limits) ? result.limits : [];
  const limitColumns = [
    { label: "metric", value: (row) => row.metric }, { label: "unit", value: (row) => (row.unit === "1" ? "" : row.unit) },
    { label: "side", value: (row) => row.side }, { label: "nominal", value: (row) => row.nominal },
    { label: "limit", value: (row) => row.limit }, { label: "verified", value: (row) => row.verified },
  ];
  const costs = [`Cost ${showNumber(result.cost)}`];
  if (Number.isFinite((result.before || {}).cost)) costs.push(`before ${showNumber(result.before.cost)}`);
  const reached = result.verified_yield === null || result.verified_yield === undefined ? null : `verified yield ${showNumber(100 * result.verified_yield)} %`;
  return [
    section("The cheapest tolerances", make("p", {}, [...costs, result.criterion && String(result.criterion).replace(/_/g, " "), `status ${result.status}`, reached].filter(Boolean).join(", "), "."),
      sortableTable("Tolerances before and after (half-widths)", columns, rows, { id: "tolerances" }),
      limits.length ? sortableTable("Limits, and what was verified", limitColumns, limits) : null),
    frontSection(result, limits),
    historyOfCost(result),
  ];
}

function frontSection(result, limits) {
  const front = (Array.isArray(result.front) ? result.front : []).filter((one) => Number.isFinite(one.cost));
  if (front.length < 2) return null;
  const single = limits.length === 1;
  const x = front.map((one) => (single ? one.limits[0].limit : one.scale));
  const unitName = single && limits[0].unit !== "1" ? `, ${limits[0].unit}` : "";
  const title = single ? `limit on ${limits[0].metric}${unitName}` : "scale of all limits";
  const lines = Number.isFinite((result.before || {}).cost) ? [{ label: "tolerances before", value: result.before.cost }] : [];
  const cost = lineChart([{ x, y: front.map((one) => one.cost), mark: 0, name: "cost" }], title, "cost", "Cost against the limit", { points: true, lines });
  const names = Object.keys(result.tolerances || {});
  const share = names.map((name, i) => {
    const most = Math.max(...front.map((one) => one.tolerances[name]));
    return { x, y: front.map((one) => one.tolerances[name] / most), mark: i + 1, name };
  });
  const legend = names.map((name, i) => make("span", { class: "entry" },
    draw("svg", { viewBox: "0 0 16 16", width: 14, height: 14 }, caseMark(i + 1, 8, 8, 5)), name));
  return section("Cost against the limit", make("figure", {}, cost),
    make("figure", {}, make("figcaption", {}, "Tolerances that belong to each limit, as shares of the widest"),
      lineChart(share, title, "share of the widest", "Tolerances against the limit", { points: true }), make("div", { class: "legend" }, legend)));
}

function historyOfCost(result) {
  const rows = (Array.isArray(result.history) ? result.history : []).filter((one) => one && typeof one === "object" && !Array.isArray(one));
  if (rows.length < 2) return null;
  const keys = Object.keys(rows[0]).filter((key) => rows.some((row) => Number.isFinite(row[key])));
  const columns = [{ label: "round", value: (row) => rows.indexOf(row) + 1 }, ...keys.map((key) => ({ label: key.replace(/_/g, " "), value: (row) => row[key] }))];
  return section("Rounds of the search", sortableTable("How the answer was approached", columns, rows));
}

// A task of a kind that this page does not know: its plain values.
function unknownPage(task) {
  const rows = asEntries(task.result).filter(([, value]) => value === null || typeof value !== "object");
  const columns = [{ label: "name", value: (row) => row[0] }, { label: "value", value: (row) => row[1] }];
  return [section("Results", sortableTable(`Values of ${task.name}.json`, columns, rows))];
}
