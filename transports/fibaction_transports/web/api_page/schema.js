/** JSON Schemas of a description as text that people read. */

import { resolverOf } from "../console/schema.js";

const DEEPEST = 8;
const LARGEST = 2 ** 53; // beyond it are the limits of all integers, which JavaScript rounds

/** Return the schema that a reference names; an empty one if there is none. */
export function target(schema, description) {
  return resolverOf(description)(schema);
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

function isObject(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
