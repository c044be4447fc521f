/** JSON Schemas of actions, as far as a form and charts need them. */

import { bytesOf } from "./values.js";

const PERCENT = ["percent", "percentage", "percent_complete", "percentage_complete", "percent_done"];
const FRACTION = ["fraction", "fraction_complete", "fraction_done", "ratio", "completion", "progress"];
const COUNTS = ["done", "completed", "current", "progress"]; // next to "total"
const MOST_LEVELS = 8;
const MOST_SERIES = 24;
const MOST_INDEXED = 6;
const MOST_FILLED = 500;
const MOST_MULTIPLES = 10; // that are tried: 3 * 0.1 is none of 0.1 to a float, and 4 * 0.1 is one
const SAMPLES = {
  "date-time": "2026-01-31T12:00:00Z",
  "iso-date-time": "2026-01-31T12:00:00Z",
  "date-time-local": "2026-01-31T12:00:00",
  date: "2026-01-31",
  time: "12:00:00",
  "iso-time": "12:00:00",
  "partial-time": "12:00:00",
  duration: "PT1S",
  uuid: "00000000-0000-0000-0000-000000000000",
};
const IMAGE = ["width", "height", "encoding", "step", "data"];
const LIMITS_OF_TYPES = [-(2 ** 31), 2 ** 31 - 1, 2 ** 32 - 1];

