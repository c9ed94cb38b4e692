// Elements of the page. Texts become text nodes, never markup.
function append(element, children) {
  for (const child of children.flat()) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : document.createTextNode(String(child)));
  }
  return element;
}

// An element; attributes that begin with "on" are listeners, "class" is the class.
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  setAll(element, attributes);
  return append(element, children);
}

function draw(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  setAll(element, attributes);
  return append(element, children);
}

function setAll(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
}

function clear(element) {
  while (element.firstChild) element.firstChild.remove();
  return element;
}

// A button that is on or off.
function toggle(label, on, changed, attributes = {}) {
  const button = make("button", { type: "button", class: "chip", "aria-pressed": String(on), ...attributes }, label);
  button.addEventListener("click", () => {
    const now = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(now));
    changed(now);
  });
  return button;
}

// A list to choose from; options are [value, text] or {label, options}.
function choice(label, options, value, changed, attributes = {}) {
  const option = ([key, text]) => make("option", { value: key, selected: key === value }, text);
  const entries = options.map((one) =>
    Array.isArray(one) ? option(one) : make("optgroup", { label: one.label }, one.options.map(option)));
  const select = make("select", attributes, entries);
  select.addEventListener("change", () => changed(select.value));
  return make("label", { class: "choice" }, make("span", {}, label), select);
}

function section(title, ...children) {
  return make("section", { class: "card" }, make("h2", {}, title), ...children);
}

// Two or more buttons of which one is pressed.
function switcher(label, options, value, changed, attributes = {}) {
  const buttons = options.map(([key, text]) =>
    make("button", { type: "button", class: "chip", "data-value": key, "aria-pressed": String(key === value) }, text));
  buttons.forEach((button) => button.addEventListener("click", () => {
    buttons.forEach((one) => one.setAttribute("aria-pressed", String(one === button)));
    changed(button.dataset.value);
  }));
  return make("div", { class: "group", role: "group", "aria-label": label, ...attributes }, buttons);
}
