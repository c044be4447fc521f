/** Parts that all fields of a form have: a label with the unit, a note, and the error of a value. */

import { h } from "./dom.js";
import { rangeOf, unitOf } from "./schema.js";

let lastId = 0;

/** A value that is not valid, and the input that it is in. */
export class FieldError extends Error {
  constructor(text, input) {
    super(text);
    this.input = input;
  }
}

/** Return an input with its label, and with the description and the limits of its schema. */
export function labelled(schema, name, input, ...more) {
  lastId += 1;
  input.id = `field-${lastId}`;
  const unit = unitOf(schema);
  const note = [schema.description, rangeOf(schema)].filter(Boolean).join(" · ");
  if (note) {
    input.setAttribute("aria-describedby", `note-${lastId}`);
  }
  const label = h("label", { for: input.id }, name, unit ? h("span", { class: "unit" }, ` ${unit}`) : null);
  const hint = note ? h("small", { id: `note-${lastId}` }, note) : null;
  return h("div", { class: "field" }, label, input, hint, ...more);
}
