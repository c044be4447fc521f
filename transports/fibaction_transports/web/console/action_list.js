/** The list of actions, with the number of active goals of each. */

import { shapeOf } from "./action_shape.js";
import { arrange, h, markCurrent, setText, show } from "./dom.js";
import { breakable, linkTo, openLink } from "./goal_text.js";
import { isWithin, namespacesOf } from "./scope.js";

export class ActionList {
  constructor(store) {
    this.store = store;
    this.items = new Map();
    this.search = h("input", { type: "search", placeholder: "Search actions", "aria-label": "Search actions", oninput: () => this.update(), onkeydown: (event) => event.key === "Enter" && this.open() });
    this.all = this.item("", "All actions");
    this.servers = this.item("", "Servers", "#servers");
    this.map = this.item("", "Map", "#map");
    this.list = h("ul", {});
    this.note = h("p", { class: "note" });
    this.elements = [this.search, this.list, this.note];
  }

  item(name, text, href = name ? linkTo(name) : "#/") {
    const count = h("span", { class: "count" });
    const link = h("a", { href }, breakable(text), count);
    return { link, count, element: h("li", {}, link) };
  }

  update() {
    const { actions, goals, shown } = this.store;
    const word = this.search.value.toLowerCase();
    const active = new Map();
    for (const goal of goals.values()) {
      if (goal.isActive) {
        active.set(goal.action, (active.get(goal.action) ?? 0) + 1);
      }
    }
    const names = [...actions.keys()].sort().filter((name) => name.toLowerCase().includes(word));
    const shownItems = names.map((name) => this.shownItem(name, this.store.awayOf(name) ? "away" : this.stateOf(name, active.get(name))));
    const { servers } = this.store;
    for (const namespace of namespacesOf(names, word ? [] : servers)) {
      const isAway = servers.some(({ name, away }) => away && `${name}/` === namespace);
      const heading = this.shownItem(namespace, isAway ? "away" : 0);
      heading.classList.add("namespace");
      const at = names.findIndex((name) => isWithin(name, namespace));
      shownItems.splice(at < 0 ? shownItems.length : shownItems.indexOf(this.items.get(names[at]).element), 0, heading);
    }
    this.mark(this.all, !shown.action && !this.store.view);
    this.mark(this.servers, this.store.view === "#servers", servers.some(({ away }) => away) ? "away" : 0);
    this.mark(this.map, this.store.view === "#map");
    const isMapped = servers.length || [...actions.values()].some((info) => shapeOf(info).places.feedback.length);
    const views = [this.all, ...(servers.length ? [this.servers] : []), ...(isMapped ? [this.map] : [])];
    arrange(this.list, [...views.map(({ element }) => element), ...shownItems]);
    this.names = names;
    this.reveal(shown.action);
    show(this.note, names.length === 0);
    const none = this.store.isDescribed ? "No action is served." : "Not connected yet.";
    setText(this.note, actions.size ? "No action has this name." : none);
  }

  /** Scroll the list to the action that is shown from now on, if the list has a part in view only. */
  reveal(name) {
    const [link, place] = [this.items.get(name)?.link, this.list.parentElement];
    if (name !== this.revealed && link?.isConnected) {
      this.revealed = name;
      const isInView = link.offsetTop >= place.scrollTop && link.offsetTop + link.offsetHeight <= place.scrollTop + place.clientHeight;
      if (!isInView && link.offsetParent === place) {
        place.scrollTop = link.offsetTop - place.clientHeight / 2;
      }
    }
  }

  /** Return that an action is paused or drains, or else the number of its active goals. */
  stateOf(name, active) {
    const mode = this.store.intakes.get(name)?.mode;
    return mode ? (mode === "drain" ? "drains" : "paused") : active;
  }

  /** Return the line of an action or of a namespace, with its state. */
  shownItem(name, state) {
    const item = this.items.get(name) ?? this.item(name, name);
    this.items.set(name, item);
    this.mark(item, name === this.store.shown.action && !this.store.view, state);
    return item.element;
  }

  /** Open the only action that matches the search, or the one of exactly that name. */
  open() {
    const word = this.search.value.toLowerCase();
    const [name] = this.names.length === 1 ? this.names : this.names.filter((one) => one.toLowerCase() === word);
    if (name && word) {
      openLink(linkTo(name));
    }
  }

  /** Show whether the server of an action is away, or else how many of its goals are active. */
  mark(item, isShown, state) {
    markCurrent(item.link, isShown, "page");
    show(item.count, Boolean(state));
    item.count.classList.toggle("away", typeof state === "string");
    setText(item.count, typeof state === "number" ? `${state} active` : (state ?? ""));
  }
}
