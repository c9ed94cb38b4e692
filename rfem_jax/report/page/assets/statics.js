// Loads at rest, or of rigid links in a given motion, at one position or at several of what is held.
function staticsWords(cases) {
  const moving = cases.some(([, one]) => one.rate && typeof one.rate === "object");
  return moving ? ["in the given motion", "What drives", "driven by"] : ["at rest", "What holds", "held by"];
}

function staticsRows(cases, part, values) {
  return cases.flatMap(([name, one]) => asEntries(one[part]).flatMap(([of, found]) => values(found).map((value, i) => ({ name, of, i, value, one }))));
}

function staticsPage(task) {
  const { result } = task;
  const cases = analysedCases(result);
  const held = asEntries(result.held);
  const [how, what, by] = staticsWords(cases);
  const several = cases.some(([, one]) => one.statuses.length > 1);
  const place = (row) => held.map(([label, unit]) => `${label} ${showBeside(row.one.position[label][row.i] * (unit === "rad" ? DEGREES : 1000), 0, 5)} ${unit === "rad" ? "deg" : "mm"}`).join(", ");
  const first = [{ label: "case", value: (row) => row.name }, { label: "joint", value: (row) => row.of },
    ...(several ? [{ label: "position", value: place }] : [])];
  const size = (value) => Math.hypot(...value);
  const parts = (load, unit) => [{ label: load, unit, loads: true, value: (row) => size(row.value[load]) },
    ...["x", "y", "z"].map((axis, k) => ({ label: `${load} ${axis}`, unit, loads: true, value: (row) => row.value[load][k] }))];
  const joints = staticsRows(cases, "joints", (load) => load.force.map((force, i) => ({ force, moment: load.moment[i] })));
  const remarks = cases.flatMap(([name, one]) => staticsRemarks(name, one));
  const sections = [...(remarks.length ? [section("What to know", remarks.map((words) => make("p", { class: "hint failed" }, words)))] : []),
    section(`Loads of the joints ${how}`, sortableTable("Forces and moments in the frames of the joints",
    [...first, ...parts("force", "N"), ...parts("moment", "N m")], joints, { id: "static-loads" }))];
  const onBase = cases.flatMap(([name, one]) => (one.shaking ? one.shaking.force.map((force, i) => ({ name, i, one, value: { force, moment: one.shaking.moment[i] } })) : []));
  if (onBase.length) {
    sections.push(section("What the mechanism exerts on its base", sortableTable("Force and moment on the base, in global axes",
      [first[0], ...first.slice(2), ...parts("force", "N"), ...parts("moment", "N m")], onBase, { id: "static-shaking" })));
  }
  if (held.length) {
    const rows = staticsRows(cases, "holding", (values) => values);
    const columns = [first[0], { label: "held", value: (row) => row.of }, { label: "position", value: place },
      { label: by, value: (row) => row.value }, { label: "unit", value: (row) => (result.units || {})[row.of] }];
    sections.push(section(`${what} the mechanism`, staticsCurve(result, cases, held), sortableTable(`${what} the mechanism`, columns, rows, { id: "static-holding" })));
  }
  const metrics = staticsRows(cases, "metrics", (value) => [value]);
  if (metrics.length) {
    const columns = [first[0], { label: "metric", value: (row) => row.of }, { label: "value", value: (row) => row.value }, { label: "unit", value: (row) => (result.units || {})[row.of] }];
    sections.push(section("Metrics", sortableTable(`Metrics of the mechanism ${how}`, columns, metrics, { id: "static-metrics" })));
  }
  const stresses = staticsRows(cases, "stress", (values) => values);
  if (stresses.length) {
    const columns = [first[0], { label: "link", value: (row) => row.of }, ...first.slice(2), { label: "largest stress", unit: "MPa", value: (row) => row.value / 1e6 }];
    sections.push(section("Stresses", sortableTable("Largest stresses of the links", columns, stresses, { id: "static-stresses" })));
  }
  return sections;
}

// Positions of a case whose numbers are not those of rest, and what is said of the case.
function staticsRemarks(name, one) {
  const failed = [...new Set(one.statuses)].filter((status) => status !== "ok");
  const counts = failed.map((status) => `${one.statuses.filter((other) => other === status).length} of ${one.statuses.length} positions are ${status.replace(/_/g, " ")}, and their numbers not those of rest.`);
  return [...counts, ...(Array.isArray(one.remarks) ? one.remarks : [])].map((words) => `Case ${name}: ${words}`);
}

// What holds the first coordinate that takes several positions, over these.
function staticsCurve(result, cases, held) {
  const moves = held.find(([label]) => cases.some(([, one]) => new Set(one.position[label]).size > 1));
  if (!moves) return null;
  const [label, unit] = moves;
  const series = cases.map(([name, one], index) => ({ name, index, x: one.position[label].map((x) => x * (unit === "rad" ? DEGREES : 1000)),
    y: one.holding[label].map((y, i) => (one.statuses[i] === "ok" && Number.isFinite(y) ? y : NaN)), class: `curve case-${index % 7}`, dash: caseDash(index) }));
  return make("div", { id: "static-curve" },
    lineChart(series, `position of ${label}, ${unit === "rad" ? "deg" : "mm"}`, unit === "rad" ? "N m" : "N", `${staticsWords(cases)[1]} ${label} ${staticsWords(cases)[0]}`, { width: 760, height: 320 }),
    lineLegend(series.map((one) => [one.name, one.index])));
}
