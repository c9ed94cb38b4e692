// What acts beside the joints: springs and forces at points, springs and laws in joints, and the arms of joints that are
// off a link's axis.
const ARM = 0.01; // of the mechanism's size: a shorter arm is not drawn
const WINDINGS = 7;

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// The place on a line of points that is nearest to a point: the piece, and the share of it.
function nearestOn(line, point) {
  let found = { piece: 0, share: 0, distance: Infinity };
  for (let piece = 0; piece + 1 < line.length; piece++) {
    const along = plus(line[piece + 1], line[piece], -1);
    const square = dot(along, along);
    const share = square > 0 ? Math.min(Math.max(dot(plus(point, line[piece], -1), along) / square, 0), 1) : 0;
    const distance = length(plus(plus(line[piece], along, share), point, -1));
    if (distance < found.distance) found = { piece, share, distance };
  }
  return found;
}

function onLine(line, place) {
  return plus(line[place.piece], plus(line[place.piece + 1], line[place.piece], -1), place.share);
}

// Of every joint the links that it is on, and where on their lines; places are those of the perfect mechanism.
function feetOf(motion, lines) {
  const found = [];
  content.animation.joints.forEach((joint, j) => {
    const slides = ["prismatic", "cylindrical", "planar"].includes(joint.kind);
    for (const side of ["parent", "child"]) {
      const l = content.animation.links.findIndex((link) => link.name === joint[side]);
      if (l < 0) continue;
      const seat = slides && side === "parent";
      const point = motion.read(seat ? "seat_centre" : "nominal_centre", j, 3, START);
      found.push({ j, l, seat, place: nearestOn(lines[l], point) });
    }
  });
  return found;
}

const START = { low: 0, high: 0, share: 0 };

// Arms from the lines of the links to the joints that are off them.
function drawArms(context, project, one, view) {
  if (!one.motion.feet) one.motion.feet = feetOf(one.motion, view.lines({ motion: one.motion, at: START }, 0));
  const [drawn, perfect] = [view.lines(one, scene.exaggeration), view.lines(one, 0)];
  for (const { j, l, seat, place } of one.motion.feet) {
    const foot = onLine(drawn[l], place);
    const moved = plus(foot, onLine(perfect[l], place), -1);
    const tip = seat ? plus(one.motion.read("seat_centre", j, 3, one.at), moved) : one.motion.centre(j, one.at, scene.exaggeration);
    if (!(length(plus(tip, foot, -1)) > ARM * view.measured.size)) continue;
    const points = [project(foot), project(tip)];
    stroke(context, points, { colour: palette.ground, width: 5 });
    stroke(context, points, { colour: caseColour(one.index), width: 2.4 });
  }
}

// Where a point on a link is drawn: as far from the link's line as it is, but that line exaggerated.
function drawnPoint(part, f, link, one, view) {
  const { motion, at } = one;
  const point = motion.read(part, f, 3, at);
  const l = content.animation.links.findIndex((each) => each.name === link);
  if (l < 0) return point;
  motion.hung = motion.hung || new Map();
  const key = `${part} ${f}`;
  if (!motion.hung.has(key)) {
    motion.hung.set(key, nearestOn(view.lines({ motion: one.motion, at: START }, 1)[l], motion.read(part, f, 3, START)));
  }
  const place = motion.hung.get(key);
  return plus(point, plus(onLine(view.lines(one, scene.exaggeration)[l], place), onLine(view.lines(one, 1)[l], place), -1));
}

function zigzag(context, from, to) {
  const [dx, dy] = [to.x - from.x, to.y - from.y];
  const size = Math.hypot(dx, dy);
  if (!(size > 2)) return;
  const wide = Math.min(6, 0.08 * size);
  const at = (share, side) => ({ x: from.x + share * dx - (side * wide * dy) / size, y: from.y + share * dy + (side * wide * dx) / size });
  const points = [at(0, 0), at(0.15, 0)];
  for (let i = 0; i < 2 * WINDINGS; i++) points.push(at(0.15 + (0.7 * (i + 0.5)) / (2 * WINDINGS), i % 2 ? -1 : 1));
  points.push(at(0.85, 0), at(1, 0));
  stroke(context, points, { colour: palette.ground, width: 4.5 });
  stroke(context, points, { colour: palette.acting, width: 1.6 });
}

