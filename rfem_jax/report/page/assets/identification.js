// Identification: errors with intervals beside tolerances, what is known of them together, what a correction does, how signals
// are fitted, curves before and after, what signals can tell.
function identificationPage(task) {
  const { result } = task;
  const errors = (Array.isArray(result.errors) ? result.errors : []).filter((one) => one && typeof one === "object");
  if (!errors.length) return null;
  if (Array.isArray(result.machines)) return productionPage(result, errors);
  const curves = (Array.isArray(result.curves) ? result.curves : []).filter((one) => one && Array.isArray(one.times));
  const status = `Status ${String(result.status).replace(/_/g, " ")}${result.message ? `: ${result.message.replaceAll("`", "")}` : ""}.`;
  return [
    section(result.estimate ? "Errors found" : "What measurements would tell of the errors", make("p", { id: "identification-status" }, status), foundTable(errors, result)),
    (result.modes || []).length > 1 ? section("Sets of errors that explain the data", modesTable(result, errors)) : null,
    curves.length ? section("Measured and simulated signals", make("p", { class: "hint" }, "Dots: measured; dashed: simulated with what was known before; curve: with the errors found."),
      make("div", { id: "identification-curves", class: "charts" }, curves.map(signalChart))) : null,
    (result.samples || []).length && errors.length > 1 ? posteriorSection(result.samples, errors) : null,
    result.correction ? correctionSection(result.correction) : null,
    (result.signals || []).length ? section("How the signals are fitted", fitTable(result.signals)) : null,
    (result.divisions || []).length ? section("Whether the model is fine enough", divisionTable(result.divisions, errors)) : null,
    (result.suspects || []).length ? section("What may be behind the misfit", suspectTable(result.suspects)) : null,
    result.visibility ? visibilitySection(result.visibility, errors) : null,
    (result.experiments || []).length ? experimentSection(result.experiments, errors) : null,
  ];
}

function divisionTable(divisions, errors) {
  const words = { rfes: "rfes of links", step: "the method's step", save_every: "saved times" };
  const numbers = (of) => Object.entries(of || {}).map(([link, n]) => (link ? `${showNumber(n, 4)} in ${link}` : `${showNumber(n, 3)} s`)).join(", ");
  const columns = [
    { label: "division", value: (row) => words[row.what] || row.what }, { label: "is", value: (row) => numbers(row.now) }, { label: "would do", value: (row) => (row.failed ? "\u2013" : numbers(row.wanted)) },
    ...errors.map((one, i) => ({ label: one.error, title: "by how many standard deviations it would move on an infinitely fine model", value: (row) => (row.failed ? null : row.deviations[i]), show: (value) => (typeof value === "number" ? showNumber(value, 2) : "\u2013") })),
    { label: "verdict", value: (row) => (row.failed ? `not known: ${row.failed}` : row.coarse ? "too coarse" : "fine enough") },
  ];
  return sortableTable("How far errors would move, in standard deviations, were it divided without end", columns, divisions, { id: "divisions" });
}

function suspectTable(suspects) {
  const inUnit = (value, row) => (row.unit === "rad" || row.unit === "m" ? showError(value, row.unit) : `${showNumber(value, 3)} ${row.unit}`);
  const columns = [
    { label: "no unknown", value: (row) => row.name }, { label: "would be", value: (row) => row.value, show: inUnit }, { label: "deviation", value: (row) => row.deviation, show: inUnit },
    { label: "\u03c7\u00b2 falls by", value: (row) => row.fall, show: (value) => showNumber(value, 3) }, { label: "of the misfit", unit: "%", value: (row) => 100 * row.share, show: (value) => showNumber(value, 3) },
    { label: "verdict", value: (row) => (row.named ? (row.fits ? "explains it" : "explains most") : "does not explain it") },
  ];
  return sortableTable("Errors, parameters and faults of sensors that are no unknowns", columns, suspects, { id: "suspects" });
}

