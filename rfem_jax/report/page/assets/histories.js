// Curves over time with uPlot; their cursor is the animation's time, and a drag on a curve drags the time.
function seriesTimes(names) {
  const all = names.map((name) => curves.times(name));
  const same = all.every((one) => one.length === all[0].length && one.every((time, i) => time === all[0][i]));
  return same ? all[0] : null;
}

class HistoryPlot {
  constructor(quantity, part, removed) {
    Object.assign(this, { quantity, part, difference: false, plot: null });
    this.holder = make("div", { class: "plot" });
    this.legend = make("div", { class: "legend", "aria-live": "off" });
    this.parts = make("span", { class: "choice" });
    const remove = make("button", { type: "button", class: "small remove", title: "Remove this curve", onclick: () => { this.stop(); removed(this); } }, "Remove");
    const reference = content.cases[referenceCase()];
    const difference = content.cases.length > 1
      ? toggle(`Difference from ${reference.name}`, false, (on) => { this.difference = on; this.build(); }, { class: "chip difference" }) : null;
    this.element = make("div", { class: "history" },
      make("div", { class: "controls" }, this.quantityChoice(), this.parts, difference, remove), this.holder, this.legend);
    this.follow = () => this.moveCursor();
    clock.listeners.push(this.follow);
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.holder);
    this.fillParts();
  }

  stop() {
    clock.listeners = clock.listeners.filter((one) => one !== this.follow);
    this.observer.disconnect();
    if (this.plot) this.plot.destroy();
  }

  quantityChoice() {
    const groups = new Map();
    curves.quantities.forEach((one, i) => {
      if (!groups.has(one.group)) groups.set(one.group, []);
      groups.get(one.group).push([String(i), one.label]);
    });
    const options = [...groups].map(([label, entries]) => ({ label, options: entries }));
    return choice("Show", options, String(curves.quantities.indexOf(this.quantity)), (value) => {
      this.quantity = curves.quantities[Number(value)];
      this.part = -1;
      this.fillParts();
      this.build();
    }, { class: "quantity" });
  }

  fillParts() {
    clear(this.parts);
    if (!this.quantity.parts.length) return;
    const options = [["-1", "resultant"], ...this.quantity.parts.map((letter, i) => [String(i), letter])];
    this.parts.append(switcher("Component", options, String(this.part), (value) => { this.part = Number(value); this.build(); }));
  }

  shown() {
    return content.cases.map((one, index) => ({ name: one.name, index }))
      .filter(({ name, index }) => curves.byCase.has(name) && (!motions.length || scene.cases.has(index)));
  }

  valuesOf(name) {
    const values = curves.values(name, this.quantity, this.part);
    const reference = content.cases[referenceCase()].name;
    if (!this.difference || !curves.byCase.has(reference)) return values;
    const [times, others] = [curves.times(reference), curves.values(reference, this.quantity, this.part)];
    return values.map((value, i) => value - valueAt(times, others, curves.times(name)[i]));
  }

  title() {
    const letter = this.part >= 0 && this.quantity.parts.length ? ` ${this.quantity.parts[this.part]}` : "";
    const what = `${this.quantity.label}${letter}`;
    return this.quantity.unit ? `${what}, ${this.quantity.unit}` : what;
  }

  build() {
    if (this.plot) this.plot.destroy();
    this.cursor = null;
    this.cases = this.shown().map((one) => ({ ...one, times: curves.times(one.name), values: this.valuesOf(one.name) }));
    this.fillLegend();
    if (!this.cases.length) { this.plot = null; return; }
    const times = seriesTimes(this.cases.map((one) => one.name));
    const tables = this.cases.map((one) => [Array.from(one.times), Array.from(one.values)]);
    const data = times ? [Array.from(times), ...tables.map((one) => one[1])] : uPlot.join(tables);
    const axis = (labelText) => ({
      stroke: () => palette.quiet, grid: { stroke: () => palette.line, width: 1 }, ticks: { show: false },
      label: labelText, labelSize: 22, labelFont: "600 12px system-ui, sans-serif", font: "12px system-ui, sans-serif",
    });
    const options = {
      width: Math.max(this.holder.clientWidth, 200), height: 210, legend: { show: false },
      cursor: { show: false, drag: { x: false, y: false } },
      scales: { x: { time: false } },
      axes: [{ ...axis("time, s"), size: 30, labelSize: 18 }, { ...axis(this.title()), size: 56 }],
      hooks: { draw: [() => this.moveCursor()] },
      series: [{}, ...this.cases.map((one) => ({
        label: shownCase(one.name), stroke: () => caseColour(one.index), width: 1.6, dash: caseDash(one.index),
        points: { show: false }, spanGaps: !times,
      }))],
    };
    this.plot = new uPlot(options, data, this.holder);
    this.cursor = make("div", { class: "time-cursor" });
    this.plot.over.append(this.cursor);
    this.dragTime(this.plot.over);
    this.holder.setAttribute("role", "img");
    this.holder.setAttribute("aria-label", `${this.title()} over time, s`);
  }

  dragTime(over) {
    const go = (event) => {
      const left = event.clientX - over.getBoundingClientRect().left;
      clock.play(false);
      clock.set(this.plot.posToVal(left, "x"));
    };
    over.addEventListener("pointerdown", (event) => { over.setPointerCapture(event.pointerId); go(event); });
    over.addEventListener("pointermove", (event) => { if (event.buttons) go(event); });
  }

  fillLegend() {
    clear(this.legend);
    this.readouts = this.cases.map((one) => {
      const value = make("output", { class: "readout" });
      const sample = draw("svg", { viewBox: "0 0 30 8", width: 30, height: 8, "aria-hidden": "true" },
        draw("line", { x1: 0, x2: 30, y1: 4, y2: 4, stroke: caseColour(one.index), "stroke-width": 2.5, "stroke-dasharray": caseDash(one.index).join(" ") || null }));
      this.legend.append(make("span", { class: "entry" }, sample, shownCase(one.name), value));
      return value;
    });
  }

  moveCursor() {
    if (!this.plot || !this.cursor) return;
    this.cursor.style.transform = `translateX(${this.plot.valToPos(scene.time, "x").toFixed(1)}px)`;
    this.cases.forEach((one, i) => {
      this.readouts[i].textContent = withUnit(valueAt(one.times, one.values, scene.time), this.quantity.unit, 4);
    });
  }

  resize() {
    const width = this.holder.clientWidth;
    if (this.plot && width && Math.abs(width - this.plot.width) > 1) {
      this.plot.setSize({ width, height: 210 });
      this.moveCursor();
    }
  }
}

