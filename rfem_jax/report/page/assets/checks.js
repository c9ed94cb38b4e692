// Checks on a page of their own: status, balances, branches, versions.
function checksPage() {
  const rows = content.cases;
  const columns = [
    { label: "case", value: (row) => shownCase(row.name) }, { label: "status", value: (row) => row.status },
    { label: "what it means", value: (row) => row.message },
    ...content.balances.map((one) => ({ label: one.label, unit: one.unit, title: one.text, value: (row) => (row.numbers || {})[one.name], digits: 3 })),
  ];
  const branches = rows.flatMap((one) => one.branch.map(([joint, modes]) => ({ case: one.name, joint, modes: new Map(modes) })));
  const branchColumns = [
    { label: "case", value: (row) => row.case }, { label: "cut joint", value: (row) => row.joint },
    ...["start", "end", "changes"].map((key) => ({ label: key, value: (row) => row.modes && row.modes.get(key) })),
  ];
  const meaning = make("dl", {}, content.balances.flatMap((one) => [make("dt", {}, one.label), make("dd", {}, one.text)]));
  const pairs = (name, list) => (list.length ? sortableTable(name, [{ label: "name", value: (row) => row[0] },
    { label: "value", value: (row) => (row[1] !== null && typeof row[1] === "object" ? JSON.stringify(row[1]) : row[1]), digits: 12 }], list) : null);
  return [
    rows.length ? section("Balances and status", sortableTable("Checks of every case", columns, rows, { id: "balances" }), meaning) : null,
    branches.length ? section("Branches", make("p", { class: "hint" }, "On which side each loop closes; derivatives and averages across a change have no meaning."),
      sortableTable("Assembly modes of the cut joints", branchColumns, branches)) : null,
    section("How it was computed", Number.isFinite(content.duration) ? make("p", {}, `Simulated: ${withUnit(content.duration, "s")}.`) : null,
      pairs("Method", content.method), pairs("Versions", content.versions), pairs("Compilation", content.compilation),
      make("p", { class: "hint" }, `Written by ${content.generator}. Curves: uPlot 1.6.32 (MIT licence, L. Sorokin). This file needs no network.`)),
  ];
}
