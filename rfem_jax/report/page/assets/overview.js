// The first page: what errors do to the joints, in words, in the mechanism, beside it, and over time.
function headline() {
  if (content.cases.length === 0) return null;
  const reference = content.cases[referenceCase()];
  const sentences = [["rms_moment", "N m", "RMS moment"], ["rms_force", "N", "RMS force"]].map(([metric, unitName, words]) => {
    const change = largestChange(metric);
    if (!change || !(change.to > change.from)) return null;
    const nothing = change.from < 1e-6 * change.to;
    const times = !nothing && change.to > 1.05 * change.from ? `, ${showNumber(change.to / change.from, 2)} times as much` : "";
    return make("p", { class: "finding" }, `${words} in joint `, make("strong", {}, change.joint), ": ",
      make("strong", {}, nothing ? `0 ${unitName}` : withUnit(change.from, unitName, 3)), ` in ${shownCase(reference.name)}, `,
      make("strong", {}, withUnit(change.to, unitName, 3)), ` in ${content.cases[change.case].name}${times}.`);
  });
  const bad = content.cases.filter((one) => one.status !== "ok");
  const warning = bad.length
    ? make("p", { class: "warning", role: "status" }, `Not complete: ${bad.map((one) => `${one.name} (${one.status})`).join(", ")}; see Checks.`) : null;
  return make("div", { class: "headline" }, warning, sentences);
}

function caseList() {
  const rows = content.cases.map((one, index) => {
    const words = one.errors.filter((error) => error[1]).map(errorWords);
    const mark = draw("svg", { viewBox: "0 0 16 16", width: 16, height: 16, "aria-hidden": "true" }, caseMark(index, 8, 8, 5));
    return make("li", {}, mark, make("strong", {}, shownCase(one.name)), make("span", {}, words.join("; ") || "no errors"));
  });
  return make("ul", { class: "cases" }, rows);
}

function loadCharts() {
  if (!content.cases.length || !content.cases[0].joints.length) return null;
  const holder = make("div", { id: "load-charts" });
  const show = (kind) => clear(holder).append(...loadChartsOf(kind === "max" ? ["max", "Maximum"] : ["rms", "RMS"]));
  show("rms");
  const known = content.cases.some((one) => one.joints.some((joint) => Number.isFinite(joint.max_force)));
  const choose = known ? switcher("Loads shown", [["rms", "RMS"], ["max", "Maximum"]], "rms", show, { id: "load-kind" }) : null;
  return section("Loads in the joints", caseList(), choose, holder);
}

// Marks of all cases at every joint, of the resultant moment and force; kind: its key and its word.
function loadChartsOf([kind, word]) {
  return ["moment", "force"].map((load) => {
    const [metric, unitName] = [`${kind}_${load}`, load === "force" ? "N" : "N m"];
    const title = `${word} resultant ${load}, ${unitName}`;
    const rows = content.cases[0].joints.map((joint) => ({
      label: joint.name,
      marks: content.cases.map((one, index) => {
        const value = jointOf(one, joint.name)[metric];
        return { index, value, title: `${shownCase(one.name)}, joint ${joint.name}: ${withUnit(value, unitName)}` };
      }),
    }));
    return make("figure", {}, make("figcaption", {}, title), dotChart(rows, title, `${title}, by joint and case`, referenceCase()));
  });
}

function mechanismSection() {
  if (!motions.some((one) => Number.isFinite(one.extent().low[0]))) {
    return { element: section("Mechanism", make("p", { class: "hint" }, "This folder has no animation.npz of these cases, so that nothing can be drawn here; run the study again.")) };
  }
  const canvas = make("canvas", {
    id: "mechanism", tabindex: "0", role: "img",
    "aria-label": "The mechanism in three dimensions; drag or the arrow keys turn the view, the wheel or + and - enlarge it",
  });
  const reference = referenceCase();
  const worst = worstCase();
  content.animation.cases.forEach((name, index) => {
    if (content.cases.length <= 2 || index === reference || index === worst) scene.cases.add(index);
  });
  content.animation.joints.forEach((joint) => scene.joints.add(joint.name));
  const view = new MechanismView(canvas);
  const element = section("Mechanism", make("div", { class: "stage" }, canvas), playerControls(), sceneControls(view));
  clock.listeners.push(() => view.draw());
  theme.listeners.push(() => view.draw());
  return { element, view };
}

