// The page: head, pages behind tabs, keys.
const page = { rebuildCurves() {} };
const TASK_PAGES = new Map([
  ["sensitivity", sensitivityPage], ["monte_carlo", samplesPage], ["worst_case", cornersPage], ["allocation", allocationPage],
  ["sweep", sweepPage], ["reliability", reliabilityPage], ["optimise", optimisePage], ["identification", identificationPage], ["statics", staticsPage], ["turn", turnPage], ["modes", modesPage], ["cycle", cyclePage],
]);

function taskPage(task) {
  const left = task.left_out ? [section("Results", make("p", {}, `${task.left_out}.`))] : null;
  if (left) return left;
  try {
    return [...((TASK_PAGES.get(task.name) || unknownPage)(task) || unknownPage(task)), notesSection(task.result)];
  } catch {
    // A file of another program, or of another version: the other pages stand.
    return [section("Results", make("p", {}, `${task.name}.json is not as this page knows it.`)), ...unknownPage(task)];
  }
}

function noteWords(kind, words) {
  return `${kind}: ${String(words).replaceAll("`", "")}.`;
}

// What a reader of the metrics must know, such as that a norm is below the maximum.
function notesSection(result) {
  const notes = asEntries(result.metric_notes).map(([kind, words]) => noteWords(kind, words));
  const remarks = Array.isArray(result.remarks) ? result.remarks : [];
  const lines = [...notes, ...remarks].map(String);
  return lines.length ? section("What the numbers are", lines.map((words) => make("p", { class: "metric-note" }, words))) : null;
}

function tabs(pages) {
  const list = make("div", { role: "tablist", "aria-label": "Pages", class: "tabs" });
  const panels = make("main");
  const open = (index, focus) => {
    [...list.children].forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(i === index));
      tab.tabIndex = i === index ? 0 : -1;
      panels.children[i].classList.toggle("hidden", i !== index);
    });
    if (focus) list.children[index].focus();
  };
  pages.forEach(([name, title, ...parts], index) => {
    const tab = make("button", { type: "button", role: "tab", id: `tab-${name}`, "aria-controls": `page-${name}` }, title);
    tab.addEventListener("click", () => open(index));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) open((index + step + pages.length) % pages.length, true);
    });
    list.append(tab);
    panels.append(make("div", { role: "tabpanel", id: `page-${name}`, "aria-labelledby": `tab-${name}`, class: "page" },
      make("h2", { class: "print-title" }, title), ...parts.flat().filter(Boolean)));
  });
  open(0);
  return [list, panels];
}

function keysHelp() {
  const keys = [["Space", "play, pause"], [", and .", "one frame back, forward"], ["Home, End", "start, end"],
    ["arrows on the mechanism", "turn the view"], ["+ and - on it", "enlarge, reduce"], ["Escape", "let picked samples go"]];
  return make("details", { class: "keys" }, make("summary", {}, "Keys"),
    make("dl", {}, keys.flatMap(([key, words]) => [make("dt", {}, key), make("dd", {}, words)])));
}

function build() {
  const title = content.title ? String(content.title) : "Results";
  document.title = title;
  const root = document.getElementById("page");
  const pages = [];
  let histories = null;
  let mechanism = null;
  if (content.cases.length) {
    histories = historySection();
    if (histories) page.rebuildCurves = histories.rebuild;
    mechanism = mechanismSection();
    pages.push(["overview", "Overview", headline(), make("div", { class: "columns main" }, mechanism.element, loadCharts()),
      histories && histories.element]);
    pages.push(["tables", "Tables", tablesPage()]);
  }
  content.tasks.forEach((task, i) => pages.push([`task-${i}`, task.title, taskPage(task)]));
  pages.push(["checks", "Checks", checksPage()]);
  root.append(make("header", {}, make("div", { class: "top" }, make("h1", {}, title), themeSwitch()),
    content.note ? make("p", { class: "note" }, String(content.note)) : null), ...tabs(pages), make("footer", {}, keysHelp()));
  if (histories) histories.start();
  listenToKeys();
  clock.set(tellingTime());
  page.ready = true;
  document.documentElement.dataset.ready = "yes";
}

build();
