// The client against `fibaction serve`, in a process that is killed and started again.

import assert from "node:assert/strict";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";
import { after, afterEach, before, test } from "node:test";
import WebSocket from "ws";
import { ActionError, CancelRefused, Connection, ConnectionLost, GoalRejected } from "./fibaction.js";
import { Line, Robot, freePort } from "./robot.mjs";

const COUNT = "arm/count";
const LARGE = 2n ** 63n - 1n;
let robot;
const open = [];

function connect(url = robot.url, options = {}) {
  const connection = new Connection(url, { WebSocket, ...options });
  open.push(connection);
  return connection;
}

async function listOf(feedback) {
  const items = [];
  for await (const item of feedback) items.push(item);
  return items;
}

const upTo = (number) => Array.from({ length: number }, (_, index) => index + 1);

before(async () => {
  robot = await new Robot(await freePort()).start();
});
afterEach(() => open.splice(0).forEach((connection) => connection.close()));
after(() => Robot.killAll());

test("actions are listed with their schemas", async () => {
  const actions = await connect().actions();
  assert.deepEqual(actions.map((action) => action.name).sort(), [COUNT, "latest"]);
  const [count] = actions.filter((action) => action.name === COUNT);
  assert.equal(count.typeName, "");
  assert.ok(JSON.stringify(count.goal).includes("pauses"));
});

test("a goal gives its feedback in order, and its result", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 5 });
  assert.match(goal.id, /^[0-9a-f]{32}$/);
  assert.equal(typeof goal.stamp, "bigint");
  assert.deepEqual(await listOf(goal.feedback), [1, 2, 3, 4, 5]);
  assert.deepEqual(await goal.outcome, { status: "SUCCEEDED",
    result: { to: 5, attempt: 1, large: LARGE }, reason: "", feedbackDropped: 0 });
  assert.deepEqual([goal.status, goal.number, goal.attempt], ["SUCCEEDED", 5, 1]);
});

test("an aborted goal has a reason and a result", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 1, then: "abort" });
  const { status, reason, result } = await goal.outcome;
  assert.deepEqual([status, reason, result.to], ["ABORTED", "the arm is stuck", 1]);
});

test("the meta of a goal goes with it, and one that is too large is an error", async () => {
  const told = async (meta) => {
    const goal = await connect().sendGoal(COUNT, { to: 1, then: "trace" }, { meta });
    return (await goal.outcome).reason;
  };
  assert.equal(await told({ traceparent: "00-1" }), "00-1");
  assert.equal(await told(undefined), "none");
  await assert.rejects(told({ traceparent: "x".repeat(4096) }), /4096 are the limit/);
});

test("a rejected goal is an error with the server's reason", async () => {
  await assert.rejects(connect().sendGoal(COUNT, { to: -1 }), (error) =>
    error instanceof GoalRejected && error.reason === "it is negative"
    && error.name === "GoalRejected" && error.message.includes("it is negative"));
});

test("an error of the server is told by its name", async () => {
  await assert.rejects(connect().sendGoal("nothing", {}), (error) =>
    error instanceof ActionError && error.name === "ServerNotFound");
  await assert.rejects(connect().attach(COUNT, "ab".repeat(16)), { name: "UnknownGoal" });
});

test("a value that cannot be sent is an error at once", async () => {
  const connection = connect();
  await connection.ready;
  await assert.rejects(connection.sendGoal(COUNT, { to: () => 1 }), TypeError);
  await assert.rejects(connection.sendGoal(COUNT, { to: 1 }, { id: "12" }), TypeError);
  await assert.rejects(connection.sendGoal(COUNT, new Uint8Array(2 ** 21)), { name: "LimitReached" });
  assert.equal(connection.state, "ready");
});

