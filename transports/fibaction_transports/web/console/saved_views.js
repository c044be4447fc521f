/** Views that a person has saved in this browser: names for addresses within the page. */

import { button, h } from "./dom.js";

const KEY = "fibaction:views";
const MOST_VIEWS = 50;

export class SavedViews {
  constructor(storage = window.localStorage) {
    this.storage = storage;
    this.name = h("input", { type: "text", "aria-label": "Name of the view", placeholder: "Name", maxlength: 60, required: true });
    this.list = h("ul", { class: "views" });
    const form = h("form", { class: "tools", onsubmit: (event) => this.save(event) }, this.name, h("button", { type: "submit" }, "Save this view"));
    this.element = h("details", { class: "more" }, h("summary", {}, "Views"), this.list, form);
    this.show();
  }

  get views() {
    try {
      return JSON.parse(this.storage.getItem(KEY) ?? "[]");
    } catch {
      return []; // of another version, or the browser keeps nothing
    }
  }

  save(event) {
    event.preventDefault();
    const others = this.views.filter(({ name }) => name !== this.name.value);
    this.keep([...others, { name: this.name.value, address: window.location.hash || "#/" }].slice(-MOST_VIEWS));
    this.name.value = "";
  }

  keep(views) {
    try {
      this.storage.setItem(KEY, JSON.stringify(views));
    } catch {
      // A private window, or the storage is full.
    }
    this.show();
  }

  show() {
    const items = this.views.map(({ name, address }) => {
      const remove = button("Remove", () => this.keep(this.views.filter((view) => view.name !== name)), { class: "quiet", "aria-label": `Remove the view ${name}` });
      return h("li", {}, h("a", { href: address }, name), " ", remove);
    });
    this.list.replaceChildren(...items);
  }
}
