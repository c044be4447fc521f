// A client for goals; README.md says how it works. Apache-2.0

const WINDOW = 256; // unread feedback
const HEARTBEAT = 30; // s
const MISSED = 4; // heartbeats of a dead server
const FIRST_PAUSE = 20, LONGEST_PAUSE = 2000; // ms

const PING = 0, GOODBYE = 1, HELLO = 16, SEND_GOAL = 17, FOLLOW = 18, CANCEL_GOALS = 19,
  WATCH_STATUS = 20, LIST_ACTIONS = 22, CREDIT = 23, CLOSE = 24, RECEIVED = 25, WELCOME = 32,
  FOLLOWING = 33, REJECTED = 34, FAILED = 35, FEEDBACK = 36, STATUS_CHANGED = 37, ENDED = 38,
  GOAL_CHANGED = 40, FINISHED = 42, WATCHING = 44;
const STATUSES = ["UNKNOWN", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED",
  "ABORTED"];
const ERRORS = ["ConnectionLost", "UnknownGoal", "ServerNotFound", "ConnectionLost",
  "AuthenticationFailed", "LimitReached", "ProtocolError"];

export class ActionError extends Error {
  constructor(text, fields) {
    super(text);
    Object.assign(this, { name: this.constructor.name }, fields);
  }
}
export class ConnectionLost extends ActionError {}
export class ProtocolError extends ActionError {}
export class GoalRejected extends ActionError {}
export class CancelRefused extends ActionError {}

function errorOf(why, text) {
  const name = ERRORS[why] ?? "ActionError";
  return new ({ ConnectionLost, ProtocolError }[name] ?? ActionError)(text, { name });
}

export function encode(value) {
  const bytes = [], number = new Uint8Array(8), view = new DataView(number.buffer);
  const add = (byte) => bytes.push(byte);
  const put = (tag, size) => {
    add(tag);
    number.slice(8 - size).forEach(add);
  };
  const integer = (item, tag, power = 0) => {
    while (item >= 2 ** (8 << power) || item < -(2 ** ((8 << power) - 1))) power++;
    if (power > 3) throw new RangeError(`${item} has over 64 bits`);
    view.setBigInt64(0, BigInt(item));
    put(tag + power, 1 << power);
  };
  const length = (item, short, most, tag, power) =>
    item < most ? add(short + item) : integer(item, tag, power);
  const any = (item) => {
    if (item instanceof Uint8Array) {
      length(item.length, 0, 0, 0xc4);
      item.forEach(add);
    } else if (typeof item === "string") {
      const text = new TextEncoder().encode(item);
      length(text.length, 0xa0, 32, 0xd9);
      text.forEach(add);
    } else if (item == null) add(0xc0);
    else if (typeof item === "boolean") add(item ? 0xc3 : 0xc2);
    else if (typeof item === "bigint" || Number.isSafeInteger(item) && !Object.is(item, -0)) {
      if (item >= -32 && item < 128) add(Number(item) & 0xff);
      else integer(item, item < 0 ? 0xd0 : 0xcc);
    } else if (typeof item === "number") {
      view.setFloat64(0, item);
      put(0xcb, 8);
    } else if (Array.isArray(item) || ArrayBuffer.isView(item)) {
      length(item.length, 0x90, 16, 0xdb, 1);
      item.forEach(any);
    } else if (item instanceof Date) any(item.toJSON());
    else if (typeof item === "object") {
      const pairs = [...item instanceof Map ? item : Object.entries(item)]
        .filter(([, part]) => part !== undefined);
      length(pairs.length, 0x80, 16, 0xdd, 1);
      pairs.flat().forEach(any);
    } else throw new TypeError(`a ${typeof item} cannot be sent`);
  };
  any(value);
  return Uint8Array.from(bytes);
}

const utf8 = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });

