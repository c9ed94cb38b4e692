// The mechanism on its canvas: cases side by side or over each other, with what is switched on.
const scene = {
  time: 0, exaggeration: 1, layout: "beside", cases: new Set(), joints: new Set(), arrowSize: 1,
  forces: true, moments: true, acting: true, frames: false, errors: true, perfect: true,
};

// The mechanism's size [m], the round factor that shows its deviations, the scales of arrows.
function measureScene() {
  const extents = motions.map((one) => one.extent()).filter((one) => Number.isFinite(one.low[0]));
  const low = [0, 1, 2].map((k) => Math.min(...extents.map((one) => one.low[k])));
  const high = [0, 1, 2].map((k) => Math.max(...extents.map((one) => one.high[k])));
  const centre = scaled(plus(low, high), 0.5);
  const size = Math.max(length(plus(high, low, -1)), 1e-9);
  const largest = Math.max(...extents.map((one) => one.largest));
  const factor = largest > 1e-7 * size ? roundDown((0.15 * size) / largest) : 1;
  const half = plus(scaled(plus(high, low, -1), 0.5), [1, 1, 1], 0.04 * size);
  return { centre, half, size, largest, factor: Math.max(factor, 1), force: arrowScale("force"), moment: arrowScale("moment") };
}

// The load that an arrow of full length stands for: nearly the largest of all, so that a single peak does not decide.
function arrowScale(load) {
  const sizes = [];
  for (const one of content.animation.joints) {
    const quantity = curves && curves.loadOf(one.name, load);
    if (!quantity) continue;
    for (const entry of content.cases) {
      const values = curves.values(entry.name, quantity, -1);
      if (values) sizes.push(...Array.from(values).filter(Number.isFinite).sort((a, b) => b - a).slice(0, 40));
    }
  }
  sizes.sort((a, b) => b - a);
  return sizes.length ? sizes[Math.min(10, sizes.length - 1)] : 0;
}

