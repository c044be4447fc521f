// A recording in place of a server, read from a file in Node.

import assert from "node:assert/strict";
import test from "node:test";
import { RecordedStore, linesOf } from "./recording.js";

globalThis.requestAnimationFrame = () => 1;
const BYTES = { type: "string", contentEncoding: "base64" };
const INFO = { name: "a", goal: {}, feedback: { type: "object", properties: { n: { type: "integer" }, data: BYTES } }, result: {} };
const SECOND = 1_000_000_000;
const line = (time, event, more = {}) => ({ time: time * SECOND, event, action: "a", goal_id: "01", ...more });
const BEGIN = [{ time: 0, event: "server", action: "a", info: INFO }, line(1, "accepted", { data: 7, client: "ann" }), line(1, "status", { status: "EXECUTING" })];
const END = line(9, "end", { status: "SUCCEEDED", data: [1] });

/** Return a store that has read these lines. */
async function read(...lines) {
  const texts = lines.map((one) => (typeof one === "string" ? one : JSON.stringify(one)));
  const store = new RecordedStore(new Blob([texts.join("\n")]), "today.jsonl", () => "decoded");
  await store.start();
  return store;
}

/** Show a goal, and wait until it has been read again. */
async function shown(store, id = "01") {
  const changed = new Promise((resolve) => {
    const { change } = store;
    store.change = () => {
      change.call(store);
      if (store.goals.get(`a/${id}`) !== before) resolve();
    };
  });
  const before = store.goals.get(`a/${id}`);
  store.show("a", id);
  await changed;
  return store.goals.get(`a/${id}`);
}

test("lines are found at any border of the pieces of a file, each with its place", async () => {
  const chunks = ["on", "e\ntw", "o\n\n", "ümlaut"].map((text) => new TextEncoder().encode(text));
  const blob = { slice: () => ({ stream: () => new ReadableStream({ start(to) {
    chunks.forEach((chunk) => to.enqueue(chunk));
    to.close();
  } }) }) };
  const found = [];
  for await (const one of linesOf(blob)) found.push(one);
  assert.deepEqual(found, [[0, "one"], [4, "two"], [8, ""], [9, "ümlaut"]]);
});

test("a goal has what was recorded, at its times", async () => {
  const store = await read(...BEGIN, line(3, "feedback", { number: 1, data: { n: 4, data: "AAE=" } }), END);
  const goal = await shown(store);
  assert.deepEqual([goal.status, goal.client, goal.goal, goal.result], ["SUCCEEDED", "ann", 7, [1]]);
  assert.deepEqual([goal.sentAt, goal.startedAt, goal.seconds()], [1000, 1000, 8]);
  assert.deepEqual(goal.feedback, { n: 4, data: Uint8Array.of(0, 1) });
  assert.deepEqual(goal.series.charts[0].lines[0].times, [2]);
  assert.equal(store.state, "recording today.jsonl");
});

test("a goal that was thinned is read again when it is shown", async () => {
  const many = Array.from({ length: 1000 }, (_, n) => line(1 + n / 1000, "feedback", { number: n + 1, data: { n } }));
  const store = await read(...BEGIN, ...many, END);
  assert.ok(store.goals.get("a/01").series.charts[0].lines[0].values.length < 200);
  assert.equal((await shown(store)).series.charts[0].lines[0].values.length, 1000);
});

test("a goal that is shown while the file is read is read again afterwards", async () => {
  const many = Array.from({ length: 1000 }, (_, n) => line(1 + n / 1000, "feedback", { number: n + 1, data: { n } }));
  const store = new RecordedStore(new Blob([[...BEGIN, ...many, END].map((one) => JSON.stringify(one)).join("\n")]), "", null);
  [...BEGIN, END].forEach((one) => store.take(one, 0));
  store.show("a", "01");
  const again = new Promise((resolve) => {
    store.fill = resolve;
  });
  await store.start();
  assert.equal(await again, "a/01");
});

test("a goal is made smaller as soon as its end is read", () => {
  const store = new RecordedStore(new Blob([]), "", null);
  const many = Array.from({ length: 1000 }, (_, n) => line(1 + n / 1000, "feedback", { number: n + 1, data: { n } }));
  [...BEGIN, ...many, END].forEach((one) => store.take(one, 0));
  assert.ok(store.goals.get("a/01").series.charts[0].lines[0].values.length < 200);
});

test("rejected goals, goals without an end, steps and payloads are shown", async () => {
  const store = await read(...BEGIN, line(2, "rejected", { goal_id: "02", reason: "full", parent: "01", step: "lift", raw: "wQ==" }), '{"time": 3, "ev');
  const [rejected, open] = [store.goals.get("a/02"), store.goals.get("a/01")];
  assert.deepEqual([rejected.status, rejected.reason, rejected.goal, rejected.seconds()], ["REJECTED", "full", "decoded", 0]);
  assert.equal(rejected.parent.id, open.id);
  assert.deepEqual([open.status, open.reason, open.seconds()], ["UNKNOWN", "the recording ends before the end of this goal", null]);
});

test("lines that are not of a recording are left out, and a file without any says so", async () => {
  const store = await read("[1]", "null", "{}", '{"event": 3}', ...BEGIN, line(2, "left"), line(2, "feedback", { goal_id: "77" }), END);
  assert.deepEqual([...store.goals.keys()], ["a/01"]);
  assert.equal((await read("hello")).state, "today.jsonl is not a recording, or is empty");
});

test("a file that cannot be read says so", async () => {
  const broken = { size: 1, slice: () => ({ stream: () => new ReadableStream({ start: (to) => to.error(new Error("it is away")) }) }) };
  const store = new RecordedStore(broken, "today.jsonl", null);
  await store.start();
  assert.equal(store.state, "today.jsonl cannot be read: it is away");
});
