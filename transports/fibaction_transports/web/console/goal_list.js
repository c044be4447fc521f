/** A table of goals, with a choice of goals, older ones from the server, and files of them. */

import { arrange, button, h, markCurrent, setText, show } from "./dom.js";
import { csvOf, jsonOf, saveFile } from "./goal_export.js";
import { GoalFilter, labelsOf } from "./goal_filter.js";
import { durationOf, linkTo, openLink, shortId, showBadge, stepOf, timeOf } from "./goal_text.js";
import { summaryOf } from "./values.js";

const MOST_ROWS = 100;
/** One goal in a table. */
class Row {
  constructor(record, { withAction, oncancel }) {
    this.link = h("a", { href: linkTo(record.action, record.id) }, shortId(record.id));
    this.step = h("small", { class: "step" });
    this.badge = h("span", { class: "badge" });
    this.bar = h("progress", { max: 1, "aria-label": `Progress of ${shortId(record.id)}` });
    this.request = h("span");
    this.labels = h("small", { class: "labels" });
    this.goal = h("td", { class: "value" }, this.request, this.labels);
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
        openLink(this.link.getAttribute("href"), false);
      }
    });
  }

  update(record, isShown, query) {
    this.record = record;
    const address = linkTo(record.action, record.id) + query;
    if (this.link.getAttribute("href") !== address) {
      this.link.setAttribute("href", address);
    }
    show(this.step, Boolean(record.parent));
    if (record.parent) {
      setText(this.step, `${stepOf(record.parent)} of ${shortId(record.parent.id)}`);
    }
    showBadge(this.badge, record);
    show(this.bar, record.isActive && record.progress !== null);
    this.bar.value = record.progress ?? 0;
    const reason = record.reason ? ` – ${record.reason}` : "";
    setText(this.request, `${summaryOf(record.goal)}${reason}`);
    const labels = labelsOf(record);
    show(this.labels, labels.length > 0);
    setText(this.labels, labels.join(" "));
    setText(this.client, record.isMine ? "this page" : record.client);
    if (this.sentAt !== record.sentAt) {
      this.sentAt = record.sentAt;
      this.clock = timeOf(record.sentAt);
    }
    setText(this.time, [this.clock, durationOf(record.seconds())].filter(Boolean).join(", "));
    show(this.cancel, record.isActive && record.status !== "CANCELING");
    this.element.classList.toggle("current", isShown);
    markCurrent(this.link, isShown);
  }
}

export class GoalList {
  /** Make a table of the goals of one action, or of all if `withAction`. */
  constructor({ withAction, oncancel, oncancelAll, onforget, onmore, onfilter }) {
    this.options = { withAction, oncancel };
    this.mayForget = Boolean(onforget);
    this.rows = new Map();
    this.most = MOST_ROWS;
    this.filter = new GoalFilter(onfilter);
    this.search = this.filter.search;
    this.search.addEventListener("keydown", (event) => event.key === "Enter" && this.open());
    this.cancelAll = button("Cancel all", oncancelAll);
    this.forget = button("Clear list", onforget, { class: "quiet" });
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
    const tools = h("div", { class: "tools" }, this.search, this.filter.state, h("span", { class: "space" }), this.cancelAll, this.forget);
    this.older = button("Older goals", () => {
      this.most += MOST_ROWS;
      onmore?.();
    });
    this.past = h("span", { class: "note", role: "status" });
    const files = [button("Save as JSON", () => this.save("json", jsonOf), { class: "quiet" }), button("Save as CSV", () => this.save("csv", csvOf), { class: "quiet" })];
    const foot = h("div", { class: "buttons" }, this.older, this.past, h("span", { class: "space" }), ...files);
    this.element = h("section", { class: "card", "aria-label": "Goals" }, h("h2", {}, "Goals"), tools, this.filter.more, table, this.note, foot);
  }

  /** Show these goals, the newest first, and what is told of those of the past. */
  update(goals, shown, past = "") {
    this.latest = [goals, shown, past];
    const { query } = this.filter;
    const found = goals.filter(this.filter.reader());
    const visible = found.slice(0, this.most);
    this.found = found;
    setText(this.past, past);
    const keys = new Set(visible.map((goal) => goal.key));
    for (const key of this.rows.keys()) {
      if (!keys.has(key)) {
        this.rows.delete(key);
      }
    }
    const elements = visible.map((goal) => {
      const row = this.rows.get(goal.key) ?? new Row(goal, this.options);
      this.rows.set(goal.key, row);
      row.update(goal, goal.key === shown, query);
      return row.element;
    });
    arrange(this.body, elements);
    const active = goals.filter((goal) => goal.isActive).length;
    show(this.cancelAll, active > 1);
    show(this.forget, this.mayForget && goals.length > active);
    show(this.older, this.mayForget || visible.length < found.length);
    setText(this.note, noteOf(goals.length, found.length, visible.length));
  }

  /** Save the goals of the list, also those that it has no row for. */
  save(ending, textIn) {
    saveFile(`goals.${ending}`, textIn(this.found), ending === "csv" ? "text/csv" : "application/json");
  }

  /** Open the only goal that matches the search. */
  open() {
    this.update(...this.latest); // the text may be newer than the table
    if (this.search.value && this.body.children.length === 1) {
      openLink(this.neighbour(1));
    }
  }

  /** Move to the next or the previous goal, and return its address. */
  neighbour(step) {
    const links = [...this.body.children].map((row) => row.querySelector(".id a"));
    const at = links.findIndex((link) => link.hasAttribute("aria-current"));
    return links[Math.min(Math.max(at + step, 0), links.length - 1)]?.getAttribute("href");
  }
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
