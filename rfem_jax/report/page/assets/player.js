// Time of the page: one clock for the animation and all curves.
const SPEEDS = [1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001];

const clock = {
  end: Math.max(0, ...motions.map((one) => one.end), ...(curves ? [...curves.byCase.values()].map((one) => one.times[one.times.length - 1]) : [])),
  step: motions.length ? motions[0].end / Math.max(motions[0].times.length - 1, 1) : 0,
  playing: false, speed: 1, listeners: [],

  set(time) {
    scene.time = Math.min(Math.max(Number(time) || 0, 0), this.end);
    this.listeners.forEach((listener) => listener());
  },

  play(on) {
    if (on === this.playing) return;
    this.playing = on;
    if (on && scene.time >= this.end) scene.time = 0;
    let before = performance.now();
    const next = (now) => {
      if (!this.playing) return;
      const time = scene.time + ((now - before) / 1000) * this.speed;
      before = now;
      this.set(time > this.end ? 0 : time);
      requestAnimationFrame(next);
    };
    if (on) requestAnimationFrame(next);
    this.listeners.forEach((listener) => listener());
  },
};
// Eight seconds for the whole run, at a round speed.
clock.speed = SPEEDS.reduce((best, one) => (Math.abs(Math.log(one * 8 / (clock.end || 1))) < Math.abs(Math.log(best * 8 / (clock.end || 1))) ? one : best), 1);

function speedText(speed) {
  return speed === 1 ? "real time" : `${showNumber(1 / speed, 3)} times slower`;
}

function showTime(time) {
  const digits = clock.end < 1 ? 4 : clock.end < 100 ? 3 : 1;
  return `${time.toFixed(digits)} s`;
}

// When the most loaded case carries its largest moment, or force: the time that the page opens at.
function tellingTime() {
  if (!curves || !content.cases.length) return 0;
  const entry = content.cases[worstCase()];
  for (const load of ["moment", "force"]) {
    let best = { size: 0, time: 0 };
    for (const joint of entry.joints) {
      const quantity = curves.loadOf(joint.name, load);
      const values = quantity && curves.values(entry.name, quantity, -1);
      if (!values) continue;
      const times = curves.times(entry.name);
      values.forEach((size, i) => { if (size > best.size) best = { size, time: times[i] }; });
    }
    if (best.size > 1e-9) return best.time;
  }
  return 0;
}

function playerControls() {
  const play = make("button", { type: "button", id: "play", class: "primary", title: "Space" }, "Play");
  play.addEventListener("click", () => clock.play(!clock.playing));
  const slider = make("input", { type: "range", id: "time", min: 0, max: clock.end, step: clock.end / 2000 || 1, "aria-label": "Time" });
  const readout = make("output", { id: "time-text", class: "readout" });
  slider.addEventListener("input", () => { clock.play(false); clock.set(slider.value); });
  clock.listeners.push(() => {
    play.textContent = clock.playing ? "Pause" : "Play";
    slider.value = scene.time;
    readout.textContent = showTime(scene.time);
    slider.setAttribute("aria-valuetext", readout.textContent);
  });
  const speeds = SPEEDS.map((one) => [String(one), speedText(one)]);
  const speed = choice("Speed", speeds, String(clock.speed), (value) => { clock.speed = Number(value); }, { id: "speed" });
  return make("div", { class: "controls player" }, play, slider, readout, speed);
}

// Keys of the whole page, but where a control has its own.
function listenToKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (["INPUT", "SELECT", "TEXTAREA", "BUTTON"].includes(event.target.tagName) && event.key !== "," && event.key !== ".") return;
    const acts = {
      " ": () => clock.play(!clock.playing),
      ",": () => { clock.play(false); clock.set(scene.time - clock.step); },
      ".": () => { clock.play(false); clock.set(scene.time + clock.step); },
      Home: () => clock.set(0),
      End: () => clock.set(clock.end),
    };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  });
}
