/** What a person has chosen for all pages in this browser: the clock, and of what to be told. */

import { showPanel } from "./dialogs.js";
import { h } from "./dom.js";

const NAME = "fibaction:settings";
const DEFAULTS = { zone: "local", title: true, sound: false, notification: false };
const NOTICES = { title: "In the title of the page", sound: "By a sound", notification: "By a notification of the system" };

/** The settings, as they are now. */
export const settings = { ...DEFAULTS, ...kept() };

function kept() {
  try {
    return JSON.parse(localStorage.getItem(NAME) ?? "{}");
  } catch {
    return {}; // a browser that keeps nothing
  }
}

function change(name, value, onchange) {
  settings[name] = value;
  try {
    localStorage.setItem(NAME, JSON.stringify(settings));
  } catch {
    // They last as long as the page.
  }
  onchange();
}

/** Show the settings; `onchange` is called with each change. */
export function showSettings(onchange) {
  const zones = { local: "the zone of this computer", UTC: "UTC" };
  const options = Object.entries(zones).map(([value, text]) => h("option", { value, selected: settings.zone === value }, text));
  const zone = h("select", { oninput: () => change("zone", zone.value, onchange) }, ...options);
  const boxes = Object.entries(NOTICES).map(([name, text]) => {
    const box = h("input", { type: "checkbox", checked: settings[name], oninput: () => take(name, box) });
    return h("label", { class: "choice" }, box, ` ${text}`);
  });
  const take = async (name, box) => {
    if (name === "notification" && box.checked) { // which the browser has to permit
      box.checked = (await globalThis.Notification?.requestPermission()) === "granted";
    }
    change(name, box.checked, onchange);
  };
  const told = h("fieldset", {}, h("legend", {}, "When a goal is aborted or a server goes away, tell me"), ...boxes);
  showPanel("Settings", h("div", {}, h("label", { class: "choice" }, "Times in ", zone), told));
}
