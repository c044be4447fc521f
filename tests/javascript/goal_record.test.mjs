// The times of goals in the console, as servers tell them and as they do not.

import assert from "node:assert/strict";
import test from "node:test";
import { GoalRecord } from "./goal_record.js";
import { Store } from "./store.js";
import { durationOf } from "./goal_text.js";

const MS = 1_000_000n;
const INFO = { name: "count", goal: {}, feedback: {}, result: {} };
globalThis.requestAnimationFrame = () => 1;

/** Return the record of a goal that a store is told of, status by status. */
function told(...changes) {
  const store = new Store({ attach: () => new Promise(() => {}) }, { add() {} });
  for (const change of changes) {
    store.takeStatus(INFO, { id: "01", stamp: 1000n * MS, client: "", place: 0, queueLength: 0,
      feedbackCount: 0, parent: null, beganAt: null, endedAt: null, reason: "", ...change });
  }
  return store.goals.get("count/01");
}

test("a goal that ended before the page came has the times that its server tells", () => {
  const goal = told({ status: "ABORTED", beganAt: 3000n * MS, endedAt: 8000n * MS, reason: "stuck" });
  assert.deepEqual([goal.startedAt, goal.endedAt, goal.seconds()], [3000, 8000, 7]);
  assert.equal(goal.reason, "stuck");
});

test("an older server tells no times, so no duration of such a goal is shown", () => {
  const goal = told({ status: "SUCCEEDED" });
  assert.deepEqual([goal.startedAt, goal.endedAt, goal.seconds()], [0, 0, null]);
  assert.equal(durationOf(goal.seconds()), "");
});

test("the page notes the time of what it sees, and the server's time is better", () => {
  const before = Date.now();
  const goal = told({ status: "ACCEPTED" }, { status: "EXECUTING" }, { status: "SUCCEEDED" });
  assert.ok(before <= goal.startedAt && goal.startedAt <= goal.endedAt);
  const exact = told({ status: "ACCEPTED" }, { status: "EXECUTING", beganAt: 2000n * MS },
    { status: "SUCCEEDED", beganAt: 2000n * MS, endedAt: 2500n * MS });
  assert.deepEqual([exact.startedAt, exact.endedAt, exact.seconds()], [2000, 2500, 1.5]);
});

test("a goal that ran when the page came has no begin from an older server, also when it goes on", () => {
  const goal = told({ status: "EXECUTING" }, { status: "CANCELING" });
  assert.equal(goal.startedAt, 0);
  assert.ok(goal.seconds() > 0);
  goal.setStatus("CANCELED", 9000);
  goal.setStatus("EXECUTING");
  assert.deepEqual([goal.status, goal.seconds()], ["CANCELED", 8]);
});

test("a goal of the history keeps its times", () => {
  const goal = told({ status: "SUCCEEDED", beganAt: 2000n * MS, endedAt: 2500n * MS });
  assert.equal(GoalRecord.of(goal.kept(), INFO).seconds(), 1.5);
});

/** Return the description of an action whose schemas count how often they are read. */
function counting(name = "count") {
  const read = { times: 0 };
  const schema = () => ({ type: "object", get properties() {
    read.times += 1;
    return { value: { type: "integer" } };
  } });
  return [{ name, goal: schema(), feedback: schema(), result: schema() }, read];
}

test("the schemas of an action are read once for all of its goals", () => {
  const [info, read] = counting();
  const first = new GoalRecord("count", "00", info);
  const once = read.times;
  assert.ok(once > 0);
  for (let number = 1; number <= 50; number += 1) new GoalRecord("count", `${number}`, info);
  assert.equal(read.times, once);
  const second = GoalRecord.of(first.kept(), info);
  for (const record of [first, second]) record.addFeedback({ value: 7 }, 1, 1);
  assert.deepEqual(second.series.charts[0].lines[0].values, [7]);
  assert.notEqual(first.series.charts[0].lines[0], second.series.charts[0].lines[0]);
});

test("an action that is described again as before keeps its description, another one does not", () => {
  const store = new Store({ watch: () => () => {} }, { add() {} });
  const described = (name, type) => ({ name, goal: { type }, feedback: { maximum: 2n ** 64n }, result: {} });
  const [count, walk] = [described("count", "integer"), described("walk", "integer")];
  store.takeActions([count, walk]);
  store.takeActions([described("count", "integer"), described("walk", "string")]);
  assert.equal(store.actions.get("count"), count);
  assert.equal(store.actions.get("walk").goal.type, "string");
});