function experimentSection(experiments, errors) {
  const last = (values) => values[values.length - 1];
  const columns = [
    { label: "experiment", value: (row) => row.name }, { label: "measured", unit: "s", value: (row) => last(row.lengths), show: (value) => showNumber(value, 3) },
    { label: "information", unit: "nat", value: (row) => last(row.gain), show: (value) => showNumber(value, 3) }, { label: "variance left", unit: "%", value: (row) => 100 * last(row.rest), show: (value) => showNumber(value, 3) },
    ...errors.map((one, i) => ({ label: one.error, value: (row) => last(row.deviations)[i], show: (value) => showNumber(value, 3) })),
  ];
  const lines = [["line", []], ["dashes", [7, 4]], ["dots", [2, 3]], ["dashes and dots", [9, 3, 2, 3]]];
  const words = errors.map((error, i) => `${error.error} (${lines[i % lines.length][0]})`).join(", ");
  const left = (one, i) => one.deviations.map((row) => Math.log10(numberOr(row[i], NaN)));
  const lowest = Math.min(0, ...experiments.flatMap((one) => errors.flatMap((error, i) => left(one, i).filter(Number.isFinite))));
  const chart = (one) => make("figure", {}, lineChart(errors.map((error, i) => ({ x: one.lengths.map((value) => numberOr(value, NaN)), y: left(one, i), dash: lines[i % lines.length][1] })),
    "measured time, s", "log10 of deviation left", `Deviations left after experiment ${one.name}`, { width: 560, height: 300, yRange: [lowest - 0.1, 0.05] }), make("figcaption", {}, `${one.name}: ${words}`));
  const told = experiments.filter((one) => typeof last(one.gain) === "number");
  return section("Which experiment, and how long", make("p", { class: "hint" }, "Deviations are expected after the measurement, in those known before."),
    sortableTable("Experiments at their whole length", columns, experiments, { id: "experiments" }), make("div", { id: "experiment-lengths", class: "charts" }, told.map(chart)));
}

function foundTable(errors, result) {
  const inUnit = (key) => ({ value: (row) => row[key], show: (value, row) => (typeof value === "number" ? showError(value, row.unit) : "\u2013") });
  const width = (row) => (typeof row.tolerance_high === "number" ? 0.5 * (row.tolerance_high - row.tolerance_low) : null);
  const found = [
    { label: "estimate", ...inUnit("estimate") }, { label: "deviation", title: "standard deviation after the measurement", ...inUnit("deviation") },
    { label: `${showNumber(100 * result.confidence, 3)} % interval from`, ...inUnit("low") }, { label: "to", ...inUnit("high") },
    { label: "known before to", title: "standard deviation before the measurement", ...inUnit("prior_deviation") },
    { label: "tolerance \u00b1", value: width, show: (value, row) => (value === null ? "\u2013" : showError(value, row.unit)) },
    { label: "beyond it", unit: "%", value: (row) => (typeof row.beyond_tolerance === "number" ? 100 * row.beyond_tolerance : null), show: (value) => (value === null ? "\u2013" : showNumber(value < 1e-4 ? 0 : value, 3)) },
  ];
  const expected = [{ label: "deviation before", ...inUnit("prior_deviation") }, { label: "deviation after", ...inUnit("expected_deviation") }];
  return sortableTable("Errors", [{ label: "error", value: (row) => row.error }, ...(result.estimate ? found : expected)], errors, { id: "identified-errors" });
}

function modesTable(result, errors) {
  const columns = [
    { label: "probability", value: (row) => row.probability, show: (value) => showNumber(value, 3) },
    ...errors.map((one, i) => ({ label: one.error, value: (row) => row.errors[i], show: (value) => showError(value, one.unit) })),
  ];
  return sortableTable("Sets of errors", columns, result.modes, { id: "identified-modes" });
}

