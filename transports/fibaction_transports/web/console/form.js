/** A form for a goal, made from its JSON Schema. */

import { bytesField } from "./bytes_field.js";
import { button, errorPlace, h, show, tellError } from "./dom.js";
import { FieldError, labelled } from "./field_parts.js";
import { pairsField } from "./pairs_field.js";
import { defaultOf, fits, fixedOf, hasOtherKeys, isLeftOut, kindOf, resolverOf, variantName, withBytes } from "./schema.js";
import { isPicked, timeField } from "./time_field.js";
import { parsed, textOf } from "./values.js";

const MOST_LEVELS = 6;

/**
 * Return a field for a schema: an element, a function that reads the value, and one that sets it.
 * One that may be left out reads undefined if it is.
 */
export function fieldFor(given, name, value, resolve, level = 0, mayBeLeftOut = false) {
  const schema = resolve(given);
  const { kind, inner, choices } = level > MOST_LEVELS ? { kind: "json" } : kindOf(schema, resolve);
  const makers = {
    array: listField,
    boolean: checkField,
    bytes: bytesField,
    choice: choiceField,
    const: constField,
    nullable: nullableField,
    object: objectField,
    json: jsonField,
    pairs: pairsField,
    string: isPicked(inner ?? schema) ? timeField : inputField,
    variants: variantsField,
  };
  const make = makers[kind] ?? inputField;
  return make({ schema: inner ?? schema, kind, choices, name, value, resolve, level, mayBeLeftOut, fieldFor });
}

function inputField({ schema, kind, name, value }) {
  const isNumber = kind === "number" || kind === "integer";
  // A number that JavaScript rounds is written and read as text.
  const isLarge = kind === "integer" && !Number.isSafeInteger(Number(value ?? 0));
  const input = h("input", {
    type: isNumber && !isLarge ? "number" : "text",
    step: kind === "integer" ? 1 : "any",
    min: schema.minimum,
    max: schema.maximum,
    minlength: schema.minLength,
    maxlength: schema.maxLength,
    placeholder: schema.format,
    autocomplete: "off",
  });
  const set = (one) => {
    input.value = String(one ?? "");
  };
  set(value);
  const read = () => {
    try {
      return readInput(kind, input);
    } catch (error) {
      throw new FieldError(`${name}: ${error.message}`, input);
    }
  };
  return { element: labelled(schema, name, input), read, set };
}

function readInput(kind, input) {
  const text = input.value.trim();
  if (!input.checkValidity()) {
    throw new Error(input.validationMessage);
  }
  if (kind === "integer") {
    if (!/^[+-]?\d+$/.test(text)) {
      throw new Error("enter a whole number");
    }
    return Number.isSafeInteger(Number(text)) ? Number(text) : BigInt(text);
  }
  if (kind === "number") {
    if (text === "" || !Number.isFinite(Number(text))) {
      throw new Error("enter a number");
    }
    return Number(text);
  }
  return input.value;
}

function checkField({ schema, name, value }) {
  const input = h("input", { type: "checkbox" });
  const set = (one) => {
    input.checked = Boolean(one);
  };
  set(value);
  const element = labelled(schema, name, input);
  element.classList.add("check");
  return { element, read: () => input.checked, set };
}

function choiceField({ schema, name, value }) {
  const options = schema.enum.map((one, index) => h("option", { value: index }, textOf(one).replaceAll('"', "")));
  const select = h("select", {}, ...options);
  const set = (one) => {
    select.selectedIndex = Math.max(schema.enum.indexOf(one), 0);
  };
  set(value);
  return { element: labelled(schema, name, select), read: () => schema.enum[select.selectedIndex], set };
}

function constField({ schema, name }) {
  const element = h("p", { class: "field" }, `${name}: ${textOf(fixedOf(schema))}`);
  return { element, read: () => fixedOf(schema), set: () => {} };
}

function nullableField({ schema, name, value, resolve, level }) {
  const start = value ?? defaultOf(schema, resolve);
  const field = fieldFor(schema, name, start, resolve, level);
  const isSet = h("input", { type: "checkbox", onchange: () => show(field.element, isSet.checked) });
  const set = (one) => {
    isSet.checked = one !== null && one !== undefined;
    if (isSet.checked) {
      field.set(one);
    }
    show(field.element, isSet.checked);
  };
  set(value);
  const toggle = labelled({}, `set ${name}`, isSet);
  toggle.classList.add("check");
  const element = h("div", { class: "optional" }, toggle, field.element);
  return { element, read: () => (isSet.checked ? field.read() : null), set };
}

function variantsField({ schema, choices, name, value, resolve, level, mayBeLeftOut }) {
  const tag = schema.discriminator?.propertyName;
  const names = choices.map((one) => variantName(one, tag, resolve));
  const place = h("div", { class: "variant" });
  let field = null;
  const pick = (index, one) => {
    select.value = String(index);
    field = index < 0 ? null : fieldFor(choices[index], name, one ?? defaultOf(choices[index], resolve), resolve, level + 1);
    place.replaceChildren(...(field ? [field.element] : []));
  };
  const options = names.map((text, index) => h("option", { value: index }, text));
  const left = mayBeLeftOut ? h("option", { value: -1 }, "default of the server") : null;
  const select = h("select", { onchange: () => pick(Number(select.value)) }, left, ...options);
  const set = (one) => {
    const found = choices.findIndex((choice) => fits(one, choice, resolve));
    pick(found < 0 && !mayBeLeftOut ? 0 : found, found < 0 ? undefined : one);
  };
  set(value);
  const element = h("div", { class: "optional" }, labelled(schema, `variant of ${name}`, select), place);
  return { element, read: () => field?.read(), set };
}

