// Files of goals that the console writes.

import assert from "node:assert/strict";
import test from "node:test";
import { csvOf, jsonOf } from "./goal_export.js";
import { GoalRecord } from "./goal_record.js";

function goalOf(change) {
  return Object.assign(new GoalRecord("arm/drive", "ab", undefined), { status: "ABORTED", sentAt: 0, ...change });
}

const FULL = { sentAt: 1000, startedAt: 2000, endedAt: 3500, client: "ann", worker: "w1", labels: { order: "1,7" },
  reason: 'the "arm"\nis stuck', goal: { size: 2n ** 60n, data: new Uint8Array([255]) }, result: [1] };

test("JSON has whole values: integers exactly, and bytes as base64", () => {
  const [told, empty] = JSON.parse(jsonOf([goalOf(FULL), goalOf({})]));
  assert.deepEqual({ ...told, goal: null }, { action: "arm/drive", goal_id: "ab", status: "ABORTED",
    accepted: "1970-01-01T00:00:01.000Z", began: "1970-01-01T00:00:02.000Z", ended: "1970-01-01T00:00:03.500Z",
    client: "ann", worker: "w1", labels: { order: "1,7" }, reason: FULL.reason, goal: null, result: [1] });
  assert.equal(told.goal.data, "/w==");
  assert.match(jsonOf([goalOf(FULL)]), /"size": 1152921504606846976/);
  assert.ok(!("goal" in empty) && !("accepted" in empty));
  assert.equal(jsonOf([]), "[]\n");
});

test("CSV has a line for each goal, with quotes where a cell needs them", () => {
  const lines = csvOf([goalOf({ ...FULL, reason: "" }), goalOf({})]).split("\r\n");
  assert.equal(lines[0], "action,goal_id,status,accepted,began,ended,client,worker,labels,reason,goal,result");
  assert.equal(lines[1], "arm/drive,ab,ABORTED,1970-01-01T00:00:01.000Z,1970-01-01T00:00:02.000Z,"
    + '1970-01-01T00:00:03.500Z,ann,w1,"{""order"": ""1,7""}",,"{""size"": 1152921504606846976,""data"": ""/w==""}",[1]');
  assert.equal(lines[2], "arm/drive,ab,ABORTED,,,,,,{},,,");
  assert.deepEqual(lines.slice(3), [""]);
  assert.match(csvOf([goalOf(FULL)]), /,"the ""arm""\nis stuck",/);
});

test("no text of a client becomes a formula of a table", () => {
  for (const reason of ["=1+1", "+1", "-1", "@A1", "\tx"]) {
    assert.ok(csvOf([goalOf({ reason })]).includes(`,'${reason},`));
  }
  assert.ok(csvOf([goalOf({ goal: -1 })]).includes(",-1,"));
});
