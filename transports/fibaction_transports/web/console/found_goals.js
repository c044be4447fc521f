/**
 * The goals that a server finds, those of its history included: one page, and the number of all.
 *
 * Theory of operation. The page of the server is asked for when the choice changes, and again after
 * goals have come or ended, more rarely the longer the answer takes. Goals that this page knows by
 * itself, which are newer than the answer or of another life of the server, are put between those of
 * the first page. A server without a search, and a recording, have only these.
 */

import { comparing } from "./goal_columns.js";
import { ENDED, GoalRecord } from "./goal_record.js";
import { listed } from "./goal_text.js";

const TYPING = 200; // milliseconds in which a person types on
const LEAST_PAUSE = 2000;
const SHARE = 10; // of the time, the search takes one part in so many
const PATIENCE = 60_000; // milliseconds for an answer
const MOST_AT_ONCE = 1000;
const MOST_FOUND = 10_000;
const REQUESTS_AT_ONCE = 4;

export class FoundGoals {
  constructor(store) {
    this.store = store;
    this.query = null;
    this.changes = "";
    this.answer = null; // the keys of the page in their order, their number, and its first place
    this.text = "";
    this.nextAt = 0;
    this.timer = 0;
    this.asking = new Set(); // goals whose requests are being read
  }

  /** Ask for a page if it is another one than before, or if it may have changed. */
  want(query, changes) {
    this.wanted = query;
    if (this.store.isRecording || !this.isReachable) {
      return;
    }
    const isOther = query !== this.query;
    const isOld = changes !== this.changes && Date.now() >= this.nextAt;
    if (isOther || (isOld && !this.timer)) {
      clearTimeout(this.timer);
      const pause = isOther && this.query !== null ? TYPING : 0;
      Object.assign(this, { query, changes, timer: setTimeout(() => this.ask(query), pause) });
    }
  }

  get isReachable() {
    return this.store.state === "ready" && !this.store.ownAway;
  }

  /** Return whether another choice of goals is being searched than the one that is shown. */
  get isSearching() {
    return this.timer !== 0 && this.answer?.query !== this.query;
  }

  async ask(query) {
    const began = Date.now();
    try {
      const { total, goals, away } = await this.fetched(query);
      if (query === this.query) {
        this.answer = { query, total, keys: goals.map((told) => this.take(told)) };
        this.text = away.length ? `Not asked, since it is away: ${listed(this.store.serversOf(away))}.` : "";
      }
    } catch (error) {
      if (query === this.query) {
        this.answer = null;
        this.text = `The history cannot be searched: ${error.message}`;
      }
    }
    if (query === this.query) {
      this.timer = 0;
      this.nextAt = Date.now() + Math.max(LEAST_PAUSE, SHARE * (Date.now() - began));
      this.store.change();
    }
  }

  async fetched(query) {
    const { token } = this.store;
    const headers = token ? { Authorization: `Bearer ${token}` } : {};
    const answer = await fetch(`goals?${query}`, { headers, signal: AbortSignal.timeout(PATIENCE) });
    const told = await answer.json();
    if (!answer.ok) {
      throw new Error(told.detail ?? `the server answers with the status ${answer.status}`);
    }
    return told;
  }

  /** Take a goal of an answer, and return its key. */
  take(told) {
    const key = `${told.action}/${told.goal_id}`;
    const info = this.store.actions.get(told.action);
    const isEnded = ENDED.includes(told.status);
    if (info && (isEnded || this.store.goals.has(key))) { // what is active is told by the server itself
      this.store.takePast(info, asOfProtocol(told));
    }
    return key;
  }

  /** Let the page know the goals that a search finds, and return their keys. */
  async bring(parameters) {
    const { goals } = await this.fetched(new URLSearchParams(parameters).toString());
    this.store.change();
    return goals.map((told) => this.take(told));
  }

  /** Return the record of a goal of an answer, a new one if it is not known. */
  recordOf(told) {
    const { goals, actions } = this.store;
    const known = goals.get(`${told.action}/${told.goal_id}`);
    return known ?? GoalRecord.listed(told.action, asOfProtocol(told), actions.get(told.action));
  }

  /** Return the goals of a page in their order, and the number of all; `known` are those of this page. */
  page(known, { sort, from, rows }, fits) {
    const compare = comparing(sort);
    const { answer, store } = this;
    if (!answer || (answer.query !== this.wanted && !this.isReachable)) {
      const goals = known.filter(fits).sort(compare);
      return { goals: goals.slice(from, from + rows), total: goals.length };
    }
    const told = answer.keys.map((key) => store.goals.get(key)).filter((goal) => goal && fits(goal));
    if (from) {
      return { goals: told, total: answer.total };
    }
    const keys = new Set(answer.keys);
    const last = answer.keys.length < answer.total ? told[told.length - 1] : null;
    const own = known.filter((goal) => !goal.isListed && !keys.has(goal.key) && fits(goal) && !(last && compare(goal, last) > 0));
    const places = new Map(answer.keys.map((key, place) => [key, place]));
    const inOrder = (one, other) => compare(one, other) || (places.get(one.key) ?? -1) - (places.get(other.key) ?? -1);
    return { goals: own.length ? [...told, ...own].sort(inOrder).slice(0, rows) : told, total: answer.total + own.length };
  }

  /** Read what was sent of some goals, a few at a time; a list of the history does not tell it. */
  readRequests(goals) {
    for (const goal of goals) {
      if (this.asking.size >= REQUESTS_AT_ONCE || this.store.isRecording || !this.isReachable) {
        return;
      }
      if (goal.goal === undefined && !goal.handle && !goal.isAsking && goal.info && !goal.wasAsked && !this.asking.has(goal.key)) {
        this.asking.add(goal.key);
        this.readGoal(goal).finally(() => {
          goal.wasAsked = true;
          this.asking.delete(goal.key);
          this.store.change();
        });
      }
    }
  }

  /** Read what was sent of one goal, and its result if it has ended. */
  async readGoal(record) {
    const handle = await this.store.connection.attach(record.action, record.id, { observe: true, after: 0 }).catch(() => null);
    if (handle) {
      record.goal = handle.goal ?? record.goal;
      if (!record.isActive) {
        const outcome = await handle.outcome.catch(() => null);
        record.result = outcome?.result ?? record.result;
      }
      handle.leave();
    }
    return record.goal;
  }

  /** Return all goals that are found, as far as a page can hold them. */
  async all() {
    const found = [];
    const parameters = new URLSearchParams(this.query);
    parameters.set("limit", MOST_AT_ONCE);
    for (let total = 1; found.length < Math.min(total, MOST_FOUND); ) {
      parameters.set("offset", found.length);
      const told = await this.fetched(parameters.toString());
      if (!told.goals.length) {
        break;
      }
      total = told.total;
      found.push(...told.goals.map((one) => this.recordOf(one)));
    }
    return found;
  }
}

/** Return a goal of an answer of REST as a message of the protocol tells it. */
function asOfProtocol({ goal_id: id, stamp, parent, reason, began_at: began, ended_at: ended, ...told }) {
  return {
    ...told, id, stamp: BigInt(stamp), queueLength: told.queue_length, feedbackCount: told.feedback_count,
    parent: parent && { id: parent.goal_id, step: parent.step }, reason: reason ?? "",
    beganAt: began && BigInt(began), endedAt: ended && BigInt(ended),
  };
}