export function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let end = 0;
  const take = (size) => (end += size) - size;
  const integer = (power, kind = "Uint") => {
    const number = view[`get${power > 2 ? "Big" : ""}${kind}${8 << power}`](take(1 << power));
    return Number.isSafeInteger(Number(number)) ? Number(number) : number;
  };
  const binary = (length) => {
    if (end + length > bytes.length) throw new RangeError("cut off");
    return bytes.subarray(take(length), end);
  };
  const text = (length) => utf8.decode(binary(length));
  const array = (length) => {
    const items = [];
    while (length--) items.push(any());
    return items;
  };
  const map = (length) => {
    const pairs = [];
    while (length--) pairs.push([any(), any()]);
    return pairs.every((pair) => typeof pair[0] === "string") ? Object.fromEntries(pairs)
      : new Map(pairs);
  };
  const any = () => {
    const tag = integer(0);
    if (tag < 0x80) return tag;
    if (tag < 0x90) return map(tag & 15);
    if (tag < 0xa0) return array(tag & 15);
    if (tag < 0xc0) return text(tag & 31);
    if (tag === 0xc0) return null;
    if (tag < 0xc2 || tag > 0xc6 && tag < 0xca || tag > 0xd3 && tag < 0xd9) {
      throw new RangeError("no tag");
    }
    if (tag < 0xc4) return tag > 0xc2;
    if (tag < 0xc7) return binary(integer(tag - 0xc4));
    if (tag < 0xcb) return view.getFloat32(take(4));
    if (tag < 0xcc) return view.getFloat64(take(8));
    if (tag < 0xd0) return integer(tag - 0xcc);
    if (tag < 0xd4) return integer(tag - 0xd0, "Int");
    if (tag < 0xdc) return text(integer(tag - 0xd9));
    if (tag < 0xde) return array(integer(tag - 0xdb));
    if (tag < 0xe0) return map(integer(tag - 0xdd));
    return tag - 256;
  };
  try {
    return any();
  } catch (error) {
    throw new ProtocolError(`invalid bytes: ${error.message}`);
  }
}

const randomID = () => crypto.getRandomValues(new Uint8Array(16));
const hexOf = (id) => Array.from(id, (byte) => byte.toString(16).padStart(2, "0")).join("");
function idOf(hex) {
  if (!/^[0-9a-f]{32}$/i.test(hex)) throw new TypeError(`'${hex}' is not 32 hex digits`);
  return Uint8Array.from(hex.match(/../g), (pair) => parseInt(pair, 16));
}

function metaOf(labels, meta) {
  for (const key in labels) {
    if (/^(trace(parent|state)|baggage|detached|parent|step)$/.test(key)) {
      throw new TypeError(`'${key}' cannot be a label`);
    }
  }
  return { ...labels, ...meta };
}

function deferred() {
  const parts = {};
  parts.promise = new Promise((resolve, reject) => Object.assign(parts, { resolve, reject }));
  parts.promise.catch(() => {});
  return parts;
}

function tell(callback, value) {
  try {
    callback?.(value);
  } catch (error) {
    console.error(error);
  }
}

class Goal {
  onstatus = null;
  number = 0;
  at = 0n;
  _status = 0;
  _items = [];
  _readers = [];
  _dropped = 0;
  _accepted = deferred();
  _ended = deferred();

  constructor(fields) {
    Object.assign(this, fields, { id: hexOf(fields._id) });
  }

  get status() {
    return STATUSES[this._status];
  }

  get outcome() {
    this._isReleased = !this._iterator; // the executor must not wait
    this._makeRoom();
    return this._ended.promise;
  }

  get feedback() {
    this._isReleased = false;
    return this._iterator ??= {
      [Symbol.asyncIterator]() { return this; },
      next: () => new Promise((...reader) => {
        this._readers.push(reader);
        this._deliver();
      }),
      return: async (value) => {
        this._stop();
        return { done: true, value };
      },
    };
  }

  cancel() {
    return this._connection.cancel(this.action, this);
  }

  leave() {
    this._stop();
    this._connection._leave(this, RECEIVED);
    this.fail(new ActionError("the goal is left"));
  }

  opening() {
    const credit = this._reads ? WINDOW - this._items.length : null;
    return this._payload && !this.stamp
      ? [SEND_GOAL, this.action, this._id, this._payload, credit, null, this._meta]
      : [FOLLOW, this.action, this._id, this._last, this._isOwn, credit, this._attempt];
  }

  [FOLLOWING](stamp, status, latest, place, attempt = 1, goal = null, parent, labels, checkpoint) {
    stamp = BigInt(stamp);
    if (!this.stamp) {
      this.goal ??= goal && decode(goal);
      this.labels ??= labels ?? {};
      if (checkpoint) this.checkpoint = checkpoint.length ? decode(checkpoint) : null;
      Object.assign(this, { stamp, attempt, number: place, _attempt: attempt, _last: place,
        _latest: latest });
      this._accepted.resolve(this);
    } else if (this.stamp !== stamp) { // of another server
      this._connection._leave(this, CLOSE);
      return this[ENDED](0, null, "", 0);
    } else if (attempt !== this._attempt) Object.assign(this, { _attempt: attempt, _last: place });
    this[STATUS_CHANGED](status);
  }