/** Return a function that follows `$ref`s of a schema to the schemas that they mean. */
export function resolverOf(root) {
  return function resolve(schema) {
    let found = objectOf(schema);
    for (let level = 0; typeof found.$ref === "string" && level < MOST_LEVELS; level += 1) {
      const { $ref, ...beside } = found;
      const path = $ref.replace(/^#\/?/, "").split("/").filter(Boolean);
      found = { ...objectOf(path.reduce((part, name) => part?.[unescape(name)], root)), ...beside };
    }
    return found;
  };
}

/** Return what an action does: the description of its goal; empty if it has none. */
export function descriptionOf(root) {
  const { description } = resolverOf(root)(root);
  return typeof description === "string" ? description : "";
}

/** Return a schema as an object: `true` is one that allows any value. */
function objectOf(schema) {
  return typeof schema === "object" && schema !== null ? schema : {};
}

function unescape(name) {
  return decoded(name).replaceAll("~1", "/").replaceAll("~0", "~");
}

function decoded(name) {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/**
 * Return the kind of field that a schema needs: object, array, boolean, integer, number, string,
 * bytes, choice, const, pairs (an object of any keys), nullable (with the schema `inner`), variants
 * (with the `choices`, at least one of which has fields), or json for everything else.
 */
export function kindOf(schema, resolve) {
  if ("const" in schema || schema.enum?.length === 1) {
    return { kind: "const" };
  }
  if (Array.isArray(schema.enum)) {
    return { kind: "choice" };
  }
  const choices = schema.anyOf ?? schema.oneOf;
  if (choices) {
    const others = choices.filter((one) => resolve(one).type !== "null");
    const { anyOf, oneOf, ...beside } = schema;
    if (others.length === 1 && choices.length === 2) {
      return { kind: "nullable", inner: { ...beside, ...resolve(others[0]) } };
    }
    const hasFields = others.some((one) => "properties" in resolve(one));
    return hasFields ? { kind: "variants", choices } : { kind: "json" };
  }
  if (schema.type === "object" && schema.properties) {
    return { kind: "object" };
  }
  if (schema.type === "object" && hasOtherKeys(schema)) {
    return { kind: "pairs" };
  }
  if (schema.type === "array" && schema.items && schema.items !== false) {
    return { kind: "array" };
  }
  if (schema.type === "string" && schema.contentEncoding === "base64") {
    return { kind: "bytes" };
  }
  const simple = ["boolean", "integer", "number", "string"];
  return { kind: simple.includes(schema.type) ? schema.type : "json" };
}

/** Return whether the author of a schema says that an object has keys beside those with names. */
export function hasOtherKeys({ additionalProperties: others }) {
  return others === true || (typeof others === "object" && others !== null);
}

/**
 * Return the value that a form begins with: defaults, and else empty values that the schema allows.
 * The rule is that of the template of the command line, but for a value that may be null, which is.
 */
export function defaultOf(given, resolve, level = 0) {
  const schema = resolve(given);
  if ("default" in schema) {
    return filled(schema.default, schema, resolve, level);
  }
  const { kind } = kindOf(schema, resolve);
  if (kind === "const" || kind === "choice") {
    return kind === "const" ? fixedOf(schema) : schema.enum[0];
  }
  if (kind === "nullable" || level >= MOST_LEVELS) {
    return null;
  }
  const choices = schema.anyOf ?? schema.oneOf;
  if (choices) {
    return defaultOf(choices.find((one) => resolve(one).type !== "null") ?? choices[0], resolve, level + 1);
  }
  const type = Array.isArray(schema.type) ? schema.type[0] : schema.type;
  const makers = {
    array: () => itemsOf(schema, resolve, level),
    boolean: () => false,
    integer: () => numberOf(schema, true),
    number: () => numberOf(schema, false),
    object: () => filled({}, schema, resolve, level),
    string: () => SAMPLES[schema.format] ?? (kind === "bytes" ? "A" : "x").repeat(lengthOf(schema.minLength)),
  };
  return makers[type ?? (schema.properties ? "object" : "")]?.() ?? null;
}

/** Return as many items as a list needs. */
function itemsOf(schema, resolve, level) {
  const parts = [...(schema.prefixItems ?? [])];
  while (parts.length < lengthOf(schema.minItems)) {
    parts.push(schema.items ?? {});
  }
  return parts.map((part) => defaultOf(part, resolve, level + 1));
}

/** Return zero, or the number within the limits of a schema that is next to it or easy to read. */
function numberOf(schema, isInteger) {
  const { minimum, maximum, exclusiveMinimum: above, exclusiveMaximum: below, multipleOf: unit } = schema;
  const near = (limit, isBeyond, plain) =>
    unit === undefined ? plain : multipleOf(Number(unit), Number(limit), isInteger, isBeyond);
  if (minimum > 0) {
    return near(minimum, false, minimum);
  }
  if (above >= 0) {
    const [least, end] = [Number(above), Number(maximum ?? below ?? Infinity)];
    return near(above, true, isInteger || least + 1 < end ? least + 1 : (least + end) / 2);
  }
  if (maximum < 0) {
    return -near(-maximum, false, -maximum);
  }
  if (below <= 0) {
    return -near(-below, true, 1 - Number(below));
  }
  return 0;
}

/** Return the first multiple of a unit at or beyond a limit that the server accepts; or else the limit. */
function multipleOf(unit, limit, isInteger, isBeyond) {
  const first = isBeyond ? Math.floor(limit / unit) + 1 : Math.ceil(limit / unit);
  for (let count = first; count < first + MOST_MULTIPLES; count += 1) {
    const number = count * unit;
    if (Number.isInteger(number / unit) && (!isInteger || Number.isInteger(number))) {
      return number;
    }
  }
  return limit;
}

/** Return the least length that a schema asks for, as far as a form goes. */
function lengthOf(least) {
  return Math.min(Math.ceil(Number(least ?? 0)), MOST_FILLED);
}

function filled(value, schema, resolve, level) {
  const isObject = value !== null && typeof value === "object" && !Array.isArray(value);
  if (!isObject || !schema.properties || level >= MOST_LEVELS) {
    return value;
  }
  const names = Object.keys(schema.properties).filter((name) => name in value || !isLeftOut(schema, name, resolve));
  const of = (name) => name in value ? value[name] : defaultOf(schema.properties[name], resolve, level + 1);
  return { ...value, ...Object.fromEntries(names.map((name) => [name, of(name)])) };
}

/** Return the only value that a schema allows; undefined if there are others. */
export function fixedOf(schema) {
  return "const" in schema || schema.enum?.length !== 1 ? schema.const : schema.enum[0];
}

/**
 * Return whether a field is left to the server at first: a choice of variants whose default only
 * the server knows.
 */
export function isLeftOut(schema, name, resolve) {
  const part = resolve(schema.properties[name]);
  const isRequired = (schema.required ?? []).includes(name);
  return !isRequired && !("default" in part) && kindOf(part, resolve).kind === "variants";
}

/** Return whether a value is of a variant, judging by its type, its fields and their fixed values. */
export function fits(value, given, resolve) {
  const schema = resolve(given);
  const fixed = fixedOf(schema);
  if (fixed !== undefined || schema.type === "null") {
    return value === (fixed ?? null);
  }
  if (!("properties" in schema)) {
    const names = { integer: ["number", "bigint"], number: ["number", "bigint"], array: ["object"] };
    return (names[schema.type] ?? [schema.type]).includes(typeof value);
  }
  if (value === null || typeof value !== "object" || Array.isArray(value)) {
    return false;
  }
  const isFixed = ([name, one]) => {
    const only = fixedOf(resolve(one));
    return only === undefined || !(name in value) || value[name] === only;
  };
  const hasAll = (schema.required ?? []).every((name) => name in value);
  const isKnown = Object.keys(value).every((name) => name in schema.properties);
  return hasAll && isKnown && Object.entries(schema.properties).every(isFixed);
}

/**
 * Return a value of JSON, which has bytes as base64, with bytes where the schema has them.
 *
 * It throws an error if such a text is not base64.
 */
export function withBytes(value, given, resolve) {
  const schema = resolve(given);
  const { kind, inner, choices } = kindOf(schema, resolve);
  if (kind === "bytes" && typeof value === "string") {
    return bytesOf(value);
  }
  if (kind === "nullable" || kind === "variants") {
    const chosen = inner ?? choices.find((one) => fits(value, one, resolve));
    return chosen ? withBytes(value, chosen, resolve) : value;
  }
  if (Array.isArray(value)) {
    return value.map((one, index) => withBytes(one, schema.prefixItems?.[index] ?? schema.items, resolve));
  }
  if (value === null || typeof value !== "object") {
    return value;
  }
  const of = (name) => schema.properties?.[name] ?? schema.additionalProperties;
  return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, withBytes(one, of(name), resolve)]));
}