test("the same goal under the same ID runs once", async () => {
  const connection = connect();
  const id = "0123456789abcdef".repeat(2);
  const waits = { to: 0, then: "wait" };
  const [first, second] = await Promise.all([connection.sendGoal(COUNT, waits, { id }),
    connection.sendGoal(COUNT, waits, { id })]);
  assert.equal(first.stamp, second.stamp);
  await first.cancel();
  assert.equal((await first.outcome).status, "CANCELED");
  assert.deepEqual(await first.outcome, await second.outcome);
});

test("a goal is canceled, and a second cancel is refused", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 1, then: "wait" });
  const statuses = [];
  goal.onstatus = (status) => statuses.push(status);
  assert.deepEqual((await goal.cancel()).map(({ id }) => id), [goal.id]);
  assert.equal((await goal.outcome).status, "CANCELED");
  assert.equal(statuses.at(-1), "CANCELED");
  await assert.rejects(goal.cancel(), (error) => error instanceof CancelRefused && error.code === 3);
});

test("a refused cancel has the server's reason", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 13, then: "wait" });
  await assert.rejects(goal.cancel(), { name: "CancelRefused", reason: "13 must not stop" });
  goal.leave();
  await assert.rejects(goal.outcome, ActionError);
});

test("all goals are canceled by one request", async () => {
  const connection = connect();
  const goals = [await connection.sendGoal("latest", { to: 1, then: "wait" }),
    await connection.sendGoal("latest", { to: 1, then: "wait" })];
  const canceled = await connection.cancel("latest");
  assert.deepEqual(canceled.map(({ id }) => id).sort(), goals.map(({ id }) => id).sort());
  assert.deepEqual(await connection.cancel("latest", { before: 1n }), []);
});

test("a signal cancels its goal", async () => {
  const connection = connect();
  await assert.rejects(connection.sendGoal(COUNT, { to: 1 }, { signal: AbortSignal.abort() }),
    { name: "AbortError" });
  const control = new AbortController();
  const goal = await connection.sendGoal(COUNT, { to: 1, then: "wait" }, { signal: control.signal });
  control.abort();
  assert.equal((await goal.outcome).status, "CANCELED");
});

test("a signal that comes before the answer cancels the goal as well", async () => {
  const connection = connect(), control = new AbortController(), id = "1f".repeat(16);
  const sending = connection.sendGoal(COUNT, { to: 1, then: "wait" }, { id, signal: control.signal });
  control.abort(new Error("no more"));
  await assert.rejects(sending, /no more/);
  const ended = await new Promise((resolve) => connection.watch(COUNT, (info) =>
    info.id === id && info.status === "CANCELED" && resolve(info)));
  assert.equal(ended.status, "CANCELED");
});

test("an observer attaches to a goal of another client, and reads on where it was", async () => {
  const sent = await connect().sendGoal(COUNT, { to: 5, then: "wait" });
  for await (const number of sent.feedback) if (number === 5) break;
  const goal = await connect().attach(COUNT, sent.id, { after: 2, observe: true });
  assert.deepEqual(goal.goal.to, 5);
  const seen = [];
  for await (const number of goal.feedback) if (seen.push(number) === 3) break;
  assert.deepEqual(seen, [3, 4, 5]);
  assert.equal(goal.number, 5);
  await goal.cancel();
  assert.equal((await goal.outcome).status, "CANCELED");
});

test("every goal of an action is told to each watcher, until it stops", async () => {
  const connection = connect();
  const first = [], second = [];
  let stopSecond;
  const ended = new Promise((resolve) => connection.watch(COUNT, (info) => {
    first.push(info);
    if (info.status === "SUCCEEDED" && info.id === "aa".repeat(16)) resolve();
    throw new Error("an error of the program"); // goes to the console
  }));
  const error = console.error;
  console.error = () => {};
  await connection.sendGoal(COUNT, { to: 0 }, { id: "aa".repeat(16) });
  await ended;
  console.error = error;
  const [info] = first.filter(({ id }) => id === "aa".repeat(16));
  assert.equal(typeof info.stamp, "bigint");
  assert.match(info.client, /^127\.0\.0\.1/);
  assert.equal(info.parent, null);
  await new Promise((resolve) => stopSecond = connection.watch(COUNT, (one) =>
    second.push(one) && one.id === info.id && resolve()));
  stopSecond();
  const count = second.length;
  const other = await connection.sendGoal(COUNT, { to: 0 });
  await other.outcome;
  assert.equal(second.length, count);
});

