/** The layout of a list of goals: its columns, its order, and the page that it shows. */

import { button, h } from "./dom.js";
import { SORTS, columnsOf, defaultsOf, headOf } from "./goal_columns.js";

const ROWS = [100, 20, 50, 300];
const FIRST = { sort: "-accepted", from: 0, rows: ROWS[0] };

export class ListLayout {
  /** Make the choice of columns; `onchange` is called with each change of a person. */
  constructor(info, withAction, onchange) {
    this.onchange = onchange;
    this.names = columnsOf(info, withAction);
    this.defaults = defaultsOf(withAction);
    this.columns = this.defaults;
    Object.assign(this, FIRST);
    this.boxes = [];
    this.element = h("details", { class: "more", ontoggle: () => this.boxes.length || this.fill() }, h("summary", {}, "Columns and order"));
  }

  /** Make the fields, when a person opens them. */
  fill() {
    const option = ([value, text]) => h("option", { value }, text);
    this.order = h("select", { oninput: () => this.change({ sort: this.order.value, from: 0 }) }, ...Object.entries(SORTS).map(option));
    this.size = h("select", { oninput: () => this.change({ rows: Number(this.size.value), from: 0 }) }, ...[...ROWS].sort((one, other) => one - other).map((rows) => option([rows, rows])));
    this.boxes = this.names.map((name) => h("input", { type: "checkbox", value: name, "aria-label": `Column ${headOf(name)}`, onchange: () => this.choose() }));
    const columns = this.boxes.map((box) => h("label", { class: "choice" }, box, headOf(box.value)));
    const first = button("Default columns", () => this.change({ columns: this.defaults }), { class: "quiet" });
    const group = h("fieldset", { class: "columns-choice" }, h("legend", {}, "Columns"), ...columns, first);
    this.element.append(h("div", { class: "tools" }, h("label", {}, "Order", this.order), h("label", {}, "Goals on a page", this.size)), group);
    this.mark();
  }

  choose() {
    const columns = this.boxes.filter((box) => box.checked).map((box) => box.value);
    this.change({ columns: columns.length ? columns : this.defaults });
  }

  change(parts) {
    Object.assign(this, parts);
    this.mark();
    this.onchange();
  }

  /** Sort by what stands above a column, and the other way round if it is sorted so. */
  sortBy(sort) {
    this.change({ sort: this.sort === `-${sort}` ? sort : `-${sort}`, from: 0 });
  }

  /** The parts of an address, without those that every list has first. */
  get parts() {
    const { sort, from, rows, columns, defaults } = this;
    const own = columns.join() === defaults.join() ? "" : columns.join();
    return { sort: sort === FIRST.sort ? "" : sort, from: from || "", rows: rows === FIRST.rows ? "" : rows, columns: own };
  }

  set parts(parts) {
    const columns = (parts.get("columns") ?? "").split(",").filter((name) => this.names.includes(name));
    const sort = parts.get("sort");
    this.sort = Object.hasOwn(SORTS, sort) ? sort : FIRST.sort;
    this.rows = ROWS.find((rows) => rows === Number(parts.get("rows"))) ?? FIRST.rows;
    this.from = Math.max(Math.floor(Number(parts.get("from"))) || 0, 0);
    this.columns = columns.length ? columns : this.defaults;
    this.mark();
  }

  mark() {
    if (!this.boxes.length) {
      return;
    }
    this.order.value = this.sort;
    this.size.value = this.rows;
    for (const box of this.boxes) {
      box.checked = this.columns.includes(box.value);
    }
  }
}
