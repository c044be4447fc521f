/** A field for a date or a time: the text that is sent, and a picker of the browser that fills it. */

import { h } from "./dom.js";
import { FieldError, labelled } from "./field_parts.js";

const PICKERS = {
  "date-time": "datetime-local",
  "iso-date-time": "datetime-local",
  "date-time-local": "datetime-local",
  time: "time",
  "iso-time": "time",
  "partial-time": "time",
};
const OFFSET = /(?:Z|[+-]\d\d:?\d\d)$/i;
const TIME = /\d\d:\d\d(?::\d\d)?/;
const MINUTE = 60_000;

/** Return whether there is a picker for texts of this format. */
export function isPicked({ format }) {
  return format === "date" || Object.hasOwn(PICKERS, format);
}

/** Return the value of the picker for a text, in the time of this browser; empty if it is not a time. */
export function pickedOf(text, format) {
  if (PICKERS[format] === "time") {
    return TIME.exec(text)?.[0] ?? "";
  }
  const time = new Date(text);
  const local = new Date(time.getTime() - time.getTimezoneOffset() * MINUTE);
  return Number.isNaN(local.getTime()) ? "" : local.toISOString().slice(0, 19);
}

/** Return the text for what was picked. It has an offset from UTC if the text before had one. */
export function textOfPicked(picked, before, format) {
  const isTime = PICKERS[format] === "time";
  const text = picked.length > (isTime ? 5 : 16) ? picked : `${picked}:00`;
  if (isTime) {
    return text + (OFFSET.exec(before)?.[0] ?? "");
  }
  return format === "date-time-local" || (before && !OFFSET.test(before)) ? text : text + offsetAt(new Date(text));
}

function offsetAt(time) {
  const minutes = -time.getTimezoneOffset();
  const [hours, rest] = [Math.floor(Math.abs(minutes) / 60), Math.abs(minutes) % 60];
  const digits = [hours, rest].map((one) => String(one).padStart(2, "0")).join(":");
  return `${minutes < 0 ? "-" : "+"}${digits}`;
}

export function timeField({ schema, name, value }) {
  return schema.format === "date" ? dateField(schema, name, value) : pickedField(schema, name, value);
}

function dateField(schema, name, value) {
  const input = h("input", { type: "date", required: true });
  const set = (one) => {
    input.value = String(one ?? "");
  };
  set(value);
  const read = () => {
    if (!input.checkValidity()) {
      throw new FieldError(`${name}: enter a date`, input);
    }
    return input.value;
  };
  return { element: labelled(schema, name, input), read, set };
}

function pickedField(schema, name, value) {
  const { format } = schema;
  const zone = format.endsWith("date-time") ? ` in the time zone ${Intl.DateTimeFormat().resolvedOptions().timeZone}` : "";
  const input = h("input", { type: "text", placeholder: format, autocomplete: "off", oninput: () => show() });
  const picker = h("input", { type: PICKERS[format], step: 1, class: "picker", "aria-label": `Choose ${name}${zone}`, title: `Choose ${name}${zone}` });
  picker.addEventListener("input", () => {
    if (picker.value) {
      input.value = textOfPicked(picker.value, input.value, format);
    }
  });
  const show = () => {
    picker.value = pickedOf(input.value, format);
  };
  const set = (one) => {
    input.value = String(one ?? "");
    show();
  };
  set(value);
  return { element: labelled(schema, name, input, picker), read: () => input.value, set };
}