/** Return what a variant is called: its tag, its title, or its type. */
export function variantName(given, tag, resolve) {
  const schema = resolve(given);
  const named = schema.properties?.[tag];
  const title = schema.title ?? given.$ref?.split("/").pop() ?? schema.type;
  return String((named && fixedOf(resolve(named))) ?? title ?? "JSON");
}

/** Return whether values of a schema are images of ROS, `sensor_msgs/Image`. */
export function isRosImage(schema, resolve) {
  const fields = schema.properties ?? {};
  return IMAGE.every((name) => name in fields) && kindOf(resolve(fields.data), resolve).kind === "bytes";
}

/** Return the limits of a number as text; those of its type, such as of all int32, are not told. */
export function rangeOf({ minimum, maximum, exclusiveMinimum, exclusiveMaximum }) {
  const isTold = (limit) => Number.isSafeInteger(Math.trunc(Number(limit ?? NaN))) && !LIMITS_OF_TYPES.includes(limit);
  if (isTold(minimum) && isTold(maximum)) {
    return `${minimum} to ${maximum}`;
  }
  const words = { "at least": minimum, "more than": exclusiveMinimum, "at most": maximum, "less than": exclusiveMaximum };
  const told = Object.entries(words).filter(([, limit]) => isTold(limit));
  return told.map(([word, limit]) => `${word} ${limit}`).join(", ");
}

/** Return the unit of a schema, as its author has named it; empty if it has none. */
export function unitOf(schema) {
  return schema["x-unit"] ?? schema.unit ?? "";
}

/**
 * Return the charts for values of a schema. Numbers of one object that have the same unit share a
 * chart. A list is a curve of its own, unless the schema says that it is short.
 */
export function chartsOf(root) {
  const resolve = resolverOf(root);
  const charts = new Map();
  let count = 0;

  function add(chart, title, unit, line) {
    if (count < MOST_SERIES) {
      count += 1;
      const found = charts.get(chart) ?? { title, unit, lines: [], isCurve: Boolean(line.isCurve) };
      found.lines.push(line);
      charts.set(chart, found);
    }
  }

  function visit(given, path, level) {
    let schema = resolve(given);
    const found = kindOf(schema, resolve);
    if (found.kind === "nullable") {
      schema = resolve(found.inner);
    }
    const unit = unitOf(schema);
    const { kind } = kindOf(schema, resolve);
    if (kind === "integer" || kind === "number") {
      const parent = path.slice(0, -1).join(".");
      const name = path.join(".");
      const chart = unit ? `${parent} ${unit}` : name;
      add(chart, unit && parent ? parent : name, unit, { name: name || "value", path });
    } else if (kind === "object" && level < MOST_LEVELS && !isRosImage(schema, resolve)) {
      for (const [name, one] of Object.entries(schema.properties)) {
        visit(one, [...path, name], level + 1);
      }
    } else if (kind === "array") {
      visitList(schema, path, unit);
    }
  }

  function visitList(schema, path, unit) {
    const items = resolve(schema.items);
    const name = path.join(".") || "values";
    if (!["integer", "number"].includes(items.type)) {
      return;
    }
    if (schema.maxItems && schema.maxItems <= MOST_INDEXED) {
      for (let index = 0; index < schema.maxItems; index += 1) {
        const line = { name: `${name}[${index}]`, path: [...path, index] };
        add(name, name, unit || unitOf(items), line);
      }
    } else {
      add(name, name, unit || unitOf(items), { name, path, isCurve: true });
    }
  }

  visit(root, [], 0);
  return [...charts.values()];
}

/** Return the names of the fields of feedback that tell the progress. */
export function progressFieldsOf(root) {
  const fields = Object.keys(resolverOf(root)(root).properties ?? {});
  return {
    percent: fields.find((name) => PERCENT.includes(name)),
    fraction: fields.find((name) => FRACTION.includes(name)),
    count: fields.includes("total") ? COUNTS.find((name) => fields.includes(name)) : undefined,
  };
}

/** Return a function that finds the progress in feedback, from 0 to 1; null if it does not tell. */
export function progressReader({ percent, fraction, count }) {
  let isOfHundred = Boolean(percent);
  return function read(feedback) {
    if (count && feedback?.total > 0 && Number.isFinite(Number(feedback[count] ?? NaN))) {
      return Math.min(Math.max(Number(feedback[count]) / Number(feedback.total), 0), 1);
    }
    const value = Number(feedback?.[percent ?? fraction]);
    if (!Number.isFinite(value)) {
      return null;
    }
    isOfHundred ||= value > 1;
    return Math.min(Math.max(isOfHundred ? value / 100 : value, 0), 1);
  };
}
