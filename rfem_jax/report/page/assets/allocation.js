// An allocation: tolerances before and after, cost against the limit, and what was verified.
function allocationPage(task) {
  const { result } = task;
  const rows = designRows(result);
  if (!rows.length) return null;
  const { cost } = result.before || {};
  const share = result.verified_yield;
  const said = [`Cost ${showNumber(result.cost)}`, Number.isFinite(cost) ? `before ${showNumber(cost)}` : "", statusText(result),
    Number.isFinite(share) ? `verified yield ${showNumber(100 * share)} %` : ""];
  return [
    section("The cheapest tolerances", ...answerText(said, result),
      beforeAndAfter("Tolerances before and after (half-widths)", rows, result, "tolerances"), limitsTable(result, "allocation-limits")),
    frontSection(result, limitsOf(result)),
    searchSection(result, "cost", "allocation-search"),
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

// A task of a kind that this page does not know: its plain values.
function unknownPage(task) {
  const rows = asEntries(task.result).filter(([, value]) => value === null || typeof value !== "object");
  const columns = [{ label: "name", value: (row) => row[0] }, { label: "value", value: (row) => row[1] }];
  return [section("Results", sortableTable(`Values of ${task.name}.json`, columns, rows))];
}
