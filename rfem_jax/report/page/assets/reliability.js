// Rare failures: how probable it is that limits are broken, by which errors, and the most probable errors that do so.
function reliabilityPage(task) {
  const { result } = task;
  const limits = (Array.isArray(result.limits) ? result.limits : []).filter((one) => one && typeof one === "object");
  if (!limits.length) return null;
  const probability = (one) => one.probability || {};
  const columns = [
    { label: "metric", value: (row) => row.metric }, { label: "unit", value: (row) => (row.unit === "1" ? "" : row.unit) },
    { label: "side", value: (row) => row.side }, { label: "nominal", value: (row) => row.nominal }, { label: "limit", value: (row) => row.limit },
    { label: "broken with probability", value: (row) => probability(row).value, show: (_, row) => interval(row.probability) },
    { label: "check", title: "by subset simulation, which is independent of the most probable failures", value: (row) => (row.subset_simulation || {}).value, show: (_, row) => interval(row.subset_simulation) },
    { label: "FORM", title: "first-order estimate", value: (row) => row.first_order },
    { label: "reliability index", title: "distance of the most probable failure in standard deviations", value: (row) => row.beta },
    { label: "status", value: (row) => [String(row.status || "").replace(/_/g, " "), row.reason].filter(Boolean).join(": ") },
  ];
  const any = result.any_limit ? `Any limit is broken with a probability of ${interval(result.any_limit)}; in brackets the ${showNumber(100 * result.confidence, 3)} % confidence interval, by ${showNumber(result.samples)} samples where limits fail.` : "";
  const doubtful = limits.some((one) => one.status === "uncertain") ? " Where the status is uncertain, the interval is a hint only." : "";
  const reached = limits.filter((one) => Object.keys(one.errors || {}).length);
  return [
    section("Probabilities that limits are broken", make("p", {}, any + doubtful), sortableTable("Limits", columns, limits, { id: "failures" })),
    reached.length ? section("Which errors break the limits", sharesTable(reached), errorsTable(reached)) : null,
  ];
}

function limitWords(one) {
  const unitName = one.unit && one.unit !== "1" ? ` ${one.unit}` : "";
  return `${one.metric} ${one.side === "upper" ? "\u2264" : "\u2265"} ${showNumber(one.limit)}${unitName}`;
}

function namesIn(limits, part) {
  return [...new Set(limits.flatMap((one) => asEntries(one[part]).map(([name]) => name)))];
}

function sharesTable(limits) {
  const names = namesIn(limits, "shares");
  const columns = [
    { label: "limit", value: (row) => limitWords(row) },
    ...names.map((name) => ({ label: name, unit: "%", value: (row) => numberOr(100 * (row.shares || {})[name], null), show: (value) => showBeside(value, 100, 3) })),
  ];
  return heated(sortableTable("Parts of the squared distance to the most probable failure", columns, limits, { class: "tabled heat", id: "shares" }), 100);
}

function errorsTable(limits) {
  const largest = (row) => Math.max(...asEntries(row.errors).map(([, value]) => Math.abs(value)));
  const columns = [
    { label: "limit", value: (row) => limitWords(row) },
    ...namesIn(limits, "errors").map((name) => ({ label: name, value: (row) => (row.errors || {})[name], show: (value, row) => showError(Math.abs(value) < 2e-9 * largest(row) ? 0 : value, errorUnit(name)) })),
  ];
  return sortableTable("The most probable errors that break each limit", columns, limits, { id: "failing-errors" });
}