// Several machines: the distribution of their errors, the lines of a study that say the same, and every machine.
function productionPage(result, errors) {
  const inUnit = (key) => ({ value: (row) => row[key], show: (value, row) => (typeof value === "number" ? showError(value, row.unit) : "\u2013") });
  const range = `${showNumber(100 * result.confidence, 3)} % interval`;
  const columns = [
    { label: "error", value: (row) => row.error }, { label: "mean", ...inUnit("mean") }, { label: `${range} from`, ...inUnit("mean_low") }, { label: "to", ...inUnit("mean_high") },
    { label: "deviation", title: "standard deviation from machine to machine", ...inUnit("deviation") }, { label: "deviation from", ...inUnit("deviation_low") }, { label: "deviation to", ...inUnit("deviation_high") },
    { label: "from others", unit: "%", title: "how much of a machine's errors comes from the others", value: (row) => 100 * row.shrinkage, show: (value) => showNumber(value, 3) },
  ];
  const machines = [
    { label: "machine", value: (row) => row.machine }, { label: "status", value: (row) => row.status },
    ...errors.map((one) => ({ label: one.error, value: (row) => row[one.error], show: (value) => (typeof value === "number" ? showError(value, one.unit) : "\u2013") })),
    { label: "as far by chance", title: "probability that a machine is as far from the others", value: (row) => row.chance, show: (value) => (typeof value === "number" ? showNumber(value, 2) : "\u2013") },
  ];
  return [
    section("Errors of production", make("p", { id: "identification-status" }, `Status ${result.status}: ${result.message}.`), sortableTable("Errors", columns, errors, { id: "production" }),
      make("p", { class: "hint" }, "As the table of a study file:"), make("pre", { id: "production-tolerances" }, result.tolerances)),
    section("Machines", sortableTable("Machines", machines, result.machines, { id: "machines" })),
  ];
}

// Pairs of errors, in deg and mm: a cloud for each, as long as they are few.
function posteriorSection(samples, errors) {
  const [units, charts] = [errors.map((one) => asSpecified(one.unit)), []];
  errors.slice(0, 4).forEach((other, j) => errors.slice(0, j).forEach((one, i) => {
    const column = (k) => samples.map((row) => units[k][1] * row[k]);
    const series = [{ x: column(i), y: column(j), marks: true, class: "faint", name: other.error }];
    const words = `${other.error} over ${one.error}`;
    charts.push(make("figure", {}, lineChart(series, `${one.error}, ${units[i][0]}`, `${other.error}, ${units[j][0]}`, words, { width: 360, height: 280 })));
  }));
  return section("What is known of the errors together", make("p", { class: "hint" }, "Dots: equally probable machines that would show what was measured."),
    make("div", { id: "posterior", class: "charts" }, charts));
}