  [STATUS_CHANGED](status) {
    if (status <= this._status) return;
    this._status = status;
    tell(this.onstatus, this.status);
  }

  [FEEDBACK](number, payload, at) {
    if (number <= this._last) return;
    this._dropped += number - this._last - 1;
    this._last = number;
    at = BigInt(at ?? BigInt(Date.now()) * 1000000n);
    if (this._reads) this._items.push([number, this._attempt, at, decode(payload)]);
    this._makeRoom();
    this._deliver();
  }

  [ENDED](status, result, reason, last) {
    this._dropped += Math.max(0, last - this._last);
    this[STATUS_CHANGED](status);
    this._ended.resolve(new Promise((resolve) => resolve({ status: STATUSES[status],
      result: result && decode(result), reason, feedbackDropped: this._dropped })));
    this._finish();
  }

  [REJECTED](reason) {
    this.fail(new GoalRejected(`the goal is rejected: ${reason}`, { reason }));
  }

  fail(error) {
    if (this.stamp && error.name === ERRORS[1]) return this[ENDED](0, null, "", 0);
    this._error = error;
    this._accepted.reject(error);
    this._ended.reject(error);
    this._finish();
  }

  _finish() {
    this._isOver = true;
    this._deliver();
  }

  _makeRoom() {
    const most = this._latest ? 1 : this._isReleased ? WINDOW / 2 : WINDOW;
    const surplus = Math.max(0, this._items.length - most);
    this._items.splice(0, surplus);
    this._dropped += surplus;
    this._connection._grant(this, surplus);
  }

  _deliver() {
    while (this._readers.length && (this._items.length || this._isOver || !this._reads)) {
      const [resolve, reject] = this._readers.shift();
      const item = this._items.shift();
      if (!item && this._error) reject(this._error);
      else if (!item) resolve({ done: true });
      else {
        this._connection._grant(this, 1);
        [this.number, this.attempt, this.at] = item;
        resolve({ done: false, value: item[3] });
      }
    }
  }

  _stop() {
    this._connection._post(this, CLOSE);
    this._reads = false;
    this._items = [];
    this._deliver();
  }
}

const stampOf = (time) => time == null ? null : BigInt(time);
const infoOf = (id, stamp, status, dropped, feedbackCount = 0, client = "", place = 0,
  queueLength = 0, attempt = 1, parent, began, ended, reason = "", labels, worker = "") => ({
  id: hexOf(id), stamp: BigInt(stamp), status: STATUSES[status], dropped, feedbackCount, client,
  place, queueLength, attempt, parent: parent && { id: hexOf(parent[0]), step: parent[1] },
  beganAt: stampOf(began), endedAt: stampOf(ended), reason, labels: labels ?? {}, worker });

class Watch {
  followers = new Set();
  goals = new Map();

  constructor(connection, action) {
    Object.assign(this, { action, _connection: connection });
  }

  opening() {
    return [WATCH_STATUS, this.action, WINDOW];
  }

  [FINISHED]() {
    setTimeout(() => this.followers.size && this._connection._open(this), LONGEST_PAUSE);
  }

  [WATCHING](known) {
    this._wasOpen = true;
    this._unlisted = known;
    this._before = new Map(this.goals);
    this._forget();
  }

  [GOAL_CHANGED](...fields) {
    const info = infoOf(...fields);
    this._connection._grant(this, 1);
    this._before.delete(info.id);
    this._tell(info);
    this._forget();
  }

  _forget() {
    if (this._unlisted--) return;
    for (const info of this._before.values()) this._tell({ ...info, status: STATUSES[0] });
  }

  _tell(info) {
    this.goals.set(info.id, info);
    if (info.status === STATUSES[0]) this.goals.delete(info.id);
    for (const { callback } of this.followers) tell(callback, info);
  }

  fail(error) {
    const mayReturn = this._connection.state !== "closed" && /Lost|NotFound/.test(error.name);
    if (mayReturn && this._wasOpen) return this[FINISHED]();
    this._connection._watches.delete(this.action);
    for (const { onerror } of this.followers) tell(onerror, error);
  }
}

export class Connection {
  state = "connecting";
  _calls = new Map();
  _watches = new Map();
  #count = 0;
  #session = randomID();
  #ready = deferred();
  #pause = FIRST_PAUSE;
  #lostAt = performance.now();
  #options; #socket; #timer; #heartbeat; #heardAt; #saidAt; #sayAfter; #maxFrame;
  #error;

