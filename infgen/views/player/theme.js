// Colours come from the style sheet, so that light and dark are decided in one place.

/** The colours that are in force now, by name. */
export function readColours(names) {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  return Object.fromEntries(names.map((name) => [name, read(name)]));
}

/** Whether the page is dark, by its own switch or else by the system's. */
export function isDark() {
  const own = document.documentElement.dataset.theme;
  return own ? own === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

export function toggleTheme() {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
}