function objectField({ schema, name, value, resolve, level }) {
  const fields = Object.entries(schema.properties).map(([part, one]) => {
    const mayBeLeftOut = isLeftOut(schema, part, resolve);
    const start = value?.[part] ?? (mayBeLeftOut ? undefined : defaultOf(one, resolve));
    return [part, fieldFor(one, part, start, resolve, level + 1, mayBeLeftOut)];
  });
  const others = (one) => Object.fromEntries(Object.entries(one ?? {}).filter(([part]) => !Object.hasOwn(schema.properties, part)));
  const more = hasOtherKeys(schema)
    ? pairsField({ schema, name: name ? `more of ${name}` : "more", value: others(value), resolve, level, fieldFor })
    : null;
  const elements = [...fields.map(([, field]) => field.element), more?.element];
  const legend = name ? h("legend", {}, name) : null;
  const element = legend ? h("fieldset", {}, legend, ...elements) : h("div", { class: "fields" }, ...elements);
  return {
    element,
    read: () => ({
      ...more?.read(),
      ...Object.fromEntries(fields.map(([part, field]) => [part, field.read()]).filter(([, one]) => one !== undefined)),
    }),
    set: (one) => {
      fields.forEach(([part, field]) => (part in (one ?? {}) || isLeftOut(schema, part, resolve)) && field.set(one?.[part]));
      more?.set(others(one));
    },
  };
}

function listField({ schema, name, value, resolve, level }) {
  let items = [];
  const list = h("div", { class: "items" });
  const add = (one) => {
    const start = one ?? defaultOf(schema.items, resolve);
    const field = fieldFor(schema.items, `${name}[${items.length}]`, start, resolve, level + 1);
    const remove = button("×", null, { class: "quiet", "aria-label": `Remove ${name}[${items.length}]` });
    const item = { field, element: h("div", { class: "item" }, field.element, remove) };
    remove.addEventListener("click", () => set(items.filter((other) => other !== item).map((other) => other.field.read())));
    items.push(item);
    list.append(item.element);
  };
  const set = (values) => {
    items = [];
    list.replaceChildren();
    (values ?? []).forEach(add);
  };
  set(value);
  const more = button(`Add to ${name}`, () => add());
  const element = h("fieldset", {}, h("legend", {}, name), list, more);
  return { element, read: () => items.map(({ field }) => field.read()), set };
}

function jsonField({ schema, of = schema, name, value, resolve }) {
  const area = h("textarea", { rows: 3, spellcheck: "false" });
  const set = (one) => {
    area.value = textOf(one ?? null, { whole: true });
  };
  set(value);
  const read = () => {
    const tried = (what, make) => {
      try {
        return make();
      } catch (error) {
        throw new FieldError(`${name}: ${what}${error.message}`, area);
      }
    };
    const given = tried("this is not JSON: ", () => parsed(area.value));
    return tried("", () => withBytes(given, of, resolve));
  };
  return { element: labelled(schema, `${name} (JSON)`, area), read, set };
}

/** The form of one action, as fields or as JSON. */
export class GoalForm {
  constructor(info, onsend) {
    const resolve = resolverOf(info.goal);
    const start = defaultOf(info.goal, resolve);
    const isObject = kindOf(resolve(info.goal), resolve).kind === "object";
    this.onsend = onsend;
    this.field = fieldFor(info.goal, isObject ? "" : "goal", start, resolve);
    this.json = jsonField({ schema: {}, of: info.goal, name: "goal", value: start, resolve });
    this.isJson = false;
    this.toggle = button("Edit as JSON", () => this.switch(), { class: "quiet", "aria-pressed": "false" });
    this.button = h("button", { type: "submit", class: "main" }, "Send goal");
    this.error = errorPlace();
    this.end = h("div", {}, this.error);
    show(this.json.element, false);
    const parts = [this.field.element, this.json.element, this.end];
    const buttons = h("div", { class: "buttons" }, this.button, this.toggle);
    this.element = h("form", { class: "goal-form", novalidate: true }, ...parts, buttons);
    this.element.addEventListener("submit", (event) => {
      event.preventDefault();
      this.send();
    });
    this.element.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) {
        this.send();
      }
    });
  }

  /** Fill the form with a goal. */
  set(goal) {
    this.field.set(goal);
    this.json.set(goal);
  }

  switch() {
    try {
      const [from, to] = this.isJson ? [this.json, this.field] : [this.field, this.json];
      to.set(from.read());
    } catch (error) {
      this.fail(error.message, error.input);
      return;
    }
    this.isJson = !this.isJson;
    this.toggle.setAttribute("aria-pressed", String(this.isJson));
    show(this.json.element, this.isJson);
    show(this.field.element, !this.isJson);
    this.fail("");
  }

  /** Tell an error at the input that it is about, else at the end; none if the text is empty. */
  fail(text, input) {
    this.wrong?.removeAttribute("aria-invalid");
    this.wrong = input;
    (input?.closest(".field") ?? input?.parentElement ?? this.end).append(this.error);
    tellError(this.error, text);
    input?.setAttribute("aria-invalid", "true");
    input?.focus();
  }

  async send() {
    this.fail("");
    this.button.disabled = true;
    try {
      const goal = (this.isJson ? this.json : this.field).read();
      await this.onsend(goal);
    } catch (error) {
      this.fail(error.reason ? `Rejected: ${error.reason}` : error.message, error.input);
    } finally {
      this.button.disabled = false;
    }
  }
}
