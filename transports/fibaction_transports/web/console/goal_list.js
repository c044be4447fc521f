/** A table of goals, page by page: those that a person wants, in the order and with the columns chosen. */

import { ChosenGoals } from "./chosen_goals.js";
import { arrange, button, h, markCurrent, setText, show } from "./dom.js";
import { FoundGoals } from "./found_goals.js";
import { Cell, headOf, showsRequest, sortOf, widthOf } from "./goal_columns.js";
import { GoalFilter } from "./goal_filter.js";
import { linkTo, openLink, shortId, stepOf } from "./goal_text.js";
import { ListLayout } from "./list_layout.js";
import { SavedViews } from "./saved_views.js";

const [BOX, ID, ACT] = [34, 104, 80]; // the shares of the width of the columns that each list has
const LEAST = 0.83;
const AGES = 500; // milliseconds between two changes of ages, which all rows have at once
const NEAR = "300px";

/** Tells rows whether they are in view, or nearly. */
class Sight {
  constructor(onchange) {
    this.rows = new WeakMap();
    this.observer = new IntersectionObserver((entries) => {
      entries.forEach(({ target, isIntersecting }) => {
        this.rows.get(target).isInView = isIntersecting;
      });
      onchange();
    }, { rootMargin: NEAR });
  }

  add(row) {
    this.rows.set(row.element, row);
    this.observer.observe(row.element);
  }

  remove(row) {
    this.observer.unobserve(row.element);
  }
}

/** One goal in a table, which is written when it changes; its age and its progress only in view. */
class Row {
  constructor(record, columns, { oncancel, onchoose, onclient }) {
    this.link = h("a", { href: linkTo(record.action, record.id) }, shortId(record.id));
    this.step = h("small", { class: "step" });
    this.box = h("input", { type: "checkbox", "aria-label": `Choose ${shortId(record.id)}`, onchange: () => onchoose(this.record, this.box.checked) });
    const name = `Cancel ${shortId(record.id)}`;
    this.cancel = button("Cancel", () => oncancel(this.record), { class: "quiet", "aria-label": name });
    this.cells = columns.map((column) => new Cell(column, record, onclient));
    this.hasReason = columns.includes("reason");
    this.isInView = false;
    this.written = [];
    const ends = [h("td", { class: "box" }, this.box), h("td", { class: "id" }, this.link, this.step)];
    this.element = h("tr", {}, ...ends, ...this.cells.map((cell) => cell.element), h("td", { class: "act" }, this.cancel));
    this.element.addEventListener("click", (event) => {
      if (!event.target.closest("a, button, input")) {
        openLink(this.link.getAttribute("href"), false);
      }
    });
  }

  update(record, isShown, query, isChosen) {
    this.record = record;
    const now = Math.floor(Date.now() / AGES) * AGES;
    const { status, goal, reason, labels, parent, place, queueLength, awayAt, client, isMine, worker, sentAt, startedAt, endedAt } = record;
    const lively = this.isInView && record.isActive ? [now, record.progress] : [];
    const state = [record, isShown, query, isChosen, status, goal, reason, labels, parent, place, queueLength, awayAt, client, isMine, worker, sentAt, startedAt, endedAt, ...lively];
    if (state.length !== this.written.length || state.some((one, index) => one !== this.written[index])) {
      this.written = state;
      this.write(record, isShown, query, isChosen, now);
    }
  }

  write(record, isShown, query, isChosen, now) {
    const address = linkTo(record.action, record.id) + query;
    if (this.address !== address) {
      this.address = address;
      this.link.setAttribute("href", address);
    }
    show(this.step, Boolean(record.parent));
    if (record.parent) {
      setText(this.step, `${stepOf(record.parent)} of ${shortId(record.parent.id)}`);
    }
    this.cells.forEach((cell) => cell.update(record, this.hasReason, now));
    this.box.checked = isChosen;
    show(this.cancel, record.isActive && record.status !== "CANCELING");
    this.element.classList.toggle("current", isShown);
    markCurrent(this.link, isShown);
  }
}

