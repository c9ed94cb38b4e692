// Numbers as people read them, with their units.
const DEGREES = 180 / Math.PI;

// A number with some significant digits; other values as the text that they are.
function showNumber(value, digits = 4) {
  if (value === null || value === undefined) return "n/a";
  if (typeof value !== "number") return String(value);
  if (!Number.isFinite(value)) return "n/a";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) return Number(value.toPrecision(digits)).toExponential();
  return String(Number(value.toPrecision(digits)));
}

// A number beside which `size` is the largest one; what is rounding is 0.
function showBeside(value, size, digits) {
  return Number.isFinite(value) && Math.abs(value) < 2e-9 * size ? "0" : showNumber(value, digits);
}

// A number, or another one where there is none.
function numberOr(value, other) {
  return Number.isFinite(value) ? value : other;
}

function withUnit(value, unit, digits) {
  return unit && unit !== "1" ? `${showNumber(value, digits)} ${unit}` : showNumber(value, digits);
}

// Unit of an error as users write it, and the factor to it.
function asSpecified(unit) {
  if (unit === "rad") return ["deg", DEGREES];
  return unit === "m" ? ["mm", 1000] : [unit, 1];
}

function showError(value, unit) {
  const [name, factor] = asSpecified(unit);
  return withUnit(typeof value === "number" ? value * factor : value, name, 4);
}

const COMPONENTS = new Map([
  ["delta_x", "tilt x"], ["delta_y", "turn y"], ["delta_z", "tilt z"],
  ["d_x", "shift x"], ["d_y", "shift y"], ["d_z", "shift z"],
  ["pin_tilt_x", "pin tilt x"], ["pin_tilt_z", "pin tilt z"], ["length", "length"], ["twist", "twist"],
]);

// {owner, child, component, words} of the name of an error, such as "D.child.delta_x".
function readError(name) {
  const parts = String(name).split(".");
  const component = parts[parts.length - 1];
  const child = parts.length > 2 && parts[1] === "child";
  const words = COMPONENTS.get(component) || component;
  return { owner: parts[0], child, component, words: child ? `bore ${words}` : words };
}

function errorWords(error) {
  const { owner, words } = readError(error[0]);
  return `${owner}: ${words} ${showError(error[1], error[2])}`;
}

// Round numbers on an axis from low to high, about `count` of them.
function ticks(low, high, count = 5) {
  if (!(high > low)) return [low];
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  return found.map((one) => Number(one.toPrecision(12)));
}

// Texts of the numbers on an axis, with as many digits as tell neighbours apart.
function tickTexts(values) {
  const steps = values.slice(1).map((value, i) => Math.abs(value - values[i])).filter((step) => step > 0);
  const size = Math.max(...values.map(Math.abs));
  const digits = steps.length && size > 0 ? Math.ceil(Math.log10(size / Math.min(...steps)) - 1e-9) + 1 : 3;
  return values.map((value) => showNumber(value, Math.min(Math.max(digits, 3), 15)));
}

// The largest of 1, 2, 5, 10, ... that is not above a value.
function roundDown(value) {
  if (!(value > 0) || !Number.isFinite(value)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  const steps = [1, 2, 5].map((one) => one * power).filter((one) => one <= value * (1 + 1e-9));
  return steps.length ? Number(Math.max(...steps).toPrecision(3)) : power;
}

function finiteRange(values) {
  let low = Infinity;
  let high = -Infinity;
  for (const one of values) {
    if (one < low) low = one;
    if (one > high) high = one;
  }
  return low <= high ? [low, high] : [0, 1];
}
