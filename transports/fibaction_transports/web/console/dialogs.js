/** Questions to the person at the page: each is a dialog that the browser makes modal. */

import { button, h } from "./dom.js";

function open(title, body, buttons) {
  const heading = h("h2", { id: "dialog-title" }, title);
  const dialog = h("dialog", { "aria-labelledby": "dialog-title" }, heading, body, buttons);
  document.body.append(dialog);
  dialog.addEventListener("close", () => dialog.remove());
  dialog.showModal();
  return dialog;
}

/** Ask a question, with more parts if need be, and return whether the answer is yes. */
export function confirmed(title, text, yes, no, ...parts) {
  return new Promise((resolve) => {
    const answer = (value) => () => {
      dialog.close();
      resolve(value);
    };
    const buttons = h(
      "div",
      { class: "buttons" },
      button(yes, answer(true), { class: "danger" }),
      button(no, answer(false), { autofocus: true }),
    );
    const dialog = open(title, h("div", {}, h("p", {}, text), ...parts), buttons);
    dialog.addEventListener("cancel", () => resolve(false));
  });
}

/** Ask for the access token, and return it. */
export function askToken(reason) {
  return new Promise((resolve) => {
    const input = h("input", { id: "token", type: "password", autocomplete: "off", required: true });
    const form = h(
      "form",
      { method: "dialog" },
      h("p", {}, reason),
      h("label", { for: "token" }, "Access token"),
      input,
      h("div", { class: "buttons" }, h("button", { type: "submit", class: "main" }, "Connect")),
    );
    const dialog = open("This server asks for a token", form, h("span"));
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    dialog.addEventListener("close", () => resolve(input.value));
  });
}

/** Show something that a person closes. */
export function showPanel(title, body) {
  const close = button("Close", () => dialog.close());
  const dialog = open(title, body, h("div", { class: "buttons" }, close));
}

/** Show the keys. */
export function showKeys(keys) {
  const rows = keys.map(([key, text]) => h("tr", {}, h("td", {}, h("kbd", {}, key)), h("td", {}, text)));
  showPanel("Keyboard shortcuts", h("table", { class: "keys" }, h("tbody", {}, ...rows)));
}
