/** A field for an object whose keys a person names: a row of a key and a value for each. */

import { button, h } from "./dom.js";
import { FieldError, labelled } from "./field_parts.js";
import { defaultOf } from "./schema.js";

/** Make the field; `fieldFor` makes those of the values. */
export function pairsField({ schema, name, value, resolve, level, fieldFor }) {
  const inner = schema.additionalProperties === true ? {} : schema.additionalProperties;
  let rows = [];
  let count = 0;
  const list = h("div", { class: "items" });
  const add = (key, one) => {
    count += 1;
    const input = h("input", { type: "text", autocomplete: "off", spellcheck: "false" });
    input.value = key;
    const field = fieldFor(inner, `value ${count}`, one ?? defaultOf(inner, resolve), resolve, level + 1);
    const remove = button("×", null, { class: "quiet", "aria-label": `Remove value ${count} of ${name}` });
    const element = h("div", { class: "item" }, h("div", {}, labelled({}, `key ${count}`, input), field.element), remove);
    const row = { input, field };
    remove.addEventListener("click", () => {
      rows = rows.filter((other) => other !== row);
      element.remove();
      more.focus();
    });
    rows.push(row);
    list.append(element);
    return input;
  };
  const set = (values) => {
    rows = [];
    count = 0;
    list.replaceChildren();
    Object.entries(values ?? {}).forEach(([key, one]) => add(key, one));
  };
  set(value);
  const more = button(`Add to ${name}`, () => add("", undefined).focus());
  const read = () => {
    const seen = new Set();
    return Object.fromEntries(rows.map(({ input, field }) => {
      const key = input.value;
      if (!key || seen.has(key)) {
        const problem = key ? `the key ${JSON.stringify(key)} is there twice` : "enter a key";
        throw new FieldError(`${name}: ${problem}`, input);
      }
      seen.add(key);
      return [key, field.read()];
    }));
  };
  return { element: h("fieldset", {}, h("legend", {}, name), list, more), read, set };
}
