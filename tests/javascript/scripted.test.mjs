// The client against a server that says what the test writes, at times that the test sets.

import assert from "node:assert/strict";
import { afterEach, beforeEach, mock, test } from "node:test";
import { ConnectionLost, Connection, ProtocolError, decode, encode } from "./fibaction.js";

const PING = 0, GOODBYE = 1, HELLO = 16, SEND_GOAL = 17, FOLLOW = 18, WATCH_STATUS = 20,
  LIST_ACTIONS = 22, CLOSE = 24, WELCOME = 32, FOLLOWING = 33, FAILED = 35,
  FEEDBACK = 36, ENDED = 38, GOAL_CHANGED = 40, FINISHED = 42, WATCHING = 44, PLACES = 46;
const NEWER = 99; // a message that this client does not know
const SECOND = 1000;
const clock = performance.now;
let now, sockets;

class ScriptedSocket {
  readyState = 0;
  said = [];

  constructor() {
    sockets.push(this);
  }

  open() {
    this.readyState = 1;
    this.onopen();
    return this.hear([WELCOME, 1, 30, 2 ** 20, 30]);
  }

  /** Give the client messages of the server, or any data. */
  hear(...messages) {
    for (const message of messages) {
      const data = Array.isArray(message) ? frame(encode(message)) : message;
      this.onmessage({ data });
    }
    return this;
  }

  send(bytes) {
    this.said.push(decode(bytes.subarray(4)));
  }

  close() {
    this.readyState = 3;
  }

  cut() {
    this.close();
    this.onclose({ code: 1006, reason: "" });
  }
}

function frame(body, length = body.length) {
  const bytes = new Uint8Array(4 + body.length);
  new DataView(bytes.buffer).setUint32(0, length);
  bytes.set(body, 4);
  return bytes.buffer;
}

function connect(options) {
  return new Connection("ws://127.0.0.1:1", { WebSocket: ScriptedSocket, ...options });
}

/** The next attempt to connect. */
function nextSocket() {
  const count = sockets.length;
  mock.timers.tick(2 * SECOND);
  assert.equal(sockets.length, count + 1);
  return sockets.at(-1);
}

beforeEach(() => {
  [now, sockets] = [0, []];
  performance.now = () => now;
  mock.timers.enable({ apis: ["setTimeout", "setInterval"] });
});
afterEach(() => {
  mock.timers.reset();
  performance.now = clock;
});

test("in a tab without timers, a heartbeat is sent when a message comes", () => {
  connect();
  const socket = sockets[0].open();
  now = 14 * SECOND;
  socket.hear([PING]);
  assert.deepEqual(socket.said.map(([tag]) => tag), [HELLO]);
  now = 16 * SECOND;
  socket.hear([PING]);
  assert.deepEqual(socket.said.slice(1), [[PING]]);
});

test("a silent server is left, and dialed again", async () => {
  const states = [];
  connect({ onstate: (state) => states.push(state) });
  sockets[0].open();
  now = 119 * SECOND;
  mock.timers.tick(SECOND);
  assert.deepEqual(states, ["ready"]);
  now = 121 * SECOND;
  mock.timers.tick(SECOND);
  assert.deepEqual(states, ["ready", "lost"]);
  assert.equal(sockets[0].readyState, 3);
  nextSocket().open();
  assert.deepEqual(states, ["ready", "lost", "ready"]);
});

test("a server that never answers is left as well", async () => {
  const connection = connect({ reconnectTimeout: 5 });
  sockets[0].readyState = 1;
  sockets[0].onopen();
  const actions = connection.actions();
  now = 11 * SECOND;
  mock.timers.tick(SECOND);
  await assert.rejects(actions, (error) => error instanceof ConnectionLost && /silent/.test(error.message));
});