function actingName(context, text, at, align = "left") {
  if (Number.isFinite(at.x)) write(context, text, at.x + (align === "left" ? 8 : -8), at.y + 4, palette.acting, "600 12px system-ui, sans-serif", align);
}

// Springs between points, and forces and moments at points, whose tips are there.
function drawPointForces(context, project, one, view) {
  (content.animation.forces || []).forEach((force, f) => {
    if (force.kind === "spring") {
      const ends = [project(drawnPoint("force_first", f, force.links[0], one, view)), project(drawnPoint("force_place", f, force.links[1], one, view))];
      zigzag(context, ...ends);
      actingName(context, force.name, { x: (ends[0].x + ends[1].x) / 2, y: (ends[0].y + ends[1].y) / 2 });
      return;
    }
    const moment = force.kind === "moment";
    const value = one.motion.read("force_value", f, 3, one.at);
    const size = length(value);
    const full = view.measured[force.kind] || largestValue(f);
    if (!(size > 1e-6 * full)) return;
    const tip = drawnPoint("force_place", f, force.links[0], one, view);
    const from = plus(tip, value, (-view.arrowLength() * Math.min(size / full, 1.25)) / size);
    arrow(context, project(from), project(tip), palette.acting, moment);
    actingName(context, `${force.name} ${withUnit(size, moment ? "N m" : "N", 3)}`, project(from), "right");
  });
}

function largestValue(f) {
  let largest = 0;
  for (const motion of motions) {
    const { shape, values } = motion.parts.force_value;
    for (let t = 0; t < shape[0]; t++) {
      const i = (t * shape[1] + f) * 3;
      largest = Math.max(largest, Math.hypot(values[i], values[i + 1], values[i + 2]) || 0);
    }
  }
  return largest;
}

// Springs and laws in joints: along a motion a zigzag or an arrow, about an axis a spiral or a turned arrow.
function drawJointLaws(context, project, one, view) {
  const { size } = view.measured;
  for (const law of content.animation.laws || []) {
    const j = content.animation.joints.findIndex((joint) => joint.name === law.joint);
    if (j < 0) continue;
    const axes = one.motion.axes(j, one.at, scene.exaggeration);
    const axis = axes["xyz".indexOf(law.motion.slice(-1))] || axes[1];
    const centre = one.motion.centre(j, one.at, scene.exaggeration);
    if (law.motion.startsWith("T")) {
      const seat = one.motion.read("seat_centre", j, 3, one.at);
      const far = length(plus(centre, seat, -1)) > 0.05 * size ? seat : plus(centre, axis, -0.3 * size);
      if (law.spring) zigzag(context, project(far), project(centre));
      else arrow(context, project(plus(centre, axis, -0.2 * size)), project(centre), palette.acting, false);
    } else if (law.spring) spiral(context, project, centre, axis, 0.055 * size);
    else turnMark(context, project, centre, axis, 0.06 * size, 1, palette.acting);
    const at = project(centre);
    actingName(context, law.name, { x: at.x - 6, y: at.y + 22 }, "right");
  }
}

function spiral(context, project, centre, axis, radius) {
  const [first, second] = across(axis);
  const points = [];
  for (let i = 0; i <= 60; i++) {
    const [angle, reach] = [(i / 60) * 5 * Math.PI, radius * (0.2 + (0.8 * i) / 60)];
    points.push(project(plus(plus(centre, first, reach * Math.cos(angle)), second, reach * Math.sin(angle))));
  }
  stroke(context, points, { colour: palette.acting, width: 1.4 });
}