  constructor(url, options) {
    this.#options = { token: "", reconnectTimeout: 30, WebSocket: globalThis.WebSocket, ...options };
    if (!this.#options.WebSocket) throw new TypeError("the option WebSocket is missing");
    const address = new URL(url, globalThis.location);
    address.protocol = address.protocol.replace("http", "ws");
    this.url = address.href;
    this.onstate = this.#options.onstate;
    this.#dial();
  }

  get ready() {
    return this.#ready.promise;
  }

  async actions() {
    const [actions] = await this.request(LIST_ACTIONS);
    return actions.map(({ type_name: typeName = "", ...action }) =>
      ({ typeName, goal: {}, feedback: {}, result: {}, ...action }));
  }

  async cancel(action, { id, before = null } = {}) {
    const [code, goals, reason] = await this.request(CANCEL_GOALS, action, id ? idOf(id) : null, before);
    if (code) {
      const text = reason || ["rejected", "unknown goal", "it has ended"][code - 1];
      throw new CancelRefused(`the cancel is refused: ${text}`, { code, reason });
    }
    return goals.map(([id, stamp, status]) =>
      ({ id: hexOf(id), stamp: BigInt(stamp), status: STATUSES[status] }));
  }

  async sendGoal(action, goal = {}, { id, signal, feedback = true, labels = {}, meta } = {}) {
    signal?.throwIfAborted();
    const sent = new Goal({ action, goal, _id: id ? idOf(id) : randomID(), _payload: encode(goal),
      _isOwn: true, labels, _meta: metaOf(labels, meta), _reads: feedback, _connection: this });
    const accepted = sent._accepted.promise;
    return new Promise((resolve, reject) => {
      const abort = () => {
        reject(signal.reason);
        accepted.then(() => sent.cancel()).catch(() => {});
      };
      signal?.addEventListener("abort", abort);
      sent._ended.promise.catch(() => {}).then(() => signal?.removeEventListener("abort", abort));
      accepted.then(resolve, reject);
      this._open(sent);
    });
  }

  async attach(action, id, { after = null, attempt = 1, observe, feedback = true } = {}) {
    const goal = new Goal({ action, _id: idOf(id), _last: after, _attempt: attempt,
      _isOwn: !observe, _reads: feedback, _connection: this });
    this._open(goal);
    return goal._accepted.promise;
  }

  watch(action, callback, onerror) {
    const follower = { callback, onerror };
    const open = this._watches.get(action);
    const watch = open ?? new Watch(this, action);
    this._watches.set(action, watch);
    const goals = [...watch.goals.values()];
    queueMicrotask(() => goals.forEach((info) => tell(callback, info)));
    watch.followers.add(follower);
    if (!open) this._open(watch);
    return () => {
      watch.followers.delete(follower);
      if (watch.followers.size || this._watches.get(action) !== watch) return;
      this._watches.delete(action);
      this._leave(watch, CLOSE);
    };
  }

  request(...message) {
    let goals; // of a page of the history
    return new Promise((resolve, fail) => this._open({
      opening: () => (goals = [], message),
      answer: (...fields) => resolve(fields),
      [WATCHING]() {},
      [GOAL_CHANGED]: (...fields) => goals.push(infoOf(...fields)),
      [FINISHED]: () => resolve(goals),
      fail,
    }));
  }

  close() {
    for (const { followers } of this._watches.values()) followers.clear();
    this.#say(GOODBYE, "", 0);
    this.#lose(new ConnectionLost("the connection is closed"), true);
  }

  _open(call) {
    call._number = ++this.#count;
    this._calls.set(call._number, call);
    if (this.state === "ready") this.#begin(call);
    else if (this.#error) this.#drop(call);
  }

  #begin(call) {
    try {
      const [tag, ...fields] = call.opening();
      call._ungranted = 0;
      this.#say(tag, call._number, ...fields);
    } catch (error) {
      this.#drop(call, error);
    }
  }

  #drop(call, error) {
    if (!error && call.followers && this.state !== "closed") return; // a watch waits for ever
    this._calls.delete(call._number);
    call.fail(error ?? this.#error);
  }

  _post(call, tag, ...fields) {
    if (this.state === "ready") this.#say(tag, call._number, ...fields);
  }

  _leave(call, tag) {
    if (this._calls.delete(call._number)) this._post(call, tag);
  }

  _grant(call, count) {
    call._ungranted += count;
    if (call._ungranted < WINDOW / 2) return;
    this._post(call, CREDIT, call._ungranted);
    call._ungranted = 0;
  }

  #say(...message) {
    const body = encode(message);
    if (body.length > this.#maxFrame) {
      throw errorOf(5, `the message has over ${this.#maxFrame} bytes`);
    }
    const frame = new Uint8Array(4 + body.length);
    new DataView(frame.buffer).setUint32(0, body.length);
    frame.set(body, 4);
    if (this.#socket?.readyState === 1) this.#socket.send(frame);
    this.#saidAt = performance.now();
  }

  #dial() {
    if (this.state === "closed") return;
    const socket = this.#socket = new this.#options.WebSocket(this.url, "fibaction.1");
    let why;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#say(HELLO, 1, HEARTBEAT, this.#options.token, this.#session);
    socket.onerror = ({ message }) => why = message;
    socket.onmessage = ({ data }) => socket === this.#socket && this.#receive(data);
    socket.onclose = ({ code, reason }) => socket === this.#socket &&
      this.#lose(new ConnectionLost(`no connection to ${this.url}: ${reason || why || code}`));
    this.#heartbeat = 2.5;
    this.#heardAt = performance.now();
    this.#timer = setInterval(() => this.#watch(), 1000);
  }