test("calls are opened anew before the program hears that the connection is ready", async () => {
  const connection = connect();
  sockets[0].open();
  const sending = connection.sendGoal("count", { to: 3 }, { id: "ab".repeat(16) });
  const [tag, number] = sockets[0].said[1];
  assert.equal(tag, SEND_GOAL);
  sockets[0].hear([FOLLOWING, number, 5, 2, false, 0], [FEEDBACK, number, 1, encode(1), 2n ** 60n]);
  const goal = await sending;
  assert.deepEqual((await goal.feedback.next()).value, 1);
  assert.equal(goal.at, 2n ** 60n);
  sockets[0].cut();
  connection.onstate = (state) => state === "ready" && connection.actions();
  const second = nextSocket().open();
  assert.deepEqual(second.said.map(([one]) => one), [HELLO, FOLLOW, LIST_ACTIONS]);
  assert.equal(second.said[1][4], 1); // the feedback after which to go on
});

test("feedback of a server that does not tell its time has that of the arrival", async () => {
  const connection = connect();
  sockets[0].open();
  const sending = connection.sendGoal("count", { to: 3 });
  const [, number] = sockets[0].said[1];
  const before = BigInt(Date.now()) * 1000000n;
  sockets[0].hear([FOLLOWING, number, 5, 2, false, 0], [FEEDBACK, number, 1, encode(1)]);
  const goal = await sending;
  assert.equal(goal.at, 0n);
  await goal.feedback.next();
  assert.ok(goal.at >= before && goal.at <= BigInt(Date.now()) * 1000000n);
});

test("what is no message ends the connection for good, and the server is told", async () => {
  const garbage = ["text", new ArrayBuffer(3), frame(Uint8Array.of(0xc1)), frame(Uint8Array.of(5)),
    frame(Uint8Array.of(0x90), 100), [WELCOME, 2, 30]];
  for (const data of garbage) {
    const connection = connect();
    const socket = sockets.at(-1).open();
    const actions = connection.actions();
    socket.hear(data);
    await assert.rejects(actions, ProtocolError);
    assert.equal(connection.state, "closed");
    assert.equal(socket.said.at(-1)[0], GOODBYE);
    assert.equal(socket.readyState, 3);
  }
});

test("a server that stops is dialed again, and one that refuses the token is not", () => {
  const connection = connect();
  sockets[0].open().hear([GOODBYE, "it stops", 3]);
  assert.equal(connection.state, "lost");
  nextSocket().open().hear([GOODBYE, "the token is not valid", 4]);
  assert.equal(connection.state, "closed");
  mock.timers.tick(60 * SECOND);
  assert.equal(sockets.length, 2);
});

test("a goal that was given up has its checkpoint, which is null if it has none", async () => {
  const connection = connect();
  sockets[0].open();
  for (const [told, found] of [[encode({ done: 4 }), { done: 4 }], [new Uint8Array(), null],
    [null, undefined]]) {
    const attaching = connection.attach("count", "ab".repeat(16));
    const [, number] = sockets[0].said.at(-1);
    sockets[0].hear([FOLLOWING, number, 5, 6, false, 0, 3, null, null, null, told]);
    assert.deepEqual((await attaching).checkpoint, found);
  }
});

test("a request of one's own is answered with the fields of the answer", async () => {
  const connection = connect();
  sockets[0].open();
  const answer = connection.request(27, "count", 10);
  assert.deepEqual(sockets[0].said[1], [27, 1, "count", 10]);
  sockets[0].hear([PLACES, 1, [[Uint8Array.of(1), 1, 2]]]);
  assert.deepEqual(await answer, [[[Uint8Array.of(1), 1, 2]]]);
});

/** Watch an action whose goals the server has told; return what the program hears, and the rest. */
function watched() {
  const told = [], errors = [];
  const connection = connect();
  const socket = sockets[0].open();
  const stop = connection.watch("count", ({ id, status }) => told.push([id, status]),
    (error) => errors.push(error));
  const [, number] = socket.said.at(-1);
  socket.hear([WATCHING, number, 1], [GOAL_CHANGED, number, new Uint8Array(16), 7, 2, 0]);
  told.length = 0; // as the goal is known now
  return { connection, socket, stop, number, told, errors };
}
const FIRST = "00".repeat(16);

