// Charts of results that do not move, as SVG: sharp in print, and read out by what its title says.
function scale(low, high, from, to) {
  const span = high - low || 1;
  const map = (value) => from + ((value - low) / span) * (to - from);
  map.back = (place) => low + ((place - from) / (to - from || 1)) * span;
  return map;
}

function chart(width, height, title, attributes = {}) {
  const box = { viewBox: `0 0 ${width} ${height}`, width, height, class: "chart", role: "img", "aria-label": title };
  return draw("svg", { ...box, ...attributes }, draw("title", {}, title));
}

function label(x, y, text, attributes = {}) {
  return draw("text", { x, y, ...attributes }, text);
}

const ruler = document.createElement("canvas").getContext("2d");

// Width in pixels of a name beside a chart.
function nameWidth(text) {
  ruler.font = "600 14px system-ui, sans-serif";
  return ruler.measureText(text).width;
}

// Room that names to the left of a chart take, no more than `most` pixels.
function roomForNames(names, most) {
  return Math.min(Math.max(20, ...names.map(nameWidth)), most);
}

// A name that ends at a place, shortened to a room, with the whole of it where the pointer rests.
function nameLabel(x, y, text, room, attributes = {}) {
  let shown = text;
  while (shown.length > 1 && nameWidth(shown === text ? shown : `${shown}\u2026`) > room + 0.5) shown = shown.slice(0, -1);
  const one = label(x, y, shown === text ? text : `${shown}\u2026`, { "text-anchor": "end", class: "name", ...attributes });
  if (shown !== text) one.append(draw("title", {}, text));
  return one;
}

// A horizontal axis with its numbers and its title.
function axisBelow(x, y, values, title, top = null) {
  const texts = tickTexts(values);
  const parts = values.flatMap((value, i) => [
    top === null ? null : draw("line", { x1: x(value), x2: x(value), y1: top, y2: y, class: "grid" }),
    label(x(value), y + 15, texts[i], { "text-anchor": "middle", class: "tick" }),
  ]);
  const middle = (x(values[0]) + x(values[values.length - 1])) / 2;
  return draw("g", {}, parts, label(middle, y + 32, title, { "text-anchor": "middle", class: "title" }));
}

function axisLeft(x, y, values, title, right = null, top = null) {
  const texts = tickTexts(values);
  const parts = values.flatMap((value, i) => [
    right === null ? null : draw("line", { x1: x, x2: right, y1: y(value), y2: y(value), class: "grid" }),
    label(x - 6, y(value) + 4, texts[i], { "text-anchor": "end", class: "tick" }),
  ]);
  return draw("g", {}, parts, label(x, numberOr(top, Math.min(...values.map(y)) - 10), title, { "text-anchor": "start", class: "title" }));
}

// A mark of a case: its shape tells it apart without colour.
function caseMark(index, x, y, size = 5) {
  const shapes = [
    () => draw("circle", { cx: x, cy: y, r: size }),
    () => draw("rect", { x: x - size, y: y - size, width: 2 * size, height: 2 * size }),
    () => polygon(x, y, size * 1.25, 3, -90),
    () => polygon(x, y, size * 1.25, 4, 0),
    () => polygon(x, y, size * 1.25, 3, 90),
    () => polygon(x, y, size * 1.15, 5, -90),
    () => polygon(x, y, size * 1.15, 6, 0),
  ];
  const mark = shapes[index % shapes.length]();
  mark.setAttribute("class", `case-${index % shapes.length}`);
  return mark;
}

function polygon(x, y, size, corners, from) {
  const points = Array.from({ length: corners }, (_, i) => {
    const angle = ((from + (360 * i) / corners) * Math.PI) / 180;
    return `${(x + size * Math.cos(angle)).toFixed(2)},${(y + size * Math.sin(angle)).toFixed(2)}`;
  });
  return draw("polygon", { points: points.join(" ") });
}

