// Tables that sort by a click on a heading and are copied as text that spreadsheets read.
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = make("textarea", { readonly: true, class: "aside" });
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }
}

function compare(a, b) {
  const numbers = typeof a === "number" && typeof b === "number";
  if (numbers) return a - b;
  if (a === null || a === undefined) return b === null || b === undefined ? 0 : 1;
  if (b === null || b === undefined) return -1;
  return String(a).localeCompare(String(b), undefined, { numeric: true });
}

function headingText(column) {
  return column.unit ? `${column.label}, ${column.unit}` : column.label;
}

// Text for a cell of a spreadsheet: what begins as a formula is marked as text.
function cellText(value) {
  if (value === null || value === undefined) return "";
  if (typeof value === "number") return String(value);
  const text = String(value).replace(/[\t\r\n]+/g, " ");
  return /^[=+\-@]/.test(text) ? `'${text}` : text;
}

// columns: {label, unit, value(row), show(value, row), title, loads}; rows: any values. In a column of loads what is rounding
// beside the largest one is 0.
function sortableTable(name, columns, rows, attributes = {}) {
  const state = { column: null, down: false };
  const sizes = columns.map((column) => (column.loads ? Math.max(0, ...rows.map(column.value).filter(Number.isFinite).map(Math.abs)) : 0));
  const body = make("tbody");
  const heads = columns.map((column, index) => {
    const button = make("button", { type: "button", title: column.title }, headingText(column));
    const head = make("th", { scope: "col", "aria-sort": "none" }, button);
    button.addEventListener("click", () => {
      state.down = state.column === index ? !state.down : typeof columns[index].value(rows[0] || {}) === "number";
      state.column = index;
      heads.forEach((one) => one.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", state.down ? "descending" : "ascending");
      fill();
    });
    return head;
  });
  const ordered = () => {
    if (state.column === null) return rows;
    const value = columns[state.column].value;
    return [...rows].sort((a, b) => (state.down ? -1 : 1) * compare(value(a), value(b)));
  };
  const fill = () => {
    clear(body);
    for (const row of ordered()) {
      body.append(make("tr", {}, columns.map((column, index) => {
        const value = column.value(row);
        const text = column.show ? column.show(value, row) : showBeside(value, sizes[index], column.digits || 5);
        return make("td", { class: typeof value === "number" ? "number" : String(text).length < 14 ? "short" : null }, text);
      })));
    }
  };
  fill();
  const copy = make("button", { type: "button", class: "small copy" }, "Copy");
  copy.addEventListener("click", async () => {
    const lines = [columns.map(headingText), ...ordered().map((row) => columns.map((column) => column.value(row)))];
    const done = await copyText(lines.map((line) => line.map(cellText).join("\t")).join("\n"));
    copy.textContent = done ? "Copied" : "Not allowed";
    setTimeout(() => { copy.textContent = "Copy"; }, 1500);
  });
  const table = make("table", {}, make("caption", {}, name), make("thead", {}, make("tr", {}, heads)), body);
  const frame = make("div", { class: "table", tabindex: "0", role: "region", "aria-label": name }, table);
  return make("div", { class: "tabled", ...attributes }, copy, frame);
}
