/**
 * The actions and the goals of one server, as this page knows them.
 *
 * Theory of operation. All actions are watched, so the page knows the status of every goal. To have
 * its feedback and its result, a goal must be followed. That costs the server and the page work, so
 * only these are: goals that this page has sent, the one that is shown, and the newest active goals
 * of the action that is shown. Changes are collected, and listeners are told once for each frame.
 *
 * A server that is away, behind a bridge or because the connection is lost, is told by REST and by
 * the state of the connection. What is known of its active goals is from the time before. A server
 * of the page that is frozen keeps its connection for some heartbeats: it is noticed earlier, as it
 * does not answer REST either.
 */

import { ACTIVE, GoalRecord, millisecondsOf } from "./goal_record.js";
import { timeOf } from "./goal_text.js";
import { isWithin } from "./scope.js";
import { stored } from "./values.js";

const MOST_FOLLOWED = 20;
const MOST_ON_MAP = 100;
const MOST_GOALS = 2000;
const ASK_AGAIN = 2000;
const SILENCE = 5000; // after which a server does not answer, though it does at any load
const PATIENCE = 60_000; // for an answer that takes work
const ASK_PLACES = 27; // a message of the protocol that only this page sends
const MOST_PLACES = 1000;
const WATCH_STATUS = 20; // which also asks for goals of the history
const MOST_OF_A_TIME = 100; // goals that were accepted in one nanosecond
const FORGOTTEN = "the server does not know it any more";

/** Return the ID of a new goal. Pages without TLS do not have `crypto.randomUUID`. */
function newId() {
  return hexOf(crypto.getRandomValues(new Uint8Array(16)));
}

