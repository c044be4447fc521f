/** A table of goals, with a search and a filter. */

import { arrange, button, h, markCurrent, setText, show } from "./dom.js";
import { durationOf, linkTo, openLink, shortId, showBadge, stateOf, stepOf, timeOf } from "./goal_text.js";
import { summaryOf } from "./values.js";

const MOST_ROWS = 100;
const FILTERS = {
  all: () => true,
  active: (goal) => goal.isActive,
  ended: (goal) => !goal.isActive,
  "not succeeded": (goal) => !goal.isActive && goal.status !== "SUCCEEDED",
};

/** One goal in a table. */
class Row {
  constructor(record, { withAction, oncancel }) {
    this.link = h("a", { href: linkTo(record.action, record.id) }, shortId(record.id));
    this.step = h("small", { class: "step" });
    this.badge = h("span", { class: "badge" });
    this.bar = h("progress", { max: 1, "aria-label": `Progress of ${shortId(record.id)}` });
    this.goal = h("td", { class: "value" });
    this.time = h("td", { class: "time" });
    this.client = h("td", { class: "client" });
    this.oncancel = oncancel;
    const name = `Cancel ${shortId(record.id)}`;
    this.cancel = button("Cancel", () => this.oncancel(this.record), { class: "quiet", "aria-label": name });
    const action = withAction ? h("td", {}, h("a", { href: linkTo(record.action) }, record.action)) : null;
    this.element = h(
      "tr",
      {},
      h("td", { class: "id" }, this.link, this.step),
      action,
      h("td", { class: "state" }, this.badge, this.bar),
      this.goal,
      this.client,
      this.time,
      h("td", { class: "act" }, this.cancel),
    );
    this.element.addEventListener("click", (event) => {
      if (!event.target.closest("a, button")) {
        window.location.hash = linkTo(record.action, record.id).slice(1);
      }
    });
  }

  update(record, isShown) {
    this.record = record;
    show(this.step, Boolean(record.parent));
    if (record.parent) {
      setText(this.step, `${stepOf(record.parent)} of ${shortId(record.parent.id)}`);
    }
    showBadge(this.badge, record);
    show(this.bar, record.isActive && record.progress !== null);
    this.bar.value = record.progress ?? 0;
    const reason = record.reason ? ` – ${record.reason}` : "";
    setText(this.goal, `${summaryOf(record.goal)}${reason}`);
    setText(this.client, record.isMine ? "this page" : record.client);
    setText(this.time, [timeOf(record.sentAt), durationOf(record.seconds())].filter(Boolean).join(", "));
    show(this.cancel, record.isActive && record.status !== "CANCELING");
    this.element.classList.toggle("current", isShown);
    markCurrent(this.link, isShown);
  }
}

export class GoalList {
  /** Make a table of the goals of one action, or of all if `withAction`. */
  constructor({ withAction, oncancel, oncancelAll, onforget }) {
    this.options = { withAction, oncancel };
    this.mayForget = Boolean(onforget);
    this.rows = new Map();
    this.search = h("input", { type: "search", placeholder: "Search goals", "aria-label": "Search goals", onkeydown: (event) => event.key === "Enter" && this.open() });
    const names = Object.keys(FILTERS).map((name) => h("option", {}, name));
    this.filter = h("select", { "aria-label": "Filter goals" }, ...names);
    this.cancelAll = button("Cancel all", oncancelAll);
    this.forget = button("Clear history", onforget, { class: "quiet" });
    this.body = h("tbody");
    this.note = h("p", { class: "note" });
    const action = withAction ? h("th", { scope: "col" }, "Action") : null;
    const head = h(
      "tr",
      {},
      h("th", { scope: "col" }, "Goal"),
      action,
      ...["State", "Request", "Client", "Time"].map((name) => h("th", { scope: "col", class: `${name.toLowerCase()}-head` }, name)),
      h("th", { scope: "col" }, h("span", { class: "hidden-text" }, "Cancel")),
    );
    const table = h("table", { class: "goals" }, h("caption", { class: "hidden-text" }, "Goals"), h("thead", {}, head), this.body);
    const tools = h("div", { class: "tools" }, this.search, this.filter, h("span", { class: "space" }), this.cancelAll, this.forget);
    this.element = h("section", { class: "card", "aria-label": "Goals" }, h("h2", {}, "Goals"), tools, table, this.note);
  }

  /** Show these goals, the newest first. */
  update(goals, shown) {
    this.latest = [goals, shown];
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const fits = FILTERS[this.filter.value];
    const found = goals.filter((goal) => fits(goal) && matches(goal, words));
    const visible = found.slice(0, MOST_ROWS);
    const keys = new Set(visible.map((goal) => goal.key));
    for (const key of this.rows.keys()) {
      if (!keys.has(key)) {
        this.rows.delete(key);
      }
    }
    const elements = visible.map((goal) => {
      const row = this.rows.get(goal.key) ?? new Row(goal, this.options);
      this.rows.set(goal.key, row);
      row.update(goal, goal.key === shown);
      return row.element;
    });
    arrange(this.body, elements);
    const active = goals.filter((goal) => goal.isActive).length;
    show(this.cancelAll, active > 1);
    show(this.forget, this.mayForget && goals.length > active);
    setText(this.note, noteOf(goals.length, found.length, visible.length));
  }

  /** Open the only goal that matches the search. */
  open() {
    this.update(...this.latest); // the text may be newer than the table
    if (this.search.value && this.body.children.length === 1) {
      openLink(this.neighbour("", 1));
    }
  }

  /** Move to the next or the previous goal, and return its address. */
  neighbour(shown, step) {
    const keys = [...this.body.children].map((row) => row.querySelector(".id a").getAttribute("href"));
    const at = keys.indexOf(shown);
    return keys[Math.min(Math.max(at + step, 0), keys.length - 1)];
  }
}

function matches(goal, words) {
  if (!words.length) {
    return true;
  }
  const { id, action, client, reason, parent } = goal;
  const text = [id, action, stateOf(goal), client, reason, summaryOf(goal.goal, 500), parent?.step, parent?.id]
    .join(" ")
    .toLowerCase();
  return words.every((word) => text.includes(word));
}

function noteOf(all, found, visible) {
  if (!all) {
    return "No goal yet.";
  }
  if (visible < found) {
    return `The newest ${visible} of ${found} goals.`;
  }
  return found < all ? `${found} of ${all} goals.` : "";
}
