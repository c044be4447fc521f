/** The colours of the page: those of the system, light, or dark. */

import { setText } from "./dom.js";

const NAME = "fibaction:theme";
const THEMES = ["system", "light", "dark"];

/** Let a button change the colours; the browser remembers them. Canvases are to be drawn again. */
export function setUpTheme(button, onchange) {
  let theme = "system";
  try {
    theme = localStorage.getItem(NAME) ?? theme;
  } catch {
    // A browser that keeps nothing has the colours of the system.
  }
  const use = (name) => {
    theme = THEMES.includes(name) ? name : "system";
    document.documentElement.dataset.theme = theme;
    setText(button.lastElementChild, theme);
    button.setAttribute("aria-label", `Theme: ${theme}`);
  };
  use(theme);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", onchange);
  button.addEventListener("click", () => {
    use(THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length]);
    try {
      localStorage.setItem(NAME, theme);
    } catch {
      // It lasts as long as the page.
    }
    onchange();
  });
}