test("the goal of an executor is told with its parent and its step", async () => {
  const connection = connect(), meta = { parent: "ab".repeat(16), step: "count" };
  const goal = await connection.sendGoal(COUNT, { to: 0 }, { meta });
  const info = await new Promise((resolve) => connection.watch(COUNT, (one) =>
    one.id === goal.id && resolve(one)));
  assert.deepEqual(info.parent, { id: meta.parent, step: "count" });
});

test("a goal of a list has its labels, and a page of the history its goals", async () => {
  const folder = mkdtempSync(path.join(tmpdir(), "fibaction-"));
  const keeper = await new Robot(await freePort(), "--store", path.join(folder, "goals.db"), "--history", "1").start();
  try {
    const connection = connect(keeper.url);
    const sent = [];
    for (const to of [1, 2, 3]) {
      const goal = await connection.sendGoal(COUNT, { to }, { meta: { order: String(to % 2), traceparent: "00-1" } });
      await goal.outcome;
      sent.unshift(goal.id);
    }
    const info = await new Promise((resolve) => connection.watch(COUNT, (one) => one.id === sent[0] && resolve(one)));
    assert.deepEqual([info.labels, info.worker], [{ order: "1" }, ""]);
    const past = (limit, after, labels) =>
      connection.request(20, COUNT, limit, [[], "", null, null, limit, after, true], labels);
    const first = await past(2, null, []);
    assert.deepEqual(first.map(({ id }) => id), sent.slice(0, 2));
    const place = [first[1].stamp, Uint8Array.from(first[1].id.match(/../g), (pair) => parseInt(pair, 16))];
    assert.deepEqual((await past(2, place, [])).map(({ id }) => id), sent.slice(2));
    const odd = await past(10, null, [["order", "1"]]);
    assert.deepEqual(odd.map(({ status, labels }) => [status, labels]), Array(2).fill(["SUCCEEDED", { order: "1" }]));
    await assert.rejects(connection.request(20, "nothing", 1, [[], "", null, null, 1, null, true], []), { name: "ServerNotFound" });
  } finally {
    await keeper.kill();
    rmSync(folder, { recursive: true });
  }
});

test("labels go with a goal, and are told to those who follow it", async () => {
  const connection = connect(), labels = { order: "17" };
  const goal = await connection.sendGoal(COUNT, { to: 1, then: "wait" }, { labels });
  const info = await new Promise((resolve) => connection.watch(COUNT, (one) =>
    one.id === goal.id && resolve(one)));
  const follower = await connect().attach(COUNT, goal.id);
  assert.deepEqual([goal.labels, info.labels, follower.labels], [labels, labels, labels]);
  assert.equal(info.worker, "");
  const other = await connect().attach(COUNT, (await connection.sendGoal(COUNT, { to: 0 })).id);
  assert.deepEqual(other.labels, {});
  await goal.cancel();
  await assert.rejects(connection.sendGoal(COUNT, { to: 1 }, { labels: { parent: "17" } }),
    { name: "TypeError", message: "'parent' cannot be a label" });
});

test("a watch that the server rejects tells its error", async () => {
  const error = await new Promise((resolve) => connect().watch("nothing", () => {}, resolve));
  assert.equal(error.name, "ServerNotFound");
});

test("to leave the loop stops the feedback, and the outcome still comes", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 2000 });
  for await (const number of goal.feedback) if (number === 3) break;
  assert.deepEqual(await listOf(goal.feedback), []);
  assert.equal((await goal.outcome).status, "SUCCEEDED");
});

