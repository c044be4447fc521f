// The fields of two goals that are compared.

import assert from "node:assert/strict";
import test from "node:test";
import { compared, fieldsOf } from "./comparison.js";
import { GoalRecord } from "./goal_record.js";

test("a value has a field for each plain value and for each list of them", () => {
  const value = { to: { x: 1, y: null }, way: [1, 2], stops: [{ x: 3 }], none: {}, data: new Uint8Array([1]) };
  assert.deepEqual(fieldsOf(value, "goal"), [["goal.to.x", "1"], ["goal.to.y", "null"], ["goal.way", "[1, 2]"],
    ["goal.stops[0].x", "3"], ["goal.none", "{}"], ["goal.data", '"AQ=="']]);
  assert.deepEqual(fieldsOf(undefined, "result"), [["result", ""]]);
  assert.equal(fieldsOf(Object.fromEntries(Array.from({ length: 999 }, (_, index) => [index, index])), "goal").length, 200);
});

test("a field that one of two goals does not have is empty there", () => {
  const goalOf = (change) => Object.assign(new GoalRecord("drive", "ab", undefined), { status: "SUCCEEDED" }, change);
  const rows = compared(goalOf({ goal: { x: 1 }, labels: { order: "7" } }), goalOf({ goal: { y: 2 } }));
  const differing = rows.filter(([, one, other]) => one !== other);
  assert.deepEqual(differing, [["labels", "order=7", ""], ["goal.x", "1", ""], ["goal.y", "", "2"]]);
  assert.ok(rows.some(([name]) => name === "duration"));
});
