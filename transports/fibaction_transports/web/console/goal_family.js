/** The family of a goal as links: the goals above it, and all below it as a tree. */

import { FoundGoals } from "./found_goals.js";
import { arrange, h, setText, show } from "./dom.js";
import { linkTo, shortId, showBadge, stepOf } from "./goal_text.js";

const MOST_LEVELS = 8;
const MOST_ASKED = 30; // goals of which the history is asked for children
const SKEW = 60_000; // milliseconds by which the clocks of two servers may differ

export class GoalFamily {
  constructor(store) {
    this.store = store;
    this.found = new FoundGoals(store);
    this.above = h("div");
    this.items = new Map();
    this.title = h("h3", {}, "Children");
    this.children = h("ul", { "aria-label": "Children" });
    this.element = h("div", { class: "family" }, this.above, this.title, this.children);
  }

  /** Show the family of a goal as far as it is known now. */
  update(record) {
    if (this.shown !== record.key) {
      this.shown = record.key;
      this.ask(record).catch(() => {}); // an older server, or one that is away: what is known is shown
    }
    this.updateAbove(record);
    this.childrenOf = Map.groupBy([...this.store.goals.values()].filter((goal) => goal.parent), (goal) => goal.parent.id);
    this.fill(this.children, record, [record.id]);
    show(this.title, !this.children.hidden);
  }

  /** Ask the histories for the goals of the family that this page does not know. */
  async ask(record) {
    const { store, found } = this;
    if (store.isRecording || store.state !== "ready") {
      return;
    }
    for (let child = record, left = MOST_LEVELS; child?.parent && left > 0; left -= 1) {
      if (!store.goalOf(child.parent.id)) {
        await found.bring({ search: child.parent.id, until: timeAt(child.sentAt + SKEW), sort: "accepted" });
      }
      child = store.goalOf(child.parent.id);
    }
    const parents = [record];
    for (let asked = 0; parents.length && asked < MOST_ASKED && this.shown === record.key; asked += 1) {
      const parent = parents.shift();
      const keys = await found.bring({ parent: parent.id, since: timeAt(parent.sentAt - SKEW) });
      parents.push(...keys.map((key) => store.goals.get(key)).filter(Boolean));
    }
  }

  /** Show the goals above a goal, one in a line, as far as they are known. */
  updateAbove(record) {
    const lines = [];
    for (let child = record; child?.parent && lines.length < MOST_LEVELS; ) {
      lines.push(child.parent);
      child = this.store.goalOf(child.parent.id);
    }
    while (this.above.children.length < lines.length) {
      const parts = [h("span"), h("a", { class: "parent" }), h("span")];
      this.above.append(h("p", { class: "step" }, ...parts));
    }
    [...this.above.children].forEach((line, place) => {
      show(line, place < lines.length);
      if (place < lines.length) {
        this.updateLine(line.children, lines[place]);
      }
    });
  }

  updateLine([step, link, elsewhere], parent) {
    const known = this.store.goalOf(parent.id);
    setText(step, `Step ${stepOf(parent)} of goal ${known ? "" : shortId(parent.id)}`);
    show(link, Boolean(known));
    setText(elsewhere, known ? "" : " (not known here)");
    if (known) {
      link.setAttribute("href", linkTo(known.action, known.id));
      setText(link, `${known.action} ${shortId(known.id)}`);
    }
  }

  /** Show the children of a goal in a list, each with its own below it. */
  fill(list, record, path) {
    const all = path.length <= MOST_LEVELS ? (this.childrenOf.get(record.id) ?? []) : [];
    const children = all.filter((child) => !path.includes(child.id)); // a client may say anything
    children.sort((one, other) => one.sentAt - other.sentAt);
    arrange(list, children.map((child) => this.itemOf(child, [...path, child.id])));
    show(list, children.length > 0);
  }

  itemOf(child, path) {
    if (!this.items.has(child.key)) {
      const badge = h("span", { class: "badge" });
      const name = `${stepOf(child.parent)}: ${child.action} ${shortId(child.id)}`;
      const link = h("a", { href: linkTo(child.action, child.id) }, name);
      const list = h("ul", { "aria-label": `Children of ${shortId(child.id)}`, hidden: true });
      this.items.set(child.key, { badge, list, element: h("li", {}, link, " ", badge, list) });
    }
    const { badge, list, element } = this.items.get(child.key);
    showBadge(badge, child);
    this.fill(list, child, path);
    return element;
  }
}

function timeAt(milliseconds) {
  return new Date(Math.max(milliseconds, 0)).toISOString();
}
