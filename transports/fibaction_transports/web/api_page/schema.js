/** JSON Schemas of a description as text that people read, and as values to begin with. */

const DEEPEST = 8;
const LARGEST = 2 ** 53; // beyond it are the limits of all integers, which JavaScript rounds

/** Return the schema that a reference names; an empty one if there is none. */
export function target(schema, description) {
  for (let hops = 0; hops < DEEPEST && typeof schema?.$ref === "string"; hops += 1) {
    const parts = schema.$ref.replace(/^#\//, "").split("/");
    const names = parts.map((part) => decoded(part).replaceAll("~1", "/").replaceAll("~0", "~"));
    schema = names.reduce((found, name) => found?.[name], description);
  }
  return isObject(schema) && schema.$ref === undefined ? schema : {};
}

/** Return a schema in short form, with a field on each line. */
export function schemaText(schema, description, depth = 0) {
  const found = target(schema, description);
  if (depth > DEEPEST) return "…";
  const inner = (part) => schemaText(part, description, depth + 1);
  const either = found.anyOf ?? found.oneOf;
  if (Array.isArray(either)) return either.map(inner).join(" | ") + limits(found);
  if (Array.isArray(found.allOf)) {
    const own = found.properties ? [{ properties: found.properties }] : [];
    return [...found.allOf, ...own].map(inner).join(" & ");
  }
  if (Array.isArray(found.enum)) return found.enum.map((one) => JSON.stringify(one)).join(" | ");
  if (found.const !== undefined) return JSON.stringify(found.const);
  if (isObject(found.properties)) return objectText(found, inner, depth);
  if (found.items !== undefined) return `array of ${inner(found.items)}${limits(found)}`;
  if (isObject(found.additionalProperties)) return `map of ${inner(found.additionalProperties)}`;
  const types = [found.type ?? "any"].flat().join(" | ");
  return `${types}${found.format ? ` (${found.format})` : ""}${limits(found)}`;
}

function objectText(schema, inner, depth) {
  const indent = "  ".repeat(depth + 1);
  const required = new Set(schema.required ?? []);
  const lines = Object.entries(schema.properties).map(([name, part]) => {
    const mark = required.has(name) ? "" : "?";
    const standard = part?.default === undefined ? "" : ` = ${JSON.stringify(part.default)}`;
    const unit = part?.["x-unit"] ? ` [${part["x-unit"]}]` : "";
    const note = part?.description ? `  // ${String(part.description).replaceAll("\n", " ")}` : "";
    return `${indent}${name}${mark}: ${inner(part)}${unit}${standard}${note}`;
  });
  return lines.length ? `{\n${lines.join("\n")}\n${"  ".repeat(depth)}}` : "{}";
}

const LIMITS = {
  minimum: "≥", maximum: "≤", exclusiveMinimum: ">", exclusiveMaximum: "<", minLength: "length ≥",
  maxLength: "length ≤", minItems: "items ≥", maxItems: "items ≤", pattern: "like",
};

function limits(schema) {
  const isTold = (limit) => limit !== undefined && !(Math.abs(limit) > LARGEST);
  const found = Object.entries(LIMITS).filter(([name]) => isTold(schema[name]));
  return found.map(([name, sign]) => ` ${sign} ${schema[name]}`).join("");
}

/** Return a value that fits a schema, as far as that is easy: defaults, and empty values. */
export function sample(schema, description, depth = 0) {
  const found = target(schema, description);
  const inner = (part) => sample(part, description, depth + 1);
  for (const value of [found.default, found.const, found.examples?.[0], found.enum?.[0]]) {
    if (value !== undefined) return value;
  }
  if (schema?.default !== undefined) return schema.default;
  if (depth > DEEPEST) return null;
  const either = found.anyOf ?? found.oneOf;
  if (Array.isArray(either)) {
    return inner(either.find((part) => target(part, description).type !== "null") ?? {});
  }
  if (Array.isArray(found.allOf)) return Object.assign({}, ...found.allOf.map(inner));
  if (isObject(found.properties)) {
    return Object.fromEntries(
      Object.entries(found.properties).map(([name, part]) => [name, inner(part)]),
    );
  }
  const type = [found.type].flat().find((one) => one !== "null");
  const least = found.minimum ?? (found.exclusiveMinimum === undefined ? 0 : found.exclusiveMinimum + 1);
  const first = Math.abs(least) > LARGEST ? 0 : least; // that of all integers, which is no beginning
  const simple = { integer: first, number: first, string: "", boolean: false, array: [], object: {} };
  return simple[type] ?? null;
}

export function isObject(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}