// Rows of marks on one axis: rows [{label, marks: [{index, value, title}]}].
function dotChart(rows, unitText, title, reference) {
  const width = 460;
  const room = roomForNames(rows.map((row) => row.label), 0.4 * width);
  const left = room + 20;
  const step = 34;
  const height = rows.length * step + 56;
  const highest = Math.max(1e-300, ...rows.flatMap((row) => row.marks.map((mark) => mark.value)).filter(Number.isFinite));
  const marks = ticks(0, highest * 1.02, 5);
  const x = scale(0, Math.max(highest * 1.04, marks[marks.length - 1]), left, width - 22);
  const svg = chart(width, height, title);
  svg.append(axisBelow(x, rows.length * step + 10, marks, unitText, 6));
  rows.forEach((row, i) => {
    const y = 24 + i * step;
    const known = row.marks.filter((mark) => Number.isFinite(mark.value));
    const base = known.find((mark) => mark.index === reference);
    svg.append(nameLabel(left - 12, y + 5, row.label, room));
    if (known.length > 1) {
      const [low, high] = finiteRange(known.map((mark) => mark.value));
      svg.append(draw("line", { x1: x(low), x2: x(high), y1: y, y2: y, class: "span" }));
    }
    if (base) svg.append(draw("line", { x1: x(base.value), x2: x(base.value), y1: y - 10, y2: y + 10, class: "base" }));
    known.forEach((mark) => {
      const one = caseMark(mark.index, x(mark.value), y);
      one.append(draw("title", {}, mark.title));
      svg.append(one);
    });
    if (!known.length) svg.append(label(x(0), y + 4, "n/a", { class: "tick" }));
  });
  return svg;
}

// Places of a curve without those that have no value, in pieces.
function pieces(places, values) {
  const found = [[]];
  places.forEach((place, i) => {
    if (Number.isFinite(values[i])) found[found.length - 1].push(place);
    else if (found[found.length - 1].length) found.push([]);
  });
  return found.filter((one) => one.length);
}

// Curves over a common axis: series [{x, y, class, band: [low, high]}], marks at points if `points`; a series with `marks`
// is marks alone.
function lineChart(series, xTitle, yTitle, title, options = {}) {
  const width = options.width || 520;
  const height = options.height || 300;
  const [x0, x1] = options.xRange || finiteRange(series.flatMap((one) => Array.from(one.x)));
  const heights = series.flatMap((one) => [...one.y, ...(one.band ? one.band.flatMap((side) => [...side]) : [])]);
  const found = finiteRange([...heights, ...(options.lines || []).map((one) => one.value)].filter(Number.isFinite));
  const [y0, y1] = options.yRange || [found[0] - 0.06 * (found[1] - found[0]), found[1] + 0.06 * (found[1] - found[0])];
  const x = scale(x0, x1, 62, width - 20);
  const y = scale(y0, y1, height - 46, 30);
  const svg = chart(width, height, title);
  svg.append(axisBelow(x, height - 42, ticks(x0, x1, 5), xTitle, 26), axisLeft(56, y, ticks(y0, y1, 5), yTitle, width - 20, 16));
  const path = (xs, ys) => Array.from(xs, (value, i) => `${x(value).toFixed(1)},${y(ys[i]).toFixed(1)}`);
  for (const line of options.lines || []) {
    svg.append(draw("line", { x1: x(x0), x2: x(x1), y1: y(line.value), y2: y(line.value), class: "mark" }),
      label(width - 24, y(line.value) - 5, line.label, { "text-anchor": "end", class: "tick" }));
  }
  for (const one of series) {
    if (one.band) {
      const points = [...path(one.x, one.band[0]), ...path(one.x, one.band[1]).reverse()];
      svg.append(draw("polygon", { points: points.join(" "), class: "band" }));
    }
    const dash = (one.dash || []).join(" ") || null;
    for (const points of one.marks ? [] : pieces(path(one.x, one.y), one.y)) {
      svg.append(draw("polyline", { points: points.join(" "), class: one.class || "curve", "stroke-dasharray": dash }));
    }
    if (options.points || one.marks) {
      path(one.x, one.y).forEach((place, i) => {
        if (!Number.isFinite(one.y[i])) return;
        const [cx, cy] = place.split(",").map(Number);
        const mark = one.marks ? draw("circle", { cx, cy, r: one.class ? 2 : 3, class: one.class || "dot" }) : caseMark(one.mark || 0, cx, cy);
        mark.append(draw("title", {}, `${one.name || yTitle}: ${showNumber(one.y[i])} at ${showNumber(one.x[i])}`));
        svg.append(mark);
      });
    }
  }
  return svg;
}
