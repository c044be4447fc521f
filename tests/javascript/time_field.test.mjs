// Dates and times in the form of the console: the text, and what the picker of a browser shows.

process.env.TZ = "Asia/Kolkata";

import assert from "node:assert/strict";
import test from "node:test";
import { kindOf, resolverOf } from "./schema.js";
import { isPicked, pickedOf, textOfPicked } from "./time_field.js";

test("dates and times have a picker, other texts do not", () => {
  for (const format of ["date-time", "iso-date-time", "date-time-local", "date", "time", "iso-time", "partial-time"]) assert.ok(isPicked({ format }));
  for (const format of [undefined, "uuid", "duration", "toString"]) assert.ok(!isPicked({ format }));
});

test("the picker shows a time in the time zone of the browser", () => {
  assert.equal(pickedOf("2026-01-31T12:00:00Z", "date-time"), "2026-01-31T17:30:00");
  assert.equal(pickedOf("2026-01-31T12:00:00.5+01:00", "date-time"), "2026-01-31T16:30:00");
  assert.equal(pickedOf("2026-01-31T12:00:00", "date-time"), "2026-01-31T12:00:00");
  assert.equal(pickedOf("soon", "date-time"), "");
  assert.equal(pickedOf("12:30:15Z", "time"), "12:30:15");
  assert.equal(pickedOf("", "time"), "");
});

test("what is picked has an offset, unless the text before had none", () => {
  assert.equal(textOfPicked("2026-01-31T12:00:07", "2026-01-01T00:00:00Z", "date-time"), "2026-01-31T12:00:07+05:30");
  assert.equal(textOfPicked("2026-01-31T12:00", "", "date-time"), "2026-01-31T12:00:00+05:30");
  assert.equal(textOfPicked("2026-01-31T12:00", "2026-01-01T00:00:00", "date-time"), "2026-01-31T12:00:00");
  assert.equal(textOfPicked("12:30", "01:00:00Z", "time"), "12:30:00Z");
  assert.equal(textOfPicked("12:30:15", "01:00:00", "time"), "12:30:15");
  assert.equal(textOfPicked("12:30", "01:00:00", "partial-time"), "12:30:00");
  assert.equal(textOfPicked("2026-01-31T12:00", "", "date-time-local"), "2026-01-31T12:00:00");
});

test("an object has rows of keys and values if its schema allows keys without names", () => {
  const kind = (schema) => kindOf(schema, resolverOf(schema)).kind;
  assert.equal(kind({ type: "object", additionalProperties: { type: "integer" } }), "pairs");
  assert.equal(kind({ type: "object", additionalProperties: true }), "pairs");
  assert.equal(kind({ type: "object", properties: {}, additionalProperties: true }), "object");
  assert.equal(kind({ type: "object", additionalProperties: false }), "json");
  assert.equal(kind({ type: "object" }), "json");
});
