// What is drawn at the joints: symbols as in textbooks, frames, arrows of loads, marks of errors. All on a 2D canvas.
function stroke(context, points, style) {
  if (points.some((one) => !Number.isFinite(one.x) || !Number.isFinite(one.y))) return;
  context.beginPath();
  points.forEach((one, i) => (i ? context.lineTo(one.x, one.y) : context.moveTo(one.x, one.y)));
  context.lineWidth = style.width || 1;
  context.strokeStyle = style.colour;
  context.setLineDash(style.dash || []);
  context.lineCap = style.dash ? "butt" : "round";
  context.lineJoin = "round";
  context.stroke();
  context.setLineDash([]);
}

// Text with a rim of the ground's colour, so that lines behind it do not matter.
function write(context, text, x, y, colour, font = "600 13px system-ui, sans-serif", align = "left") {
  context.font = font;
  context.textAlign = align;
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.strokeStyle = palette.ground;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

function head(context, from, to, size, colour, filled) {
  const angle = Math.atan2(to.y - from.y, to.x - from.x);
  const corner = (side) => [to.x - size * Math.cos(angle + side * 0.42), to.y - size * Math.sin(angle + side * 0.42)];
  context.beginPath();
  context.moveTo(...corner(1));
  context.lineTo(to.x, to.y);
  context.lineTo(...corner(-1));
  if (filled) context.closePath();
  context.lineWidth = 1.8;
  context.strokeStyle = colour;
  context.fillStyle = colour;
  if (filled) context.fill();
  context.stroke();
}

// An arrow: of a force with one filled head, of a moment with two open ones.
function arrow(context, from, to, colour, moment) {
  const size = Math.hypot(to.x - from.x, to.y - from.y);
  if (!(size > 1.5)) return;
  const headSize = Math.min(10, 3 + 0.4 * size);
  stroke(context, [from, to], { colour: palette.ground, width: 5 });
  stroke(context, [from, to], { colour, width: 2.4, dash: moment ? [5, 2.5] : null });
  head(context, from, to, headSize, colour, !moment);
  if (moment) {
    const back = { x: to.x - ((to.x - from.x) * 0.55 * headSize) / size, y: to.y - ((to.y - from.y) * 0.55 * headSize) / size };
    head(context, from, back, headSize, colour, false);
  }
}

function disc(context, at, radius, fill, rim) {
  context.beginPath();
  context.arc(at.x, at.y, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
  context.lineWidth = 1.8;
  context.strokeStyle = rim;
  context.stroke();
}

function base(context, at) {
  const lines = [[[-11, 16], [0, 0], [11, 16], [-11, 16]], [[-15, 16], [15, 16]]];
  for (let x = -12; x <= 12; x += 6) lines.push([[x, 16], [x - 4, 21]]);
  for (const line of lines) {
    stroke(context, line.map(([x, y]) => ({ x: at.x + x, y: at.y + y })), { colour: palette.quiet, width: 1.2 });
  }
}

// The symbol of a joint: its axis in space, and a mark by its kind.
function jointSymbol(context, project, joint, centre, axes, size) {
  const at = project(centre);
  if (joint.parent === "base" && !["prismatic", "cylindrical", "planar"].includes(joint.kind)) base(context, at);
  const along = (axis, half, style) =>
    stroke(context, [project(plus(centre, axis, -half)), project(plus(centre, axis, half))], style);
  const axisStyle = { colour: palette.ink, width: 1.1, dash: [7, 2, 2, 2] };
  if (["revolute", "cylindrical", "planar", "universal"].includes(joint.kind)) along(axes[1], 0.09 * size, axisStyle);
  if (joint.kind === "universal") along(axes[2], 0.07 * size, axisStyle);
  if (joint.kind === "prismatic") along(axes[0], 0.16 * size, { colour: palette.quiet, width: 1.4 });
  if (joint.kind === "prismatic" || joint.kind === "fixed") {
    const [x, y] = [scaled(axes[0], 0.045 * size), scaled(axes[2], 0.026 * size)];
    const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]].map(([a, b]) => project(plus(plus(centre, x, a), y, b)));
    context.beginPath();
    corners.forEach((one) => context.lineTo(one.x, one.y));
    context.fillStyle = joint.kind === "fixed" ? palette.ink : palette.ground;
    context.fill();
    stroke(context, corners, { colour: palette.ink, width: 1.8 });
    return;
  }
  const fills = { spherical: palette.quiet, cylindrical: palette.faint, universal: palette.faint };
  disc(context, at, joint.kind === "spherical" ? 6.5 : 5.5, fills[joint.kind] || palette.ground, palette.ink);
}

function jointFrame(context, project, centre, axes, size) {
  ["x", "y", "z"].forEach((letter, i) => {
    const colour = palette[`axis-${letter}`];
    const tip = project(plus(centre, axes[i], 0.14 * size));
    arrow(context, project(centre), tip, colour, false);
    write(context, letter, tip.x + 4, tip.y + 4, colour, "600 11px system-ui, sans-serif");
  });
}

// A circle with a head around a direction: a rotation. Its sense is that of the right hand, or the other one.
function turnMark(context, project, centre, direction, radius, sign, colour) {
  const [first, second] = across(direction);
  const points = [];
  for (let i = 0; i <= 24; i++) {
    const angle = sign * (0.4 + (i / 24) * 4.9);
    points.push(project(plus(plus(centre, first, radius * Math.cos(angle)), second, radius * Math.sin(angle))));
  }
  stroke(context, points, { colour: palette.ground, width: 5 });
  stroke(context, points, { colour, width: 2.2 });
  head(context, points[points.length - 3], points[points.length - 1], 8, colour, true);
}

// The sign of one error at a place, along or about the axis of its frame.
function errorMark(context, project, centre, axes, read, value, size) {
  const axis = axes["xyz".indexOf(read.component.slice(-1))] || axes[0];
  const sign = value < 0 ? -1 : 1;
  const colour = palette.error;
  if (read.component === "twist" || read.component.includes("delta") || read.component.includes("tilt")) {
    const half = scaled(axis, 0.12 * size);
    stroke(context, [project(plus(centre, half, -1)), project(plus(centre, half))], { colour, width: 1.2, dash: [3, 3] });
    turnMark(context, project, plus(centre, axis, 0.09 * size), axis, 0.04 * size, sign, colour);
    return;
  }
  const from = plus(centre, axis, 0.03 * size * sign);
  arrow(context, project(from), project(plus(from, axis, 0.13 * size * sign)), colour, false);
}

// A note with a line to what it belongs to; returns its height.
function note(context, lines, at, x, y, colour) {
  context.font = "600 12px system-ui, sans-serif";
  const width = Math.max(...lines.map((line) => context.measureText(line).width)) + 16;
  const height = 16 * lines.length + 8;
  stroke(context, [at, { x: x + 6, y: y + height / 2 }], { colour, width: 1 });
  context.fillStyle = palette.ground;
  context.strokeStyle = colour;
  context.lineWidth = 1.4;
  context.beginPath();
  context.roundRect(x, y, width, height, 5);
  context.fill();
  context.stroke();
  context.textAlign = "left";
  context.fillStyle = colour;
  lines.forEach((line, i) => context.fillText(line, x + 8, y + 16 * (i + 1)));
  return height;
}
