// The view of the mechanism: orbit by drag, zoom by wheel or two fingers, shift by drag with Shift or the right button.
const VIEWS = {
  oblique: [-1.12, 0.3], front: [-Math.PI / 2, 0], side: [0, 0], top: [-Math.PI / 2, Math.PI / 2 - 1e-4],
};

class Camera {
  // `half`: half the sides [m] of a box around all that moves; `plane`: "xy" of a mechanism that is seen from where its
  // figure is.
  constructor(centre, half, plane) {
    const views = plane === "xy" ? { ...VIEWS, oblique: [-Math.PI / 2, 1.15] } : VIEWS;
    Object.assign(this, { centre, half, views, radius: length(half), perspective: false });
    this.reset();
  }

  reset() {
    this.zoom = 1;
    this.look("oblique");
  }

  look(view) {
    [this.yaw, this.pitch] = this.views[view];
    this.shift = [0, 0];
    this.fit = this.reach();
  }

  // Directions to the right, upwards and towards the eye.
  axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return { right: [-sy, cy, 0], up: [-sp * cy, -sp * sy, cp], towards: [cp * cy, cp * sy, sp] };
  }

  // How far [m] the box reaches from its centre to the side and upwards.
  reach() {
    const { right, up } = this.axes();
    const along = (axis) => axis.reduce((sum, part, k) => sum + Math.abs(part) * this.half[k], 0);
    return [along(right), along(up)].map((size) => Math.max(size, 0.25 * this.radius));
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -Math.PI / 2 + 1e-4), Math.PI / 2 - 1e-4);
  }

  zoomBy(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 40);
  }

  // A function from a point in space [m] to {x, y, depth, scale} in pixels of a panel.
  projection(panel) {
    const { right, up, towards } = this.axes();
    const room = [Math.max(panel.width - 90, 60), Math.max(panel.height - 130, 60)];
    const pixels = 0.5 * this.zoom * Math.min(room[0] / this.fit[0], room[1] / this.fit[1]);
    const away = 4 * this.radius;
    const at = [panel.x + panel.width / 2 + this.shift[0], panel.y + panel.height / 2 + this.shift[1]];
    const project = (point) => {
      const d = plus(point, this.centre, -1);
      const depth = d[0] * towards[0] + d[1] * towards[1] + d[2] * towards[2];
      const size = this.perspective ? away / Math.max(away - depth, 0.1 * away) : 1;
      return {
        x: at[0] + pixels * size * (d[0] * right[0] + d[1] * right[1] + d[2] * right[2]),
        y: at[1] - pixels * size * (d[0] * up[0] + d[1] * up[1] + d[2] * up[2]),
        depth,
      };
    };
    return Object.assign(project, { pixels, right, up, towards });
  }

  attach(canvas, changed) {
    const pointers = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const lift = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]);
        this.zoomBy(apart([event.clientX, event.clientY]) / Math.max(apart(before), 1));
        this.shift = [this.shift[0] + dx / 2, this.shift[1] + dy / 2];
      } else if (event.shiftKey || event.buttons === 2) {
        this.shift = [this.shift[0] + dx, this.shift[1] + dy];
      } else {
        this.turn(-0.008 * dx, 0.008 * dy);
      }
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      changed();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-0.0012 * event.deltaY));
      changed();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      if (turns[event.key]) this.turn(...turns[event.key]);
      else if (event.key === "+" || event.key === "=") this.zoomBy(1.2);
      else if (event.key === "-") this.zoomBy(1 / 1.2);
      else return;
      event.preventDefault();
      event.stopPropagation();
      changed();
    });
  }
}