  #watch() {
    const now = performance.now();
    if (now - this.#heardAt > 1000 * MISSED * this.#heartbeat) {
      this.#lose(new ConnectionLost(`${this.url} is silent`));
    } else if (now - this.#saidAt > this.#sayAfter) this.#say(PING);
  }

  #receive(data) {
    this.#heardAt = performance.now();
    try {
      const view = new DataView(data);
      for (let at = 0; at < view.byteLength && this.#socket; at += 4 + view.getUint32(at)) {
        this.#handle(decode(new Uint8Array(data, at + 4, view.getUint32(at))));
      }
      this.#watch();
    } catch (error) {
      this.#lose(error instanceof ActionError ? error
        : new ProtocolError(`invalid message: ${error.message}`));
    }
  }

  #handle([tag, number, ...fields]) {
    if (tag === PING) return;
    if (tag === GOODBYE) throw errorOf(fields[0], `${this.url} has closed: ${number}`);
    if (tag === WELCOME) return this.#welcome(number, ...fields);
    if (tag === ENDED) this.#say(RECEIVED, number);
    const call = this._calls.get(number);
    const take = tag === FAILED ? (...why) => call?.fail(errorOf(...why))
      : call?.[tag] ?? call?.answer;
    if (!take) return; // the call was left, or the message is of a newer server
    if (![FOLLOWING, FEEDBACK, STATUS_CHANGED, WATCHING, GOAL_CHANGED].includes(tag)) {
      this._calls.delete(number);
    }
    take.apply(call, fields);
  }

  #welcome(version, heartbeat, maxFrame = 2 ** 24, maxHeartbeat = HEARTBEAT) {
    if (version !== 1) throw new ProtocolError(`the server has version ${version}`);
    this.#maxFrame = maxFrame;
    this.#sayAfter = 500 * Math.min(HEARTBEAT, maxHeartbeat);
    this.#heartbeat = heartbeat;
    if (this.#error) this.#ready = deferred();
    this.#error = null;
    this.#pause = FIRST_PAUSE;
    for (const call of [...this._calls.values()]) this.#begin(call);
    this.#ready.resolve();
    this.#change("ready");
  }

  #change(state) {
    if (state === this.state) return;
    this.state = state;
    tell(this.onstate, state);
  }

  #lose(error, isFinal = [ERRORS[4], ERRORS[6]].includes(error.name)) {
    if (this.state === "closed") return;
    if (error instanceof ProtocolError) this.#say(GOODBYE, error.message, 6);
    const socket = this.#socket;
    this.#socket = null;
    clearInterval(this.#timer);
    socket?.close();
    const wasReady = this.state === "ready";
    if (wasReady) {
      this.#lostAt = performance.now();
      this.#ready = deferred();
    }
    this.#change(isFinal ? "closed" : wasReady ? "lost" : this.state);
    if (!isFinal) {
      this.#timer = setTimeout(() => this.#dial(), this.#pause * (0.5 + Math.random() / 2));
      this.#pause = Math.min(2 * this.#pause, LONGEST_PAUSE);
    }
    // after a sleep, try first
    if (isFinal || performance.now() - this.#lostAt >= 1000 * this.#options.reconnectTimeout) {
      this.#error = error;
      this.#ready.reject(error);
      for (const call of [...this._calls.values()]) this.#drop(call);
    }
  }
}