export class GoalList {
  /** Make a table of the goals of one action, or of all without an `info`. */
  constructor({ store, info, withAction, oncancel, oncancelAll, onforget, onfilter, onfail }) {
    this.store = store;
    this.mayForget = Boolean(onforget);
    this.rows = new Map();
    this.sight = new Sight(() => store.change());
    this.found = new FoundGoals(store);
    this.layout = new ListLayout(info, withAction, onfilter);
    this.filter = new GoalFilter(this.layout, onfilter);
    this.search = this.filter.search;
    this.search.addEventListener("keydown", (event) => event.key === "Enter" && this.open());
    this.chosen = new ChosenGoals({ store, found: this.found, onfail, onchange: () => store.change() });
    const onchoose = (record, isChosen) => this.chosen.choose([record], isChosen);
    this.options = { oncancel, onchoose, onclient: (client) => this.filter.choose("client", client) };
    this.cancelAll = button("Cancel all", () => (this.filter.isChoice ? this.chosen.cancelAll(this.wanted()) : oncancelAll()));
    this.againAll = button("Send all again", () => this.chosen.sendAllAgain());
    this.forget = button("Clear list", onforget, { class: "quiet" });
    this.every = h("input", { type: "checkbox", "aria-label": "Choose all goals of this page", onchange: () => this.chosen.choose(this.shown, this.every.checked) });
    this.head = h("tr");
    this.body = h("tbody");
    this.note = h("p", { class: "note", role: "status" });
    const caption = h("caption", { class: "hidden-text" }, "Goals");
    this.table = h("table", { class: "goals" }, caption, h("thead", {}, this.head), this.body);
    const tools = h("div", { class: "tools" }, this.search, this.filter.state, h("span", { class: "space" }), this.againAll, this.cancelAll, this.forget);
    const move = (step) => () => this.layout.change({ from: Math.max(this.layout.from + step * this.layout.rows, 0) });
    this.before = button("Previous", move(-1), { "aria-label": "Previous goals" });
    this.after = button("Next", move(1), { "aria-label": "Next goals" });
    const files = ["json", "csv"].map((ending) => button(`Save as ${ending.toUpperCase()}`, () => this.chosen.save(ending, this.listed), { class: "quiet" }));
    const foot = h("div", { class: "buttons" }, this.before, this.after, this.note, h("span", { class: "space" }), ...files);
    const more = h("div", { class: "mores" }, this.filter.quick, this.filter.more, this.layout.element, new SavedViews().element);
    this.element = h("section", { class: "card list", "aria-label": "Goals" }, h("h2", {}, "Goals"), tools, more, this.chosen.element, h("div", { class: "rows" }, this.table), foot);
  }

  /** Show the goals of these actions, or of all, that are wanted; `goals` are those that this page knows. */
  update(goals, shown, actions) {
    this.latest = [goals, shown, actions];
    const { filter, layout, found, chosen } = this;
    const active = goals.filter((goal) => goal.isActive).length;
    if (!actions || actions.length) {
      found.want(filter.asked(actions || []), `${goals.filter((goal) => !goal.isListed).length} ${active}`);
    }
    const page = found.page(goals, layout, filter.reader());
    this.listed = goals;
    this.shown = page.goals;
    this.updateHead();
    const keys = new Set(page.goals.map((goal) => goal.key));
    for (const [key, row] of this.rows) {
      if (!keys.has(key)) {
        this.rows.delete(key);
        this.sight.remove(row);
      }
    }
    const { query } = filter;
    arrange(this.body, page.goals.map((goal) => this.rowOf(goal, goal.key === shown, query)));
    if (layout.columns.some(showsRequest)) {
      found.readRequests(page.goals);
    }
    chosen.update(page.total);
    this.every.checked = page.goals.length > 0 && page.goals.every((goal) => chosen.has(goal));
    show(this.cancelAll, active > 1 && (!filter.isChoice || this.wanted().length > 0));
    show(this.againAll, this.mayForget && filter.isOfEnded && page.goals.length > 0);
    show(this.forget, this.mayForget && goals.length > active);
    show(this.before, layout.from > 0);
    show(this.after, layout.from + page.goals.length < page.total && page.goals.length > 0);
    const note = found.isSearching ? "Searching…" : noteOf(layout.from, page);
    setText(this.note, [note, found.text].filter(Boolean).join(" "));
  }

  /** Return the active goals that are wanted, on other pages of the list too. */
  wanted() {
    const fits = this.filter.reader();
    return this.listed.filter((goal) => goal.isActive && fits(goal));
  }

  rowOf(goal, isShown, query) {
    let row = this.rows.get(goal.key);
    if (!row) {
      row = new Row(goal, this.layout.columns, this.options);
      this.rows.set(goal.key, row);
      this.sight.add(row);
    }
    row.update(goal, isShown, query, this.chosen.has(goal));
    return row.element;
  }

  /** Show the names of the columns, those of an order as buttons. */
  updateHead() {
    const { columns, sort } = this.layout;
    const now = `${columns.join()} ${sort}`;
    if (now === this.headed) {
      return;
    }
    this.headed = now;
    this.rows.forEach((row) => this.sight.remove(row));
    this.rows.clear();
    const heads = columns.map((column) => {
      const by = sortOf(column);
      const order = by && sort.replace("-", "") === by ? (sort.startsWith("-") ? "descending" : "ascending") : null;
      const sign = order && h("span", { "aria-hidden": "true" }, order === "descending" ? " ↓" : " ↑");
      const name = by ? button(headOf(column), () => this.layout.sortBy(by), { class: "quiet" }) : headOf(column);
      return h("th", { scope: "col", class: `${column}-head`, "aria-sort": order }, name, sign);
    });
    const goal = h("th", { scope: "col", class: "id-head" }, "Goal");
    const act = h("th", { scope: "col", class: "act-head" }, h("span", { class: "hidden-text" }, "Cancel"));
    const all = [h("td", { class: "box-head" }, this.every), goal, ...heads, act];
    const widths = [BOX, ID, ...columns.map(widthOf), ACT];
    const sum = widths.reduce((one, other) => one + other);
    all.forEach((head, place) => {
      head.style.width = `${(100 * widths[place]) / sum}%`;
    });
    this.table.style.minWidth = `${LEAST * sum}px`; // below it, the table is scrolled
    this.head.replaceChildren(...all);
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

function noteOf(from, { goals, total }) {
  if (!total) {
    return "No goal is found.";
  }
  const count = total.toLocaleString("en");
  return goals.length < total ? `${from + 1} to ${from + goals.length} of ${count} goals.` : `${count} goal${total === 1 ? "" : "s"}.`;
}
