/** Colours that colour-blind people tell apart (Okabe and Ito), lighter on dark ground; and the theme's own, read from the CSS. */

const ON_DARK = ["#56b4e9", "#e69f00", "#3ec99b", "#f0e442", "#e58ac0", "#ff8a4c", "#9db8ff", "#c9c9c9"];
const ON_LIGHT = ["#0072b2", "#b46d00", "#007a58", "#7d7500", "#a8467e", "#c04a00", "#3d55b8", "#555555"];

export function isLight(): boolean {
  return document.documentElement.dataset["theme"] === "light";
}

/** The colour of a robot, by its place in the experiment. */
export function robotColour(index: number): string {
  const palette = isLight() ? ON_LIGHT : ON_DARK;
  return palette[index % palette.length] ?? "#888888";
}

/** The same on a white page. */
export function paperColour(index: number): string {
  return ON_LIGHT[index % ON_LIGHT.length]!;
}

const cache = new Map<string, string>();

/** A colour of the style sheet, e.g. "--water". */
export function css(name: string): string {
  const found = cache.get(name) ?? getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  cache.set(name, found);
  return found;
}

export function setTheme(theme: "dark" | "light"): void {
  document.documentElement.dataset["theme"] = theme;
  localStorage.setItem("theme", theme);
  cache.clear();
}

export function startTheme(): void {
  const wanted = localStorage.getItem("theme") ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
  setTheme(wanted === "light" ? "light" : "dark");
}
