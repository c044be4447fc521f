/** The choice of goals in a list: words, a state, a client, a label, and a span of time. */

import { button, h } from "./dom.js";
import { stateOf } from "./goal_text.js";
import { pickedOf } from "./time_field.js";
import { summaryOf } from "./values.js";

const STATES = {
  all: { fits: () => true, asked: [] },
  active: { fits: (goal) => goal.isActive, asked: ["active"] },
  waiting: { fits: (goal) => goal.status === "ACCEPTED", asked: ["ACCEPTED"] },
  ended: { fits: (goal) => !goal.isActive, asked: ["ended"] },
  failed: { fits: (goal) => goal.status === "ABORTED", asked: ["ABORTED"] },
  "not succeeded": { fits: (goal) => !goal.isActive && goal.status !== "SUCCEEDED", asked: ["CANCELED", "ABORTED"] },
};

export class GoalFilter {
  /** Make the fields; `onchange` is called with each change of a person, and begins at the first page. */
  constructor(layout, onchange) {
    this.layout = layout;
    this.onchange = () => {
      layout.from = 0;
      onchange();
    };
    const field = (type, more) => h("input", { type, autocomplete: "off", oninput: this.onchange, ...more });
    this.search = field("search", { placeholder: "Search goals", "aria-label": "Search goals" });
    this.state = h("select", { "aria-label": "Filter goals", oninput: this.onchange }, ...Object.keys(STATES).map((name) => h("option", {}, name)));
    this.client = field("search");
    this.label = field("search", { placeholder: "key=value" });
    this.since = field("datetime-local");
    this.until = field("datetime-local");
    const named = { Client: this.client, Label: this.label, Since: this.since, Until: this.until };
    const fields = Object.entries(named).map(([name, input]) => h("label", {}, name, input));
    const quick = (text, since) => button(text, () => this.chooseFailed(since()), { class: "quiet" });
    this.quick = h("div", { class: "quick" }, quick("Failed today", () => lastAt(0)), quick("Failed since noon", () => lastAt(12)));
    this.more = h("details", { class: "more" }, h("summary", {}, "Client, label and time"), h("div", { class: "tools" }, ...fields));
  }

  /** Choose the goals of a label, or of a client. */
  choose(name, value) {
    this[name].value = value;
    this.more.open = true;
    this.onchange();
  }

  /** Choose the goals that have failed since a time, and none of another choice. */
  chooseFailed(since) {
    this.query = `?${new URLSearchParams({ state: "failed", since: since.toISOString(), ...this.layout.parts })}`;
    this.onchange();
  }

  /** Whether only goals that have ended are wanted. */
  get isOfEnded() {
    return ["ended", "failed", "not succeeded"].includes(this.state.value);
  }

  /** Whether not all goals are wanted. */
  get isChoice() {
    const { search, state, client, label, since, until } = this;
    return state.selectedIndex > 0 || [search, client, label, since, until].some(({ value }) => value);
  }

  /** The choice as the end of an address; empty if all goals are wanted. */
  get query() {
    const { search, client, label, since, until } = this;
    const state = this.state.selectedIndex ? this.state.value : "";
    const times = [since, until].map((input) => (Number.isNaN(timeIn(input)) ? "" : new Date(input.value).toISOString()));
    const parts = { search: search.value, state, client: client.value, label: label.value, since: times[0], until: times[1], ...this.layout.parts };
    const text = new URLSearchParams(Object.entries(parts).filter(([, value]) => value)).toString();
    return text && `?${text}`;
  }

  set query(text) {
    const parts = new URLSearchParams(text);
    for (const name of ["search", "client", "label"]) {
      this[name].value = parts.get(name) ?? "";
    }
    for (const name of ["since", "until"]) {
      this[name].value = pickedOf(parts.get(name) ?? "", "date-time").slice(0, 16);
    }
    this.layout.parts = parts;
    this.state.value = parts.get("state") ?? "all";
    this.state.selectedIndex = Math.max(this.state.selectedIndex, 0);
    this.more.open ||= [this.client, this.label, this.since, this.until].some(({ value }) => value);
  }

  /** Return a function that tells whether a goal is wanted. */
  reader() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const { fits } = STATES[this.state.value];
    const [client, [key, value], since, until] = [this.client.value, this.labelParts, timeIn(this.since), timeIn(this.until)];
    return (goal) =>
      fits(goal) && goal.client.includes(client) &&
      (!key || (value === undefined ? key in goal.labels : goal.labels[key] === value)) &&
      !(goal.sentAt < since) && !(goal.sentAt > until) && matches(goal, words);
  }

  /** The key and the value of the label; the value is undefined if any will do. */
  get labelParts() {
    const [key, ...rest] = this.label.value.trim().split("=");
    return [key, rest.length ? rest.join("=") : undefined];
  }

  /** Return what a server is asked for: a page of the goals of these actions that are wanted. */
  asked(actions) {
    const { search, client, state, layout } = this;
    const [key, value] = this.labelParts;
    const words = [search.value, key && value === undefined ? `${key}=` : ""].filter(Boolean).join(" ");
    const [since, until] = [this.since, this.until].map((input) => (Number.isNaN(timeIn(input)) ? "" : new Date(input.value).toISOString()));
    const one = { search: words, client: client.value, label: key && value !== undefined ? this.label.value.trim() : "", since, until };
    const parts = [...Object.entries(one), ["sort", layout.sort], ["offset", layout.from || ""], ["limit", layout.rows]];
    const many = [...actions.map((name) => ["action", name]), ...STATES[state.value].asked.map((status) => ["status", status])];
    return new URLSearchParams([...parts.filter(([, text]) => text), ...many]).toString();
  }
}

/** Return the last time at which it was so many hours after midnight here. */
function lastAt(hours) {
  const time = new Date();
  time.setHours(hours, 0, 0, 0);
  if (time > new Date()) {
    time.setDate(time.getDate() - 1);
  }
  return time;
}

/** Return the time in a field in milliseconds; NaN if it is empty. */
function timeIn({ value }) {
  return new Date(value).getTime();
}

function matches(goal, words) {
  if (!words.length) {
    return true;
  }
  const { id, action, status, client, reason, parent, worker } = goal;
  const labels = labelsOf(goal).join(" ");
  const text = [id, action, status, stateOf(goal), client, worker, reason, labels, summaryOf(goal.goal, 500), parent?.step, parent?.id]
    .join(" ")
    .toLowerCase();
  return words.every((word) => text.includes(word));
}

/** Return the labels of a goal as texts such as `order=17`. */
export function labelsOf({ labels }) {
  return Object.entries(labels).map(([key, value]) => `${key}=${value}`);
}
