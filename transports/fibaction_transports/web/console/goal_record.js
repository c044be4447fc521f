/** One goal as the console knows it: from its server, from this page, or from the history. */

import { shapeOf } from "./action_shape.js";
import { TextFeed } from "./feedback_parts.js";
import { Trail } from "./places.js";
import { progressReader } from "./schema.js";
import { Series } from "./series.js";

const MOST_KEPT_POINTS = 100;
const MOST_FEEDBACK_LINES = 200;
const MOST_LINES_WITH_BYTES = 10; // which may be images
const MOST_KEPT_LINES = 20;

/** The statuses of goals that have not ended. */
export const ACTIVE = ["SENDING", "ACCEPTED", "EXECUTING", "CANCELING"];

/** The statuses of goals that have ended. */
export const ENDED = ["SUCCEEDED", "CANCELED", "ABORTED"];

/** The statuses of goals that have not begun. */
export const WAITING = ["SENDING", "ACCEPTED"];

/** Return a time of the protocol as one of JavaScript. */
export function millisecondsOf(stamp) {
  return Number(stamp / 1_000_000n);
}

export class GoalRecord {
  constructor(action, id, info) {
    this.action = action;
    this.id = id;
    this.key = `${action}/${id}`;
    this.info = info;
    this.status = "ACCEPTED";
    this.sentAt = 0;
    this.startedAt = 0;
    this.endedAt = 0;
    this.client = "";
    this.isMine = false;
    this.place = 0;
    this.queueLength = 0;
    this.parent = null;
    this.labels = {};
    this.worker = "";
    this.goal = undefined;
    this.result = undefined;
    this.checkpoint = undefined; // of a goal that was given up; null if it has none
    this.isAskedAbout = false;
    this.reason = "";
    this.feedback = undefined;
    this.feedbackCount = 0;
    this.feedbackDropped = 0;
    this.number = 0; // of the newest feedback that was read, in this attempt
    this.attempt = 1;
    this.awayAt = 0; // the time since which its server is away
    this.progress = null;
    this.recent = [];
    this.handle = null;
    this.isPast = false;
    this.isListed = false; // by a history, which has told neither what was sent nor the result
    this.isThin = false;
    this.undescribed = null;
    const { text, charts, progress, images, places } = shapeOf(info);
    this.text = new TextFeed(text);
    this.mostLines = images.feedback.length ? MOST_LINES_WITH_BYTES : MOST_FEEDBACK_LINES;
    this.series = new Series(charts);
    this.trails = places.feedback.filter((place) => !place.isPath).map((place) => new Trail(place));
    this.readProgress = progressReader(progress);
  }

  get isActive() {
    return ACTIVE.includes(this.status);
  }

  /** Return the seconds that it has taken, so far or in all; null if its end is not known. */
  seconds(now = Date.now()) {
    const end = this.isActive ? this.awayAt || now : this.endedAt;
    return end ? Math.max(0, (end - this.sentAt) / 1000) : null;
  }

  /** Change the status, and note the time, 0 if it is not known; what has ended stays so. */
  setStatus(status, now = Date.now()) {
    if (status === this.status || (!this.isActive && status !== "UNKNOWN")) {
      return;
    }
    if (WAITING.includes(this.status) && !WAITING.includes(status)) {
      this.startedAt ||= now;
    }
    this.status = status;
    if (!this.isActive && !this.endedAt) {
      this.endedAt = now;
      this.place = 0;
    }
  }

  /** Take what a list of the server tells of the goal, but for its status. */
  setFacts({ stamp, client, place, queueLength, parent, labels, worker }) {
    this.sentAt = millisecondsOf(stamp);
    this.parent = parent ?? this.parent;
    Object.assign(this, { client, place, queueLength, labels: labels ?? {}, worker: worker ?? "" });
  }

  /** Take the times that the server tells; one of an earlier version tells none. */
  setTimes({ beganAt, endedAt }) {
    this.startedAt = beganAt ? millisecondsOf(beganAt) : this.startedAt;
    this.endedAt = endedAt ? millisecondsOf(endedAt) : this.endedAt;
  }

  /** Take one feedback message, whose number counts in an attempt, and that was reported at a time. */
  addFeedback(feedback, number, attempt, at = Date.now()) {
    this.isThin = false;
    this.feedback = feedback;
    this.feedbackCount = number;
    Object.assign(this, { number, attempt: attempt ?? 1 });
    this.progress = this.readProgress(feedback) ?? this.progress;
    this.recent.push([at, feedback]);
    if (this.recent.length > 2 * this.mostLines) {
      this.recent.splice(0, this.mostLines);
    }
    this.text.add(feedback, number, attempt);
    this.series.add(feedback, (at - this.sentAt) / 1000);
    this.trails.forEach((trail) => trail.add(feedback));
  }

  /** Keep less of a goal that has ended, and that is not shown. */
  thin() {
    if (!this.isActive && !this.isThin) {
      this.isThin = true;
      this.recent = this.recent.slice(-MOST_KEPT_LINES);
      this.text.restore(this.text.kept());
      this.series.restore(this.series.kept(MOST_KEPT_POINTS));
      this.trails.forEach((trail) => trail.restore(trail.kept(MOST_KEPT_POINTS)));
    }
  }

  /** Return the last feedback messages, with their times. */
  get lines() {
    return this.recent.slice(-this.mostLines);
  }

  /** Return what the history keeps. */
  kept() {
    const { action, id, status, sentAt, startedAt, endedAt, client, isMine, goal, result, reason } =
      this;
    const { parent, labels, worker, feedback, feedbackCount, feedbackDropped } = this;
    const drawn = this.undescribed ?? {
      points: this.series.kept(MOST_KEPT_POINTS),
      trails: this.trails.map((trail) => trail.kept(MOST_KEPT_POINTS)),
    };
    return { action, id, status, sentAt, startedAt, endedAt, client, isMine, goal, result, reason,
      parent, labels, worker, feedback, feedbackCount, feedbackDropped, ...drawn, text: this.text.kept() };
  }

  /** Return the record of a goal that only a list tells of. */
  static listed(action, told, info) {
    const record = new GoalRecord(action, told.id, info);
    record.takeListed(told);
    return record;
  }

  /** Take what a list tells of a goal that was not known. */
  takeListed(told) {
    this.setFacts(told);
    this.feedbackCount = Number(told.feedbackCount);
    this.setStatus(told.status, 0);
    this.isPast = this.isListed = !this.isActive;
    this.reason = told.reason;
    this.setTimes(told);
  }

  /** Return the record of a goal in the history of this browser. */
  static of({ points, trails, text, ...kept }, info) {
    const record = new GoalRecord(kept.action, kept.id, info);
    Object.assign(record, kept, { isPast: true });
    record.undescribed = info ? null : { points, trails }; // for the time when there is a schema
    record.series.restore(points ?? []);
    record.trails.forEach((trail, index) => trail.restore(trails?.[index] ?? []));
    record.text.restore(text);
    return record;
  }
}