class MechanismView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.measured = measureScene();
    this.camera = new Camera(this.measured.centre, this.measured.half, content.animation.plane);
    this.camera.attach(canvas, () => this.draw());
    scene.exaggeration = this.measured.factor;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  // The cases that are shown, as numbers.
  shown() {
    return content.animation.cases.map((_, i) => i).filter((i) => scene.cases.has(i));
  }

  panels() {
    const shown = this.shown();
    const { width, height } = this.box;
    if (scene.layout === "over" || shown.length < 2) return [{ x: 0, y: 0, width, height, cases: shown }];
    let columns = Math.max(1, Math.min(shown.length, Math.round(Math.sqrt((shown.length * width) / height / 1.2))));
    if (shown.length === 2) columns = width > 1.1 * height ? 2 : 1;
    const rows = Math.ceil(shown.length / columns);
    return shown.map((index, i) => ({
      x: (width / columns) * (i % columns), y: (height / rows) * Math.floor(i / columns),
      width: width / columns, height: height / rows, cases: [index],
    }));
  }

  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth) return;
    if (this.canvas.width !== Math.round(clientWidth * ratio) || this.canvas.height !== Math.round(clientHeight * ratio)) {
      this.canvas.width = Math.round(clientWidth * ratio);
      this.canvas.height = Math.round(clientHeight * ratio);
    }
    this.box = { width: clientWidth, height: clientHeight };
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = palette.ground;
    context.fillRect(0, 0, clientWidth, clientHeight);
    const panels = this.panels();
    for (const panel of panels) {
      context.save();
      context.beginPath();
      context.rect(panel.x, panel.y, panel.width, panel.height);
      context.clip();
      this.drawPanel(panel);
      context.restore();
      if (panels.length > 1) {
        context.strokeStyle = palette.line;
        context.lineWidth = 1;
        context.strokeRect(panel.x + 0.5, panel.y + 0.5, panel.width, panel.height);
      }
    }
    this.drawLegend();
  }

  drawPanel(panel) {
    const context = this.context;
    const project = this.camera.projection(panel);
    const actors = panel.cases.map((index) => ({ index, motion: motions[index], at: motions[index].seek(scene.time) }));
    if (scene.perfect) for (const one of actors) this.drawPerfect(project, one);
    for (const one of actors) this.drawPaths(project, one);
    for (const one of actors) this.drawLinks(project, one);
    for (const one of actors) drawArms(context, project, one, this);
    if (scene.acting) for (const one of actors) drawPointForces(context, project, one, this);
    for (const one of actors) this.drawJoints(project, one);
    if (scene.acting) for (const one of actors) drawJointLaws(context, project, one, this);
    if (scene.frames) for (const one of actors) this.drawFrames(project, one);
    if (scene.errors) for (const one of actors) this.drawErrorMarks(project, one);
    for (const one of actors) this.drawLoads(project, one);
    if (actors.length) this.drawNames(project, actors[0]);
    if (scene.errors) this.drawNotes(project, panel, actors);
    panel.cases.forEach((index, i) => {
      const entry = content.cases.find((one) => one.name === content.animation.cases[index]);
      const without = entry && entry.errors.every((error) => !error[1]);
      const y = panel.y + 24 + 20 * i;
      stroke(context, [{ x: panel.x + 14, y: y - 5 }, { x: panel.x + 36, y: y - 5 }],
        { colour: caseColour(index), width: 4, dash: caseDash(index) });
      const words = `${shownCase(content.animation.cases[index])}${without ? ", no errors" : ""}`;
      write(context, words, panel.x + 44, y, palette.ink, "600 14px system-ui, sans-serif");
    });
    if (!actors.length) {
      write(context, "No case is switched on", panel.x + panel.width / 2, panel.y + panel.height / 2, palette.quiet, "14px system-ui, sans-serif", "center");
    }
  }

  // Points along all links with deviations times a factor; kept, since much hangs on them.
  lines(one, factor) {
    one.drawn = one.drawn || new Map();
    if (!one.drawn.has(factor)) {
      let first = 0;
      one.drawn.set(factor, content.animation.links.map((link) => {
        const line = Array.from({ length: link.points }, (_, i) => one.motion.point(first + i, one.at, factor));
        first += link.points;
        return line;
      }));
    }
    return one.drawn.get(factor);
  }

  // Paths of points: of the case with exaggerated deviations, of the perfect mechanism dashed, and where the point is.
  drawPaths(project, one) {
    const colour = caseColour(one.index);
    (content.animation.paths || []).forEach(({ name, link }, p) => {
      if (scene.perfect) stroke(this.context, one.motion.path(p, 0).map(project), { colour: palette.faint, width: 1.4, dash: [4, 4] });
      stroke(this.context, one.motion.path(p, scene.exaggeration).map(project), { colour, width: 1.6 });
      const here = project(one.motion.pathPoint(p, one.at, scene.exaggeration));
      if (!Number.isFinite(here.x)) return;
      const foot = this.footOfPath(p, link, one);
      if (foot) stroke(this.context, [project(foot), here], { colour, width: 2.4 });
      disc(this.context, here, 4, colour, palette.ground);
      write(this.context, name, here.x + 8, here.y + 14, palette.ink, "700 13px system-ui, sans-serif");
    });
  }

  // Where the arm of a path's point leaves the line of its link, null where the point is on it.
  footOfPath(p, link, one) {
    const l = content.animation.links.findIndex((each) => each.name === link);
    const { motion } = one;
    motion.feetOfPaths = motion.feetOfPaths || new Map();
    if (!motion.feetOfPaths.has(p)) {
      motion.feetOfPaths.set(p, l < 0 ? null : nearestOn(this.lines({ motion, at: START }, 0)[l], motion.pathPoint(p, START, 0)));
    }
    const place = motion.feetOfPaths.get(p);
    return place && place.distance > ARM * this.measured.size ? onLine(this.lines(one, scene.exaggeration)[l], place) : null;
  }

  drawPerfect(project, one) {
    for (const line of this.lines(one, 0)) {
      stroke(this.context, line.map(project), { colour: palette.faint, width: 2, dash: [4, 4] });
    }
  }

  drawLinks(project, one) {
    const colour = caseColour(one.index);
    const places = this.lines(one, scene.exaggeration).map((line) => line.map(project));
    if (scene.perfect) {
      this.lines(one, 0).forEach((line, l) => line.forEach((point, i) => {
        const [from, to] = [project(point), places[l][i]];
        if (Math.hypot(to.x - from.x, to.y - from.y) > 3) stroke(this.context, [from, to], { colour, width: 0.8 });
      }));
    }
    const dash = scene.layout === "over" ? caseDash(one.index).map((part) => 2 * part) : [];
    for (const line of places) stroke(this.context, line, { colour: palette.ground, width: 8 });
    for (const line of places) stroke(this.context, line, { colour, width: 4.5, dash: dash.length ? dash : null });
  }

  drawJoints(project, one) {
    content.animation.joints.forEach((joint, j) => {
      const centre = one.motion.centre(j, one.at, scene.exaggeration);
      const axes = one.motion.axes(j, one.at, scene.exaggeration);
      jointSymbol(this.context, project, joint, centre, axes, this.measured.size);
    });
  }

  drawFrames(project, one) {
    content.animation.joints.forEach((joint, j) => {
      if (!scene.joints.has(joint.name)) return;
      const centre = one.motion.centre(j, one.at, scene.exaggeration);
      jointFrame(this.context, project, centre, one.motion.axes(j, one.at, scene.exaggeration), this.measured.size);
    });
  }

  drawLoads(project, one) {
    const name = content.animation.cases[one.index];
    for (const load of ["force", "moment"]) {
      const full = this.measured[load];
      if (!scene[`${load}s`] || !(full > 0) || !curves) continue;
      content.animation.joints.forEach((joint, j) => {
        const quantity = scene.joints.has(joint.name) && curves.loadOf(joint.name, load);
        const times = curves.times(name);
        if (!quantity || !times) return;
        const parts = [0, 1, 2].map((part) => valueAt(times, curves.values(name, quantity, part), scene.time));
        const size = length(parts);
        if (!(size > 1e-6 * full)) return;
        const vector = combine(one.motion.axes(j, one.at), parts);
        const reach = (this.arrowLength() * Math.min(size / full, 1.25)) / size;
        const centre = one.motion.centre(j, one.at, scene.exaggeration);
        arrow(this.context, project(centre), project(plus(centre, vector, reach)), palette[load], load === "moment");
      });
    }
  }

  // Length [m] of an arrow of full size.
  arrowLength() {
    return 0.24 * this.measured.size * scene.arrowSize;
  }

  drawNames(project, one) {
    content.animation.joints.forEach((joint, j) => {
      const at = project(one.motion.centre(j, one.at, scene.exaggeration));
      if (Number.isFinite(at.x)) write(this.context, joint.name, at.x + 9, at.y - 9, palette.ink, "700 14px system-ui, sans-serif");
    });
  }

  // Where an error sits: centre and axes in space, or null.
  seat(one, read) {
    const j = content.animation.joints.findIndex((joint) => joint.name === read.owner);
    if (j >= 0) {
      const axes = read.child ? one.motion.boreAxes(j, one.at) : one.motion.seatAxes(j, one.at);
      return { centre: one.motion.centre(j, one.at, scene.exaggeration), axes };
    }
    const l = content.animation.links.findIndex((link) => link.name === read.owner);
    if (l < 0) return null;
    const line = this.lines(one, scene.exaggeration)[l];
    const along = unit(plus(line[line.length - 1], line[0], -1));
    return { centre: line[Math.floor(line.length / 2)], axes: [along, ...across(along)] };
  }

  errorsOf(one) {
    const entry = content.cases.find((each) => each.name === content.animation.cases[one.index]);
    return entry ? entry.errors.filter((error) => error[1]) : [];
  }

  drawErrorMarks(project, one) {
    for (const error of this.errorsOf(one)) {
      const read = readError(error[0]);
      const seat = this.seat(one, read);
      if (seat && typeof error[1] === "number") {
        errorMark(this.context, project, seat.centre, seat.axes, read, error[1], this.measured.size);
      }
    }
  }

  // Notes with the sizes of errors, beside what they sit on.
  drawNotes(project, panel, actors) {
    let y = panel.y + panel.height - 12;
    const several = actors.length > 1;
    for (const one of [...actors].reverse()) {
      const owners = new Map();
      for (const error of this.errorsOf(one)) {
        const read = readError(error[0]);
        const lines = owners.get(read.owner) || [];
        owners.set(read.owner, [...lines, `${read.words} ${showError(error[1], error[2])}`]);
      }
      for (const [owner, lines] of [...owners].reverse()) {
        const seat = this.seat(one, readError(`${owner}.`));
        const titled = [`${several ? `${content.animation.cases[one.index]}: ` : ""}errors at ${owner}`, ...lines];
        y -= 16 * titled.length + 14;
        const at = seat ? project(seat.centre) : { x: NaN, y: NaN };
        const below = Number.isFinite(at.y) && !several ? Math.min(Math.max(at.y + 34, panel.y + 40), y) : y;
        note(this.context, titled, at, panel.x + panel.width - 172, below, palette.error);
      }
    }
  }

  drawLegend() {
    const context = this.context;
    const { height } = this.box;
    const project = this.camera.projection(this.panels()[0] || { x: 0, y: 0, ...this.box });
    let y = height - 16;
    for (const [load, unitName] of [["moment", "N m"], ["force", "N"]]) {
      const full = this.measured[load];
      if (!scene[`${load}s`] || !(full > 0)) continue;
      const value = roundDown(0.45 * full / Math.max(scene.arrowSize, 0.2));
      const pixels = (project.pixels * this.arrowLength() * value) / full;
      arrow(context, { x: 14, y: y - 4 }, { x: 14 + pixels, y: y - 4 }, palette[load], load === "moment");
      write(context, `${load} ${showNumber(value, 3)} ${unitName}`, 22 + pixels, y, palette[load], "600 12px system-ui, sans-serif");
      y -= 20;
    }
    const centre = { x: 34, y: y - 26 };
    ["x", "y", "z"].forEach((letter, i) => {
      const axis = [0, 1, 2].map((k) => Number(k === i));
      const flat = (d) => d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2];
      const tip = { x: centre.x + 20 * flat(project.right), y: centre.y - 20 * flat(project.up) };
      stroke(context, [centre, tip], { colour: palette.quiet, width: 1.4 });
      write(context, letter, tip.x + 2, tip.y + 4, palette.quiet, "11px system-ui, sans-serif");
    });
  }
}
