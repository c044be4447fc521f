/** The parent and the children of a goal, as links to them. */

import { arrange, h, setText, show } from "./dom.js";
import { linkTo, shortId, showBadge, stepOf } from "./goal_text.js";

export class GoalFamily {
  constructor(store) {
    this.store = store;
    this.step = h("span");
    this.elsewhere = h("span");
    this.link = h("a", { class: "parent" });
    this.parent = h("p", { class: "step" }, this.step, this.link, this.elsewhere);
    this.items = new Map();
    this.title = h("h3", {}, "Children");
    this.children = h("ul", { "aria-label": "Children" });
    this.element = h("div", { class: "family" }, this.parent, this.title, this.children);
  }

  /** Show the family of a goal as far as it is known now. */
  update(record) {
    this.updateParent(record.parent);
    const children = this.store.childrenOf(record);
    arrange(this.children, children.map((child) => this.itemOf(child)));
    show(this.title, children.length > 0);
    show(this.children, children.length > 0);
  }

  updateParent(parent) {
    show(this.parent, Boolean(parent));
    if (!parent) {
      return;
    }
    const known = this.store.goalOf(parent.id);
    setText(this.step, `Step ${stepOf(parent)} of goal ${known ? "" : shortId(parent.id)}`);
    show(this.link, Boolean(known));
    setText(this.elsewhere, known ? "" : " (not known here)");
    if (known) {
      this.link.setAttribute("href", linkTo(known.action, known.id));
      setText(this.link, `${known.action} ${shortId(known.id)}`);
    }
  }

  itemOf(child) {
    if (!this.items.has(child.key)) {
      const badge = h("span", { class: "badge" });
      const name = `${stepOf(child.parent)}: ${child.action} ${shortId(child.id)}`;
      const link = h("a", { href: linkTo(child.action, child.id) }, name);
      this.items.set(child.key, { badge, element: h("li", {}, link, " ", badge) });
    }
    const { badge, element } = this.items.get(child.key);
    showBadge(badge, child);
    return element;
  }
}
