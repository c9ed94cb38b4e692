// Worst cases: what was found, against all corners of the tolerances and the quadratic model.
function cornersPage(task) {
  const { result } = task;
  const metrics = asEntries(result.metrics);
  if (!metrics.length) return null;
  const errors = [...new Set(metrics.flatMap(([, one]) => Object.keys(one.errors || {})))];
  const columns = [
    { label: "metric", value: (row) => row.name }, { label: "unit", value: (row) => metricUnit(result, row.name || "") },
    { label: "status", value: (row) => row.one && row.one.status },
    { label: "worst found", value: (row) => row.one && row.one.value },
    { label: "nominal", value: (row) => row.one && row.one.nominal },
    { label: "quadratic model", value: (row) => row.one && row.one.quadratic_value },
    { label: "best corner", value: (row) => row.one && row.one.corners && row.one.corners.value },
    ...errors.map((error) => ({
      label: error, value: (row) => row.one && (row.one.errors || {})[error],
      show: (value) => showError(value, errorUnit(error)),
    })),
  ];
  const charts = metrics.filter(([, one]) => one.corners && Array.isArray(one.corners.values)).map(([name, one]) => {
    const values = one.corners.values.filter(Number.isFinite).sort((a, b) => a - b);
    const unitName = metricUnit(result, name);
    const lines = [["worst found", one.value], ["nominal", one.nominal]].filter((line) => Number.isFinite(line[1]))
      .map(([words, value]) => ({ label: `${words}: ${withUnit(value, unitName)}`, value }));
    const series = [{ x: values.map((_, i) => i + 1), y: values, mark: 2, class: "curve thin", name }];
    return make("figure", {}, make("figcaption", {}, name),
      lineChart(series, "corners of the tolerances, by value", unitName || "1", `${name} at the corners`, { points: values.length <= 128, lines }));
  });
  return [
    section("Worst cases within the tolerances", sortableTable("Worst case of every metric and the errors at it", columns, metrics.map(([name, one]) => ({ name, one })))),
    charts.length ? section("All corners", ...charts) : null,
  ];
}