/** What was said since, without heartbeats. */
function saidSince(socket, count) {
  return socket.said.slice(count).filter(([tag]) => tag !== PING);
}

test("a watch that the server ends is opened anew, until the action is served again", () => {
  const { socket, number, told, errors } = watched();
  socket.hear([FINISHED, number]);
  let last;
  for (const isServed of [false, true]) {
    mock.timers.tick(2 * SECOND);
    last = socket.said.findLast(([tag]) => tag !== PING);
    assert.deepEqual([last[0], last[2]], [WATCH_STATUS, "count"]);
    if (!isServed) socket.hear([FAILED, last[1], 2, "it is not served"]);
  }
  socket.hear([WATCHING, last[1], 1], [GOAL_CHANGED, last[1], new Uint8Array(16).fill(1), 9, 1, 0]);
  assert.deepEqual(told, [["01".repeat(16), "ACCEPTED"], [FIRST, "UNKNOWN"]]);
  assert.deepEqual(errors, []);
});

test("a watch goes on after a server that has stopped in good order", () => {
  const { socket, number, told } = watched();
  socket.hear([FINISHED, number], [GOODBYE, "it stops", 0]);
  const second = nextSocket().open();
  const [tag, again] = second.said.at(-1);
  assert.equal(tag, WATCH_STATUS);
  second.hear([WATCHING, again, 0]);
  assert.deepEqual(told, [[FIRST, "UNKNOWN"]]);
});

test("a watch whose server behind a gateway is away is one watch, and asks no more when it is left", () => {
  const { connection, socket, number, stop, errors } = watched();
  const said = socket.said.length;
  socket.hear([FAILED, number, 3, "the robot is away"]);
  const later = connection.watch("count", () => {});
  mock.timers.tick(2 * SECOND);
  assert.deepEqual(saidSince(socket, said).map(([tag]) => tag), [WATCH_STATUS]);
  stop();
  later();
  assert.equal(socket.said.at(-1)[0], CLOSE);
  connection.watch("count", () => {});
  const [, third] = socket.said.at(-1);
  socket.hear([WATCHING, third, 0], [FINISHED, third]);
  connection.close();
  const closed = socket.said.length;
  mock.timers.tick(4 * SECOND);
  assert.deepEqual(saidSince(socket, closed), []);
  assert.deepEqual(errors, []);
});

test("a connection that is closed by the server tells a watch that waits", () => {
  const { socket, number, errors } = watched();
  socket.hear([FAILED, number, 3, "the robot is away"], [GOODBYE, "the token is not valid", 4]);
  mock.timers.tick(2 * SECOND);
  assert.deepEqual(errors.map(({ name }) => name), ["AuthenticationFailed"]);
});

test("what a newer server says beside the rest is ignored", async () => {
  const { connection, socket, number, told, errors } = watched();
  const sending = connection.sendGoal("count", { to: 3 });
  const [, sent] = socket.said.at(-1);
  socket.hear([NEWER, 1000], [NEWER, number, "more"], [NEWER, sent], [FAILED, 1000, 1, "nobody's"]);
  socket.hear([FOLLOWING, sent, 5, 2, false, 0, 1, null, "more"], [NEWER, sent],
    [ENDED, sent, 4, null, "", 0, "more"]);
  const goal = await sending;
  assert.equal((await goal.outcome).status, "SUCCEEDED");
  socket.hear([GOAL_CHANGED, number, new Uint8Array(16), 7, 4, 0]);
  assert.deepEqual(told, [[FIRST, "SUCCEEDED"]]);
  assert.deepEqual([connection.state, errors], ["ready", []]);
});

test("an action that needs no goal is sent one without fields", () => {
  const { connection, socket } = watched();
  connection.sendGoal("home").catch(() => {});
  const goals = socket.said.at(-1).filter((part) => part instanceof Uint8Array && part.length === 1);
  assert.deepEqual(goals, [new Uint8Array([0x80])]);
});