function sceneControls(view) {
  const draw = () => view.draw();
  const most = Math.max(view.measured.factor * 5, 1.01);
  const slider = make("input", { type: "range", id: "exaggeration", min: 0, max: Math.log(most), step: "any", "aria-label": "Exaggeration of deviations" });
  const readout = make("output", { class: "readout", id: "exaggeration-text" });
  const show = () => {
    readout.textContent = `${showNumber(scene.exaggeration, 2)} times`;
    slider.setAttribute("aria-valuetext", readout.textContent);
  };
  slider.value = Math.log(scene.exaggeration);
  slider.addEventListener("input", () => { scene.exaggeration = Math.exp(Number(slider.value)); show(); draw(); });
  show();
  const acting = (content.animation.forces || []).length + (content.animation.laws || []).length;
  const flags = [["forces", "Forces"], ["moments", "Moments"], ...(acting ? [["acting", "Springs and outer forces"]] : []), ["errors", "Errors"], ["frames", "Joint frames"], ["perfect", "Perfect mechanism"]];
  const switches = flags.map(([name, text]) => toggle(text, scene[name], (on) => { scene[name] = on; draw(); }, { id: `show-${name}` }));
  const perspective = toggle("Perspective", false, (on) => { view.camera.perspective = on; draw(); }, { id: "perspective" });
  const views = Object.keys(VIEWS).map((name) =>
    make("button", { type: "button", class: "chip view", "data-view": name, onclick: () => { view.camera.look(name); draw(); } }, name));
  const reset = make("button", { type: "button", class: "chip", id: "reset-view", onclick: () => { view.camera.reset(); draw(); } }, "Reset view");
  const arrows = make("input", { type: "range", id: "arrow-size", min: 0.2, max: 3, step: 0.05, value: 1, "aria-label": "Size of arrows" });
  arrows.addEventListener("input", () => { scene.arrowSize = Number(arrows.value); draw(); });
  return make("div", { class: "scene" },
    make("div", { class: "controls" }, make("span", { class: "name" }, "Deviations"), slider, readout,
      make("span", { class: "hint" }, `from the perfect mechanism; the largest is ${withUnit(1000 * view.measured.largest, "mm", 3)}`)),
    make("div", { class: "controls" }, make("span", { class: "name" }, "Cases"), caseToggles(draw),
      switcher("Layout", [["beside", "Side by side"], ["over", "Over each other"]], scene.layout, (value) => { scene.layout = value; draw(); }, { id: "layout" })),
    make("div", { class: "controls" }, make("span", { class: "name" }, "Show"), switches),
    make("div", { class: "controls" }, make("span", { class: "name" }, "Arrows at"), jointToggles(draw), arrows),
    make("div", { class: "controls" }, make("span", { class: "name" }, "View"), views, perspective, reset));
}

function caseToggles(draw) {
  return content.animation.cases.map((name, index) => {
    const mark = () => draw16(index);
    const button = toggle("", scene.cases.has(index), (on) => {
      if (on) scene.cases.add(index);
      else scene.cases.delete(index);
      draw();
      page.rebuildCurves();
    }, { class: "chip case", "data-case": index });
    button.append(mark(), document.createTextNode(shownCase(name)));
    return button;
  });
}

function draw16(index) {
  return draw("svg", { viewBox: "0 0 16 16", width: 14, height: 14, "aria-hidden": "true" }, caseMark(index, 8, 8, 5));
}

function jointToggles(draw) {
  return content.animation.joints.map((joint) => toggle(joint.name, true, (on) => {
    if (on) scene.joints.add(joint.name);
    else scene.joints.delete(joint.name);
    draw();
  }, { class: "chip joint" }));
}

// The tables of all joint loads and of the driven joint.
function tablesPage() {
  if (!content.cases.length) return null;
  const norm = (value) => (Array.isArray(value) ? Math.hypot(...value.map(Number)) : value);
  const rows = content.cases.flatMap((one) => one.joints.map((joint) => ({ case: one.name, joint })));
  const columns = [
    { label: "case", value: (row) => shownCase(row.case) },
    { label: "joint", value: (row) => row.joint && row.joint.name },
    { label: "kind", value: (row) => row.joint && row.joint.kind },
    ...content.metrics.map((metric) => ({
      label: metric.label, unit: metric.unit, title: metric.text, loads: true,
      value: (row) => row.joint && norm(row.joint[metric.name]),
    })),
  ];
  const units = new Map(content.metric_units);
  const asked = [...new Set(content.cases.flatMap((one) => one.metrics.map(([name]) => name)))];
  const values = content.cases.map((one) => new Map(one.metrics));
  const metricColumns = [
    { label: "metric", value: (name) => name }, { label: "unit", value: (name) => (units.get(name) === "1" ? "" : units.get(name)) },
    ...content.cases.map((one, i) => ({ label: one.name, value: (name) => values[i].get(name) })),
  ];
  const ends = content.cases.map((one) => ({ case: one.name, status: one.status, values: new Map(one.driven) }));
  const endColumns = [
    { label: "case", value: (row) => shownCase(row.case) }, { label: "status", value: (row) => row.status },
    ...content.ends.map((one) => ({ label: one.label, unit: one.unit, value: (row) => row.values && row.values.get(one.name), digits: 8 })),
  ];
  const errors = content.cases.flatMap((one) => one.errors.map((error) => ({ case: one.name, error })));
  const errorColumns = [
    { label: "case", value: (row) => row.case }, { label: "error", value: (row) => row.error && row.error[0] },
    { label: "value", value: (row) => row.error && row.error[1], show: (value, row) => showError(value, row.error[2]) },
  ];
  return [
    section("Loads in the joints", sortableTable("Loads by case and joint, at rest first: a preload is the resultant at the start, holding loads included", columns, rows, { id: "loads-table" }), failedNote()),
    asked.length ? section("Metrics", sortableTable("Metrics that the study asks for", metricColumns, asked, { id: "metrics-table" }),
      content.metric_notes.map(([kind, words]) => make("p", { class: "metric-note" }, noteWords(kind, words)))) : null,
    section("Assembly errors", errors.length ? sortableTable("Errors by case", errorColumns, errors) : make("p", {}, "No case has errors.")),
    content.driven_joint ? section(`Driven joint ${content.driven_joint}`, sortableTable("End of the run", endColumns, ends)) : null,
  ];
}