// All curves, and a button for another one.
function historySection() {
  if (!curves) return null;
  const plots = [];
  const list = make("div", { class: "histories" });
  const add = (quantity, part) => {
    const plot = new HistoryPlot(quantity, part, (one) => { plots.splice(plots.indexOf(one), 1); one.element.remove(); });
    plots.push(plot);
    list.append(plot.element);
    plot.build();
  };
  const change = largestChange("rms_moment") || largestChange("rms_force");
  const first = change && curves.loadOf(change.joint, change.metric === "rms_moment" ? "moment" : "force");
  const rate = curves.quantities.find((one) => one.label === "Rate") || curves.quantities.find((one) => one.group === "Motion");
  const shown = [first || curves.quantities[0], rate].filter(Boolean);
  const more = make("button", { type: "button", id: "add-curve", class: "small" }, "Add a curve");
  more.addEventListener("click", () => add(curves.quantities[0], -1));
  const rebuild = () => plots.forEach((one) => one.build());
  theme.listeners.push(rebuild);
  const { saved_times: saved, most_times: most } = content.histories;
  const thinned = saved > most ? `Of ${saved} saved times at most ${most} are shown; the CSV files have all.` : null;
  const element = section("Over time", make("p", { class: "hint" }, "Drag on a curve to move the time of the animation."),
    list, more, thinned && make("p", { class: "hint" }, thinned));
  return { element, rebuild, start: () => shown.forEach((one) => add(one, -1)) };
}
