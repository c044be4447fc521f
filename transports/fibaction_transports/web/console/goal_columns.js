/** The columns of a list of goals: those that a person can choose, and how a list is sorted. */

import { button, h, setProgress, setText, show } from "./dom.js";
import { labelsOf } from "./goal_filter.js";
import { breakable, durationOf, linkTo, shortId, showBadge, timeOf } from "./goal_text.js";
import { resolverOf } from "./schema.js";
import { summaryOf } from "./values.js";

const FIELD = "request.";
const STATUSES = ["SENDING", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED", "ABORTED"];

/** The columns, each with the name of the order by it, if there is one, and its share of the width. */
const COLUMNS = {
  action: { name: "Action", sort: "", width: 130 },
  state: { name: "State", sort: "status", width: 180 },
  request: { name: "Request", sort: "", width: 190 },
  labels: { name: "Labels", sort: "", width: 140 },
  reason: { name: "Reason", sort: "", width: 170 },
  client: { name: "Client", sort: "client", width: 125 },
  worker: { name: "Worker", sort: "worker", width: 115 },
  time: { name: "Time", sort: "accepted", width: 185 },
  waited: { name: "Waited", sort: "waited", width: 80 },
  ran: { name: "Ran", sort: "ran", width: 80 },
};
const WIDTH_OF_FIELD = 110;
const CLASSES = { request: "value request", labels: "other", reason: "other" };
const DEFAULTS = ["action", "state", "request", "client", "time"];

/** The orders of a list as a person reads them; a dash in front means the last first. */
export const SORTS = {
  "-accepted": "newest first",
  accepted: "oldest first",
  "-ran": "ran longest first",
  ran: "ran shortest first",
  "-waited": "waited longest first",
  waited: "waited shortest first",
  status: "by state",
  "-status": "by state, failed first",
  client: "by client",
  "-client": "by client, Z to A",
  worker: "by worker",
  "-worker": "by worker, Z to A",
};

/** Return the value by which goals are sorted; null if it is not known. */
function keyOf(sort, goal) {
  const { sentAt, startedAt, endedAt } = goal;
  switch (sort) {
    case "accepted": return sentAt;
    case "status": return STATUSES.indexOf(goal.status);
    case "waited": return startedAt ? Math.max(startedAt - sentAt, 0) : null;
    case "ran": return startedAt && endedAt ? Math.max(endedAt - startedAt, 0) : null;
    default: return goal[sort];
  }
}

/** Return a function that compares two goals, as a server does. */
export function comparing(order) {
  const sort = order.replace("-", "");
  const sign = order.startsWith("-") ? -1 : 1;
  const compared = (one, other) => (one === other ? 0 : one === null || (other !== null && one < other) ? -1 : 1);
  return (one, other) => sign * (compared(keyOf(sort, one), keyOf(sort, other)) || one.sentAt - other.sentAt);
}

/** Return the names of the columns that a list can have; those of the fields need an action. */
export function columnsOf(info, withAction) {
  const fields = info ? Object.keys(resolverOf(info.goal)(info.goal).properties ?? {}) : [];
  return [...Object.keys(COLUMNS).filter((name) => withAction || name !== "action"), ...fields.map((name) => FIELD + name)];
}

/** Return the columns that a list has if nobody has chosen others. */
export function defaultsOf(withAction) {
  return DEFAULTS.filter((name) => withAction || name !== "action");
}

/** Return what stands above a column. */
export function headOf(column) {
  return COLUMNS[column]?.name ?? column.slice(FIELD.length);
}

/** Return the name of the order by a column; empty if there is none. */
export function sortOf(column) {
  return COLUMNS[column]?.sort ?? "";
}

/** Return the share of the width that a column has: its pixels where there is room for all. */
export function widthOf(column) {
  return COLUMNS[column]?.width ?? WIDTH_OF_FIELD;
}

/** Return whether a column shows what was sent. */
export function showsRequest(column) {
  return column === "request" || column.startsWith(FIELD);
}

/** Return seconds as text, as whole ones while they run: a table is laid out anew for each change. */
function lasting(record, seconds) {
  const whole = Math.floor(seconds ?? 0);
  return record.isActive ? (whole < 10 ? `${whole} s` : durationOf(whole)) : durationOf(seconds);
}

/** One cell, which shows the goal of its row. */
export class Cell {
  constructor(column, record, onclient) {
    this.column = column;
    const client = () => button("", () => onclient(record.client), { class: "quiet name", hidden: true });
    this.text = column === "client" ? client() : h("span");
    this.labels = column === "request" ? h("small", { class: "labels" }) : null;
    const inner = { action: () => this.action(record), state: () => this.state(record) }[column]?.() ?? [this.text, this.labels];
    const kind = COLUMNS[column] ? column : "other";
    this.element = h("td", { class: CLASSES[kind] ?? kind, "data-name": headOf(column) }, ...inner);
  }

  action({ action }) {
    return [h("a", { href: linkTo(action) }, breakable(action))];
  }

  state({ id }) {
    this.badge = h("span", { class: "badge" });
    this.bar = h("progress", { max: 1, "aria-label": `Progress of ${shortId(id)}` });
    return [this.badge, this.bar];
  }

  /** Show the goal as it is now; the reason goes into another column if there is one. */
  update(record, hasReason, now) {
    if (this.badge) {
      showBadge(this.badge, record);
      show(this.bar, record.isActive && record.progress !== null);
      setProgress(this.bar, record.progress ?? 0);
    } else if (this.labels) {
      this.showRequest(record, hasReason);
    } else if (this.column !== "action") {
      this.write(this.textOf(record, now));
    }
  }

  showRequest(record, hasReason) {
    // A value is written once and not for each frame: a list has many rows.
    if (this.goal !== record.goal || this.reason !== record.reason || this.told !== record.labels) {
      Object.assign(this, { goal: record.goal, reason: record.reason, told: record.labels });
      const reason = record.reason && !hasReason ? ` – ${record.reason}` : "";
      this.write(`${summaryOf(record.goal)}${reason}`);
      const labels = labelsOf(record);
      show(this.labels, labels.length > 0);
      setText(this.labels, labels.join(" "));
    }
  }

  /** Show a text, which may be cut, and the whole of it to a pointer. */
  write(text) {
    if (this.text.textContent !== text) {
      this.text.textContent = this.element.title = text;
      show(this.text, text !== "");
    }
  }

  textOf(record, now) {
    const { sentAt, startedAt, endedAt } = record;
    switch (this.column) {
      case "labels": return labelsOf(record).join(" ");
      case "reason": return record.reason;
      case "client": return record.isMine ? "this page" : record.client;
      case "worker": return record.worker;
      case "time": return [this.clockOf(sentAt), lasting(record, record.seconds(now))].filter(Boolean).join(", ");
      case "waited": return startedAt ? durationOf(Math.max(startedAt - sentAt, 0) / 1000) : "";
      case "ran": return startedAt ? lasting(record, Math.max((endedAt || now) - startedAt, 0) / 1000) : "";
      default: return this.fieldOf(record.goal);
    }
  }

  clockOf(sentAt) {
    if (this.sentAt !== sentAt) {
      this.sentAt = sentAt;
      this.clock = timeOf(sentAt);
    }
    return this.clock;
  }

  fieldOf(goal) {
    if (this.goal !== goal) {
      this.goal = goal;
      this.shown = summaryOf(goal?.[this.column.slice(FIELD.length)]);
    }
    return this.shown ?? "";
  }
}