function correctionSection(correction) {
  const { outcomes, metric, unit } = correction;
  const range = `${showNumber(100 * correction.confidence, 3)} % interval`;
  const percent = (value) => (typeof value === "number" ? showNumber(value < 1e-6 ? 0 : 100 * value, 3) : "\u2013");
  const columns = [
    { label: "correction", value: (row) => row.name },
    ...correction.adjustments.map((name, i) => ({ label: name, value: (row) => row.amounts[i], show: (value) => (value ? showError(value, correction.adjustment_units[name]) : "\u2013") })),
    { label: `${metric}`, unit, value: (row) => row.mean, show: (value) => showNumber(value, 4) },
    { label: `${range} from`, unit, value: (row) => row.low, show: (value) => showNumber(value, 4) }, { label: "to", unit, value: (row) => row.high, show: (value) => showNumber(value, 4) },
    { label: `${showNumber(100 * correction.quantile, 3)} % below`, unit, value: (row) => row.quantile, show: (value) => showNumber(value, 4) },
    { label: "less", unit: "%", title: "probability that the metric is less than as it is", value: (row) => (row === outcomes[0] ? null : row.less), show: percent },
    ...Object.keys(outcomes[0].broken).map((name) => ({ label: `${name} broken`, unit: "%", title: "probability that its limit is broken", value: (row) => row.broken[name], show: percent })),
    { label: "beyond tolerance", unit: "%", title: "probability that an error is beyond its tolerance", value: (row) => row.any_beyond, show: percent },
    ...(outcomes.some((one) => one.failed > 0) ? [{ label: "fails", unit: "%", title: "probability that the machine does not work", value: (row) => row.failed, show: percent }] : []),
  ];
  const shown = outcomes.filter((one, i) => i === 0 || one.name === correction.best || (i === outcomes.length - 1 && i > 1));
  const dashes = [[], [6, 4], [2, 3]];
  const series = shown.map((one, i) => ({ x: one.distribution.values, y: one.distribution.below.map((part) => 100 * part), dash: dashes[i], name: one.name }));
  const styles = ["curve", "dashed", "dotted"];
  const chart = shown[0].distribution.values.length ? make("figure", { id: "correction-chart" },
    lineChart(series, unit ? `${metric}, ${unit}` : metric, "probability to be below, %", `${metric} before and after`, { width: 560, height: 300, yRange: [0, 100] })) : null;
  return section("Correction", make("p", { id: "correction-status" }, `Status ${correction.status.replace(/_/g, " ")}: ${correction.message.replaceAll("`", "")}.`),
    sortableTable("What adjustments would do", columns, outcomes, { id: "corrections" }),
    ...correction.sentences.map((words) => make("p", {}, words)),
    make("p", { class: "hint" }, `${shown.map((one, i) => `${styles[i]}: ${one.name}`).join("; ")}.`), make("div", { class: "charts" }, chart));
}

function signalChart(curve) {
  const series = [
    { x: curve.times, y: curve.measured.map((one) => numberOr(one, NaN)), marks: true, class: "faint", name: "measured" },
    { x: curve.times, y: curve.before.map((one) => numberOr(one, NaN)), dash: [6, 4] },
    { x: curve.times, y: curve.after.map((one) => numberOr(one, NaN)) },
  ];
  const words = `${curve.column} of experiment ${curve.experiment}`;
  return make("figure", {}, lineChart(series, "time, s", `${curve.column}, ${curve.unit}`, words, { width: 560, height: 300 }));
}

function fitTable(signals) {
  const per = (row) => (row.freedom > 0 ? row.chi_square / row.freedom : null);
  const columns = [
    { label: "signal", value: (row) => row.column }, { label: "unit", value: (row) => row.unit }, { label: "experiment", value: (row) => row.experiment },
    { label: "samples", value: (row) => row.samples }, { label: "noise", title: "standard deviation of a sample", value: (row) => row.noise, show: (value, row) => `${showNumber(value, 3)}${row.estimated ? " (estimated)" : ""}` },
    { label: "left before", title: "RMS of measured less simulated", value: (row) => row.before, show: (value) => showNumber(value, 3) }, { label: "left after", value: (row) => row.remainder, show: (value) => showNumber(value, 3) },
    { label: "\u03c7\u00b2 per freedom", value: per, show: (value) => showNumber(value, 3) }, { label: "white by chance", title: "probability that independent noise is as correlated along time", value: (row) => row.whiteness_chance, show: (value) => showNumber(value, 2) },
    { label: "shift", unit: "s", value: (row) => row.shift, show: (value) => showNumber(value, 3) }, { label: "offset", value: (row) => row.offset, show: (value) => showNumber(value, 3) }, { label: "gain", value: (row) => row.gain, show: (value) => showNumber(value, 3) },
    { label: "verdict", value: (row) => row.verdict },
  ];
  return sortableTable("Signals", columns, signals, { id: "fitted-signals" });
}

function visibilitySection(seen, errors) {
  const combinations = (seen.singular_values || []).map((value, i) => ({ value, parts: seen.directions[i] }));
  const columns = [
    { label: "singular value", title: "how much more the signals tell of a combination than what was known before", value: (row) => row.value, show: (value) => showNumber(value, 3) },
    { label: "deviation left", value: (row) => 1 / Math.sqrt(1 + row.value * row.value), show: (value) => showNumber(value, 3) },
    ...errors.map((one, i) => ({ label: one.error, value: (row) => row.parts[i], show: (value) => showNumber(value, 2) })),
  ];
  const worth = [
    { label: "choice", value: (row) => row.place }, { label: "signal", value: (row) => row.column },
    { label: "information alone", unit: "nat", value: (row) => row.gain, show: (value) => showNumber(value, 3) }, { label: "variance left", unit: "%", value: (row) => 100 * row.rest, show: (value) => showNumber(value, 3) },
    { label: "with those before", unit: "nat", value: (row) => row.gain_together, show: (value) => showNumber(value, 3) }, { label: "variance left with them", unit: "%", value: (row) => 100 * row.rest_together, show: (value) => showNumber(value, 3) },
  ];
  return section("What the signals can tell",
    sortableTable("Combinations of errors, in standard deviations of what was known before", columns, combinations, { id: "combinations" }),
    (seen.sentences || []).map((words) => make("p", {}, words)),
    sortableTable("Signals in the order of choice", worth, seen.signals || [], { id: "signal-worth" }));
}
