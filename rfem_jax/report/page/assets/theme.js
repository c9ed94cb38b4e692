// Light and dark, and the colours of cases: M. Okabe, K. Ito, "Color universal design" (2008), lighter on dark ground.
const CASE_COLOURS = {
  light: ["#1a1a1a", "#c24e00", "#0072b2", "#b07a00", "#00805d", "#b0578a", "#3a8fc0"],
  dark: ["#f2f2f2", "#ff8b45", "#4fb0ee", "#f0b93a", "#3cc79c", "#e59ac4", "#9fd6f7"],
};
const DASHES = [[], [7, 4], [9, 3, 2, 3], [2, 3], [12, 4], [12, 3, 2, 3, 2, 3], [4, 2]];

const theme = { wanted: "auto", printing: false, listeners: [] };
const darkWanted = window.matchMedia("(prefers-color-scheme: dark)");

function isDark() {
  if (theme.printing) return false;
  return theme.wanted === "auto" ? darkWanted.matches : theme.wanted === "dark";
}

function caseColour(index) {
  const colours = CASE_COLOURS[isDark() ? "dark" : "light"];
  return colours[index % colours.length];
}

function caseDash(index) {
  return DASHES[(index + Math.floor(index / CASE_COLOURS.light.length)) % DASHES.length];
}

// Colours of the style sheet, by the names of its properties.
let palette = {};

function readPalette() {
  document.documentElement.dataset.theme = isDark() ? "dark" : "light";
  const style = getComputedStyle(document.documentElement);
  const names = ["ink", "quiet", "faint", "line", "ground", "card", "force", "moment", "error", "acting", "accent", "axis-x", "axis-y", "axis-z"];
  palette = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function themeChanged() {
  readPalette();
  theme.listeners.forEach((listener) => listener());
}

function themeSwitch() {
  return switcher("Colours", [["auto", "Auto"], ["light", "Light"], ["dark", "Dark"]], theme.wanted, (value) => {
    theme.wanted = value;
    themeChanged();
  }, { id: "theme" });
}

darkWanted.addEventListener("change", themeChanged);
window.addEventListener("beforeprint", () => { theme.printing = true; themeChanged(); });
window.addEventListener("afterprint", () => { theme.printing = false; themeChanged(); });
readPalette();
