// The progress of a goal by its feedback: the rule that the command line has, too.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { progressFieldsOf, progressReader } from "./schema.js";

test("fields of the feedback tell how far", () => {
  for (const [feedbacks, fractions] of JSON.parse(readFileSync("progress.json", "utf8"))) {
    const names = Object.keys(feedbacks[0]);
    const schema = { properties: Object.fromEntries(names.map((name) => [name, {}])) };
    const read = progressReader(progressFieldsOf(schema));
    assert.deepEqual(feedbacks.map(read), fractions, JSON.stringify(feedbacks));
  }
});