function hexOf(bytes) {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Return the earlier description of an action if it is equal: it has been read, and its page stays. */
function sameOr(before, info) {
  return before && stored(before) === stored(info) ? before : info;
}

export class Store {
  constructor(connection, history, token = "") {
    this.connection = connection;
    this.history = history;
    this.token = token;
    this.actions = new Map();
    this.isDescribed = false;
    this.goals = new Map();
    this.watches = new Map();
    this.sending = new Set();
    this.shown = { action: "", goal: "" };
    this.basis = ""; // the key of the goal that others are compared with
    this.state = "connecting";
    this.lost = undefined; // the connection, since then
    this.silent = undefined; // the server of the page, since then
    this.away = new Map(); // servers of actions behind a bridge, since then
    this.intakes = new Map(); // of actions that are paused, or whose server drains
    this.fixed = new Map(); // why actions cannot be paused
    this.schedules = new Map(); // the limits of their servers
    this.servers = []; // if the page is of several
    this.onchange = () => {};
    this.frame = 0;
  }

  /** Begin: goals of the history first, then all that the server has. */
  start() {
    for (const kept of this.history.goals()) {
      const record = GoalRecord.of(kept, undefined);
      this.goals.set(record.key, record);
    }
    this.askActions("");
    this.keepAskingAway();
  }

  /** Ask for the actions, now and ever again, and take them if they are others than before. */
  async askActions(before) {
    const infos = await this.connection.actions().catch(() => null);
    if (this.state === "closed") {
      return;
    }
    const now = infos ? stored(infos) : before;
    if (now !== before) {
      this.takeActions(infos);
    }
    setTimeout(() => this.askActions(now), ASK_AGAIN);
  }

  /** Ask now and ever again which servers are away. */
  async keepAskingAway() {
    await this.askAway();
    if (this.state !== "closed") {
      setTimeout(() => this.keepAskingAway(), ASK_AGAIN);
    }
  }

  /** Take the new state of the connection. */
  takeState(state) {
    this.state = state;
    this.lost = state === "lost" ? { since: Date.now(), reason: "the connection is lost" } : undefined;
    this.markAway();
  }

  /** Ask which servers are away, that of the page included; once for all that want to know it now. */
  askAway() {
    this.askingAway ??= this.readAway().finally(() => {
      this.askingAway = undefined;
    });
    return this.askingAway;
  }

  async readAway() {
    const answer = await this.ask("actions", AbortSignal.timeout(SILENCE)).catch(() => null);
    const infos = answer?.ok ? await answer.json().catch(() => null) : null;
    this.silent = answer ? undefined : (this.silent ?? { since: Date.now(), reason: "it does not answer" });
    if (infos) {
      const away = infos.filter((info) => info.away);
      this.away = new Map(away.map(({ name, away: { since, reason } }) => [name, { since: since * 1000, reason }]));
      this.intakes = new Map(infos.filter((info) => info.intake).map(({ name, intake }) => [name, intake]));
      this.fixed = new Map(infos.filter((info) => info.no_levers).map((info) => [info.name, info.no_levers]));
      this.schedules = new Map(infos.filter((info) => info.schedule).map(({ name, schedule }) => [name, schedule.text]));
      this.servers = (await this.fetched("servers")) ?? [];
    }
    this.markAway();
  }

  /** Return what the server has at a path; null if it cannot be read. */
  async fetched(path) {
    const answer = await this.ask(path).catch(() => null);
    return answer?.ok ? answer.json().catch(() => null) : null;
  }

  /** Send a request about a path, which reads it without `options`. */
  async ask(path, signal = AbortSignal.timeout(PATIENCE), options = {}) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
    try {
      return await fetch(path, { signal, ...options, headers: { ...headers, ...options.headers } });
    } catch (error) {
      throw error.name === "TimeoutError" ? new Error("the server does not answer; it may still do what was asked") : error;
    }
  }

  /** Return the path of a goal at the server. */
  pathOf({ action, id }) {
    return `actions/${action.split("/").map(encodeURIComponent).join("/")}/goals/${id}`;
  }

  /** Have the server run a goal again that was given up, and return the ID of the new one. */
  async rerun(record) {
    await this.checkIsThere(record.action, "nothing was sent");
    const answer = await this.ask(`${this.pathOf(record)}/rerun`, undefined, { method: "POST" });
    const told = await answer.json();
    if (!answer.ok) {
      throw new Error(told.detail ?? answer.statusText);
    }
    record.checkpoint = undefined;
    return told.goal_id;
  }

  /** Ask once whether the server of a goal has given it up, and for its checkpoint then. */
  async askCheckpoint(record) {
    if (record.isAskedAbout || this.state !== "ready" || this.awayOf(record.action)) {
      return;
    }
    record.isAskedAbout = true;
    const told = await this.fetched(this.pathOf(record));
    record.checkpoint = told?.checkpoint;
    this.change();
  }

  /** Since when the server of the page is away, and why; undefined if it is not. */
  get ownAway() {
    return this.lost ?? this.silent;
  }

  /** Return since when the server of an action is away, and why; undefined if it is not. */
  awayOf(action) {
    return this.ownAway ?? this.away.get(action);
  }

  /** Return some actions by their names, and servers in place of all actions that they have. */
  serversOf(names) {
    const known = new Set(names);
    const whole = this.servers.filter(({ name, actions }) => name && actions.length && actions.every((one) => known.has(one)));
    const serverOf = (name) => whole.find(({ actions }) => actions.includes(name))?.name ?? name;
    return [...new Set(names.map(serverOf))];
  }

  /** Note of active goals since when nothing is known of them. */
  markAway() {
    for (const record of this.goals.values()) {
      record.awayAt = record.isActive ? (this.awayOf(record.action)?.since ?? 0) : 0;
    }
    this.change();
  }

  /** Check that the server of an action is there, so that an answer need not be waited for. */
  async checkIsThere(action, what) {
    if (!this.ownAway) { // else it is asked again and again anyway
      await this.askAway();
    }
    const away = this.awayOf(action);
    if (away) {
      throw new Error(`The server of ${action} is away since ${timeOf(away.since)}: ${what}`);
    }
  }

  /** Tell the listener at the next frame. */
  change() {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.onchange();
    });
  }

  // Actions

  takeActions(infos) {
    const before = this.actions;
    this.actions = new Map(infos.map((info) => [info.name, sameOr(before.get(info.name), info)]));
    this.isDescribed = true;
    for (const [name, stop] of this.watches) {
      if (!this.actions.has(name)) {
        stop();
        this.watches.delete(name);
      }
    }
    for (const [name, info] of this.actions) {
      if (!this.watches.has(name)) {
        this.describePast(info);
        this.watch(info);
      }
    }
    this.change();
  }

  watch(info) {
    const take = (goal) => this.takeStatus(this.actions.get(info.name) ?? info, goal);
    const fail = () => setTimeout(() => this.actions.has(info.name) && this.watch(info), ASK_AGAIN);
    this.watches.set(info.name, this.connection.watch(info.name, take, fail));
  }

  /** Ask for the places of goals that wait: the changes of statuses do not tell them. */
  async refreshPlaces() {
    const waiting = [...this.goals.values()].filter((goal) => goal.status === "ACCEPTED");
    for (const name of new Set(waiting.map((goal) => goal.action))) {
      if (this.state === "ready" && !this.awayOf(name)) {
        const answer = this.connection.request(ASK_PLACES, name, MOST_PLACES);
        this.takePlaces(name, await answer.catch(() => [[]]));
      }
    }
  }

  takePlaces(name, [goals]) {
    for (const [id, place, queueLength] of goals) {
      const record = this.goals.get(`${name}/${hexOf(id)}`);
      if (record?.status === "ACCEPTED") {
        Object.assign(record, { place: Number(place), queueLength: Number(queueLength) });
      }
    }
    this.change();
  }

  /** Give goals of the history the schema, with which their charts are drawn. */
  describePast(info) {
    for (const record of this.goals.values()) {
      if (record.action === info.name && !record.info) {
        this.goals.set(record.key, GoalRecord.of(record.kept(), info));
      }
    }
  }

  // Goals

  /** Return the goals of an action, of a namespace, or of all, the newest first. */
  goalsOf(scope) {
    const goals = [...this.goals.values()].filter((goal) => isWithin(goal.action, scope));
    return goals.sort((one, other) => other.sentAt - one.sentAt);
  }

  /** Return the goal of that ID, of any action; undefined if it is not known here. */
  goalOf(id) {
    return [...this.goals.values()].find((goal) => goal.id === id);
  }

  takeStatus(info, told) {
    if (told.status === "UNKNOWN") {
      this.takeForgotten(`${info.name}/${told.id}`);
      return;
    }
    const record = this.recordOf(info, told.id);
    const wasKnown = record.sentAt > 0;
    record.isPast = false;
    record.setFacts(told);
    if (!record.handle) {
      record.feedbackCount = Math.max(record.feedbackCount, Number(told.feedbackCount));
      record.setStatus(told.status, wasKnown ? Date.now() : 0);
    }
    record.setTimes(told);
    record.reason = told.reason || (record.isActive ? "" : record.reason);
    this.follow(record);
    this.change();
  }

  /** Take a goal that the history of the server has; of one that is known, more may be told. */
  takePast(info, told) {
    const isKnown = this.goals.has(`${info.name}/${told.id}`);
    const record = this.recordOf(info, told.id);
    if (isKnown) {
      record.setFacts(told);
      record.setTimes(told);
    } else {
      record.takeListed(told);
    }
    this.change();
  }

  /** Look up a goal that a link names by its whole ID: the history of the server may have it. */
  async lookUp(action, id) {
    const info = this.actions.get(action);
    const key = `${action}/${id}`;
    if (!info || id.length < 32 || this.lookedUp === key || this.state !== "ready") {
      return;
    }
    this.lookedUp = key;
    try {
      const handle = await this.connection.attach(action, id, { observe: true, feedback: false });
      handle.leave();
      const page = [[], "", handle.stamp, handle.stamp, MOST_OF_A_TIME, null, true];
      const goals = await this.connection.request(WATCH_STATUS, action, MOST_OF_A_TIME, page, []);
      goals.filter((told) => told.id === id).forEach((told) => this.takePast(info, told));
    } catch {
      // The server does not know it either.
    }
  }

  /** Take that a server does not know a goal any more. If it was active, it is lost. */
  takeForgotten(key) {
    const record = this.goals.get(key);
    if (record?.isActive && !record.handle) {
      record.setStatus("UNKNOWN");
      record.reason = FORGOTTEN;
      this.keep(record);
    }
    this.change();
  }

  recordOf(info, id) {
    const key = `${info.name}/${id}`;
    let record = this.goals.get(key);
    if (!record) {
      record = new GoalRecord(info.name, id, info);
      this.goals.set(key, record);
      if (this.goals.size > MOST_GOALS) {
        this.forgetOldest();
      }
    }
    return record;
  }

  forgetOldest() {
    for (const [key, record] of this.goals) {
      if (!record.isActive && key !== this.shown.goal) {
        this.goals.delete(key);
        return;
      }
    }
  }

  // To follow goals

  /** Show an action, and perhaps one of its goals: they are followed from now on. */
  show(action, goal = "") {
    this.shown = { action, goal: goal && `${action}/${goal}` };
    for (const record of this.goals.values()) {
      if (record.handle && !this.isWanted(record)) {
        record.handle.leave();
        record.handle = null;
      }
      if (record.key !== this.shown.goal) {
        record.thin();
      }
    }
    for (const record of this.goalsOf(action)) {
      this.follow(record);
    }
    this.change();
  }

  isWanted(record) {
    return record.isMine || record.key === this.shown.goal || this.isInReach(record);
  }

  isInReach(record) {
    if (!isWithin(record.action, this.shown.action) || !record.isActive) {
      return false;
    }
    const followed = [...this.goals.values()].filter((one) => one.handle && one.isActive);
    return Boolean(record.handle) || followed.length < (this.view === "#map" ? MOST_ON_MAP : MOST_FOLLOWED);
  }

  /** Follow a goal, if it is wanted and not followed yet. */
  async follow(record) {
    const needsEnd = !record.isActive && record.result === undefined && !record.isPast;
    const isBusy = record.handle || record.isAsking || this.sending.has(record.key);
    if (isBusy || !(needsEnd || this.isWanted(record))) {
      return;
    }
    const isWhole = record.hasEnd || (record.isPast && !record.isListed);
    if (!record.isActive && isWhole) {
      return;
    }
    record.isAsking = true;
    try {
      const { number, attempt } = record;
      const handle = await this.connection.attach(record.action, record.id, { after: number, attempt, observe: true });
      await this.read(record, handle);
    } catch (error) {
      record.isPast = !record.isActive;
      this.change();
    } finally {
      record.isAsking = false;
    }
  }

  /** Read the feedback and the end of a goal. */
  async read(record, handle) {
    record.handle = handle;
    record.goal = handle.goal ?? record.goal;
    handle.onstatus = (status) => {
      record.setStatus(status);
      this.change();
    };
    record.setStatus(handle.status);
    this.change();
    const reading = this.readFeedback(record, handle);
    try {
      const outcome = await handle.outcome;
      await reading;
      if (record.handle === handle) {
        this.end(record, outcome);
      }
    } catch (error) {
      if (record.handle !== handle || ["ConnectionLost", "ServerNotFound"].includes(error.name)) {
        // It was left here, or its server is away: it is followed again later.
      } else if (record.isActive) {
        record.reason = error.message;
      } else if (error.name === "ProtocolError") { // its server may be of another version by now
        record.reason = `its result cannot be read: ${error.message}`;
        record.hasEnd = true;
        this.keep(record);
      }
    }
    if (record.handle === handle) {
      record.handle = null;
    }
    this.change();
  }

  async readFeedback(record, handle) {
    try {
      for await (const feedback of handle.feedback) {
        record.addFeedback(feedback, handle.number, handle.attempt, millisecondsOf(handle.at));
        this.change();
      }
    } catch {
      // `outcome` raises the same error.
    }
  }

  end(record, outcome) {
    record.reason = record.isActive ? "" : record.reason;
    record.setStatus(outcome.status);
    record.result = outcome.result ?? undefined;
    record.reason = outcome.reason || record.reason;
    record.feedbackDropped = record.isListed ? 0 : Number(outcome.feedbackDropped ?? 0);
    record.hasEnd = true;
    if (outcome.status === "UNKNOWN") {
      record.reason = FORGOTTEN;
    }
    if (record.key !== this.shown.goal) {
      record.thin();
    }
    if (!record.isListed) {
      this.keep(record);
    }
  }

  keep(record) {
    if (!record.isActive) {
      this.history.add(record);
    }
  }

  // What a person does

  /** Send a goal, and return its record; a rejection is an error with its reason. */
  async send(info, goal, labels = null) {
    await this.checkIsThere(info.name, "nothing was sent");
    const id = newId();
    const key = `${info.name}/${id}`;
    this.sending.add(key); // its status may come before the answer
    try {
      const handle = await this.connection.sendGoal(info.name, goal, { id, meta: labels });
      const record = this.recordOf(info, id);
      record.isMine = true;
      record.goal = goal;
      record.sentAt ||= Date.now();
      this.read(record, handle);
      return record;
    } finally {
      this.sending.delete(key);
    }
  }

  /** Ask for the cancel of a goal. */
  async cancel(record) {
    await this.checkIsThere(record.action, "the goal may continue");
    await this.connection.cancel(record.action, { id: record.id });
  }

  /** Ask for the cancel of all active goals, and return the errors of actions that reject it. */
  async cancelAll(action) {
    const active = this.goalsOf(action).filter((goal) => goal.isActive);
    const names = [...new Set(active.map((goal) => goal.action))];
    const answers = await Promise.allSettled(names.map(async (name) => {
      await this.checkIsThere(name, "its goals may continue");
      await this.connection.cancel(name);
    }));
    return answers.filter(({ status }) => status === "rejected").map(({ reason }) => reason.message);
  }

  /** Forget the goals that have ended. */
  forgetEnded() {
    for (const [key, record] of this.goals) {
      if (!ACTIVE.includes(record.status)) {
        this.goals.delete(key);
      }
    }
    this.history.clear();
    this.change();
  }
}