test("a reader that waits ends when the iterator returns", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 0, then: "wait" });
  const waiting = goal.feedback.next();
  assert.deepEqual(await goal.feedback.return(7), { done: true, value: 7 });
  assert.equal((await waiting).done, true);
  await goal.cancel();
});

test("a client that only waits for the outcome does not stop the executor", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 3000 });
  const { status, feedbackDropped } = await goal.outcome;
  assert.equal(status, "SUCCEEDED");
  assert.equal(feedbackDropped + (await listOf(goal.feedback)).length, 3000);
});

test("a goal without feedback has an outcome", async () => {
  const goal = await connect().sendGoal(COUNT, { to: 3000 }, { feedback: false });
  assert.deepEqual(await listOf(goal.feedback), []);
  assert.equal((await goal.outcome).status, "SUCCEEDED");
});

test("a slow reader of the latest feedback gets the newest", async () => {
  const goal = await connect().sendGoal("latest", { to: 3000 });
  const numbers = await listOf(goal.feedback);
  assert.equal(numbers.at(-1), 3000);
  assert.equal((await goal.outcome).feedbackDropped + numbers.length, 3000);
});

test("10,000 feedback messages come in order, and the executor waits for the reader", async () => {
  const watching = connect(), goal = await connect().sendGoal(COUNT, { to: 10_000 });
  let sent = 0;
  watching.watch(COUNT, (info) => info.id === goal.id && (sent = info.feedbackCount));
  const numbers = [];
  for await (const number of goal.feedback) {
    numbers.push(number);
    if (number === 10) {
      const info = await new Promise((resolve) => connect().watch(COUNT, (one) =>
        one.id === goal.id && resolve(one)));
      assert.equal(info.status, "EXECUTING");
      assert.ok(info.feedbackCount < 5000, `${info.feedbackCount} were made for 10 that are read`);
    }
  }
  assert.deepEqual(numbers, upTo(10_000));
  assert.equal((await goal.outcome).feedbackDropped, 0);
});

test("after a cut, no feedback is missed, and none comes twice", async () => {
  const line = await new Line().open(robot.url);
  const states = [];
  const connection = connect(line.url, { onstate: (state) => states.push(state) });
  const goal = await connection.sendGoal(COUNT, { to: 600, pause: 0.001 });
  const numbers = [];
  for await (const number of goal.feedback) {
    numbers.push(number);
    if (number % 150 === 0) line.cut();
  }
  assert.deepEqual(numbers, upTo(600));
  assert.deepEqual((await goal.outcome).feedbackDropped, 0);
  // A later cut may come before the line is there again.
  assert.ok(states.length >= 3, states.join());
  states.forEach((state, at) => assert.equal(state, at % 2 ? "lost" : "ready"));
  line.close();
});

test("a goal that was sent while the line was cut runs once", async () => {
  const line = await new Line().open(robot.url);
  const connection = connect(line.url);
  await connection.ready;
  line.cut();
  const goal = await connection.sendGoal(COUNT, { to: 3 });
  assert.deepEqual(await listOf(goal.feedback), [1, 2, 3]);
  line.close();
});

test("a goal goes on when the server is killed and started again", async () => {
  const folder = mkdtempSync(path.join(tmpdir(), "fibaction-"));
  const own = new Robot(await freePort(), "--store", path.join(folder, "goals.db"));
  await own.start();
  try {
    const connection = connect(own.url);
    const goal = await connection.sendGoal(COUNT, { to: 40, pause: 0.05, pauses: 30 });
    const forgotten = [];
    connection.watch(COUNT, (info) => forgotten.push(info.status));
    const numbers = [];
    for await (const number of goal.feedback) {
      numbers.push([goal.attempt, goal.number, number]);
      if (numbers.length === 5) {
        await own.kill();
        await own.start();
      }
    }
    const { status, result } = await goal.outcome;
    assert.deepEqual([status, result.attempt], ["SUCCEEDED", 2]);
    const later = numbers.filter(([attempt]) => attempt === 2);
    assert.deepEqual(later, upTo(40).map((number) => [2, number, number]));
    assert.deepEqual(numbers.slice(0, 5), upTo(5).map((number) => [1, number, number]));
  } finally {
    await own.kill();
    rmSync(folder, { recursive: true });
  }
});

