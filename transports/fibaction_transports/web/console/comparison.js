/** Two goals side by side: the fields of which their values differ. */

import { button, h, setText, show } from "./dom.js";
import { labelsOf } from "./goal_filter.js";
import { durationOf, linkTo, shortId, stateOf, timeOf } from "./goal_text.js";
import { textOf } from "./values.js";

const MOST_FIELDS = 200;
const MOST_LETTERS = 300;

/** Return the fields of a value with their paths: lists of plain values are one field. */
export function fieldsOf(value, path) {
  const isList = Array.isArray(value);
  const isPlain = value === null || typeof value !== "object" || value instanceof Uint8Array;
  const isFlat = isList && value.every((item) => item === null || typeof item !== "object");
  if (isPlain || isFlat || !Object.keys(value).length) {
    return [[path, textOf(value)]];
  }
  const name = (key) => (isList ? `${path}[${key}]` : `${path}.${key}`);
  return Object.entries(value).flatMap(([key, item]) => fieldsOf(item, name(key))).slice(0, MOST_FIELDS);
}

/** Return the names of the fields that two goals have, and the values of each of the two. */
export function compared(one, other) {
  const [first, second] = [one, other].map((goal) => new Map([
    ["state", stateOf(goal)],
    ["reason", goal.reason],
    ["sent", timeOf(goal.sentAt)],
    ["duration", durationOf(goal.seconds())],
    ["client", goal.client],
    ["worker", goal.worker],
    ["labels", labelsOf(goal).join(", ")],
    ["messages", String(goal.feedbackCount)],
    ...fieldsOf(goal.goal, "goal"),
    ...fieldsOf(goal.result, "result"),
  ]));
  const names = [...new Set([...first.keys(), ...second.keys()])];
  return names.map((name) => [name, first.get(name) ?? "", second.get(name) ?? ""]);
}

/** The table of the differences; hidden unless another goal was chosen. */
export class Comparison {
  constructor({ onstop }) {
    this.link = h("a");
    this.heads = [h("th", { scope: "col" }), h("th", { scope: "col" })];
    this.body = h("tbody");
    this.note = h("p", { class: "note" });
    const head = h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Field"), ...this.heads));
    const table = h("table", { class: "compared" }, h("caption", { class: "hidden-text" }, "Differences"), head, this.body);
    const title = h("div", { class: "buttons" }, h("h3", {}, "Compared with ", this.link), button("Stop comparing", onstop, { class: "quiet" }));
    this.element = h("section", { "aria-label": "Comparison", hidden: true }, title, table, this.note);
    this.drawn = "";
  }

  /** Show how a goal differs from one of the same action that was chosen, or say what to open. */
  update(basis, record) {
    show(this.element, Boolean(basis));
    if (!basis) {
      return;
    }
    const isOther = basis.action !== record.action;
    this.link.setAttribute("href", linkTo(basis.action, basis.id));
    setText(this.link, shortId(basis.id));
    const rows = isOther ? [] : compared(basis, record);
    const differing = rows.filter(([, one, other]) => one !== other);
    const text = JSON.stringify([basis.key, record.key, differing]);
    if (text !== this.drawn) {
      this.drawn = text;
      setText(this.heads[0], shortId(basis.id));
      setText(this.heads[1], shortId(record.id));
      const cell = (value) => h("td", {}, value.length > MOST_LETTERS ? `${value.slice(0, MOST_LETTERS)}…` : value);
      this.body.replaceChildren(...differing.map(([name, ...both]) => h("tr", {}, h("th", { scope: "row" }, name), ...both.map(cell))));
    }
    show(this.body.parentElement, basis !== record && !isOther);
    const wanted = isOther ? `Only goals of one action are compared: open another one of ${basis.action}.` : "Open the other goal.";
    setText(this.note, basis === record || isOther ? wanted : `${rows.length - differing.length} of ${rows.length} fields are the same.`);
  }
}
