// The band of the paths of a Monte Carlo study: deviations of a point from the path of the perfect mechanism, over time.
const BAND_PARTS = [["along", "along the path"], ["across", "across the path"], ["out_of_plane", "out of the plane"]];

// [{key, label, x, y, band, lines}] of every point and part whose numbers are whole, in mm.
function readBands(result) {
  const found = [];
  for (const [point, one] of asEntries(result.path_bands)) {
    for (const [part, words] of BAND_PARTS) {
      const ends = (one && one[part]) || {};
      const lists = [(one || {}).time, ends.low, ends.high, ends.smallest, ends.largest];
      if (!lists.every((list) => finiteList(list) && list.length === lists[0].length)) continue;
      const [time, ...curves] = lists.map((list) => list.map((value) => (value === null ? NaN : value)));
      const [low, high, smallest, largest] = curves.map((list) => list.map((value) => 1000 * value));
      const middle = low.map((value, i) => 0.5 * (value + high[i]));
      found.push({ key: `${point} ${part}`, label: `${point}, ${words}`, level: one.level, samples: one.samples, series: [
        { name: "middle of the band", x: time, y: middle, band: [low, high] },
        { name: "envelope, lower end", x: time, y: smallest, class: "curve case-1", dash: [6, 3] },
        { name: "envelope, upper end", x: time, y: largest, class: "curve case-1", dash: [6, 3] },
      ] });
    }
  }
  return found;
}

function bandSection(result) {
  const bands = readBands(result);
  if (!bands.length) return null;
  const holder = make("div", { id: "bands" });
  const show = (key) => {
    const one = bands.find((band) => band.key === key);
    clear(holder).append(lineChart(one.series, "time, s", "deviation, mm", `Deviation of ${one.label}`, { width: 760, height: 320 }),
      make("p", { class: "hint" }, `${showNumber(one.samples)} samples; between the edges of the band are ${showNumber(100 * one.level, 3)} % of them, dashed is the envelope of all.`));
  };
  const widest = bands.reduce((a, b) => (reach(b) > reach(a) ? b : a)).key;
  show(widest);
  return section("Paths", choice("Deviation of", bands.map((one) => [one.key, one.label]), widest, show, { id: "band-of" }), holder);
}

function reach(band) {
  return Math.max(...band.series.slice(1).flatMap((one) => one.y.filter(Number.isFinite).map(Math.abs)), 0);
}