test("a goal that a new server does not know ends as UNKNOWN, and the watch is told", async () => {
  const own = await new Robot(await freePort()).start();
  const connection = connect(own.url);
  const goal = await connection.sendGoal(COUNT, { to: 1, then: "wait" });
  let hasSeen;
  const seen = new Promise((resolve) => hasSeen = resolve);
  const gone = new Promise((resolve) => connection.watch(COUNT, (info) =>
    info.status === "UNKNOWN" ? resolve(info) : hasSeen()));
  await seen;
  await own.kill();
  await own.start();
  assert.equal((await goal.outcome).status, "UNKNOWN");
  assert.equal((await gone).id, goal.id);
  await own.kill();
});

test("a watch goes on after a server that has stopped in good order", async () => {
  const own = await new Robot(await freePort()).start();
  const connection = connect(own.url);
  for (const signal of ["SIGINT", "SIGTERM"]) {
    const goal = await connection.sendGoal(COUNT, { to: 1 });
    let stop;
    await new Promise((resolve) => {
      stop = connection.watch(COUNT, ({ id }) => id === goal.id && resolve());
    });
    const later = new Promise((resolve) => connection.watch(COUNT, ({ id, status }) =>
      id !== goal.id && status === "SUCCEEDED" && resolve()));
    await own.kill(signal);
    await own.start();
    await connection.ready;
    await connection.sendGoal(COUNT, { to: 1 });
    await later;
    stop();
  }
  await own.kill();
});

test("a token is sent inside of the connection, and an invalid one ends it", async () => {
  const own = await new Robot(await freePort()).start("secret");
  const connection = connect(own.url, { token: "secret" });
  await connection.ready;
  const states = [];
  const refused = connect(own.url, { token: "wrong", onstate: (state) => states.push(state) });
  await assert.rejects(refused.ready, { name: "AuthenticationFailed" });
  await assert.rejects(refused.actions(), { name: "AuthenticationFailed" });
  assert.deepEqual(states, ["closed"]);
  await own.kill();
});

test("calls end with ConnectionLost when the server stays away", async () => {
  const connection = connect(`ws://127.0.0.1:${await freePort()}`, { reconnectTimeout: 0.1 });
  await assert.rejects(connection.sendGoal(COUNT, { to: 1 }), ConnectionLost);
  await assert.rejects(connection.ready, ConnectionLost);
  await assert.rejects(connection.actions(), ConnectionLost);
  assert.equal(connection.state, "connecting");
});

test("a server that comes later is found", async () => {
  const own = new Robot(await freePort());
  const connection = connect(own.url, { reconnectTimeout: 0 });
  await assert.rejects(connection.actions(), ConnectionLost);
  const ready = new Promise((resolve) => connection.onstate = resolve);
  await own.start();
  assert.equal(await ready, "ready");
  await connection.ready;
  assert.equal((await connection.actions()).length, 2);
  await own.kill();
});

test("close ends all calls, and is final", async () => {
  const connection = connect();
  const goal = await connection.sendGoal(COUNT, { to: 0, then: "wait" });
  const waiting = goal.feedback.next();
  connection.close();
  connection.close();
  assert.equal(connection.state, "closed");
  await assert.rejects(goal.outcome, ConnectionLost);
  await assert.rejects(waiting, ConnectionLost);
  await assert.rejects(connection.actions(), ConnectionLost);
  await assert.rejects(connection.ready, ConnectionLost);
});
