/** The newest goals as bars over time: the wait, the run, and the end. */

import { h, svg } from "./dom.js";
import { WAITING } from "./goal_record.js";
import { counted, durationOf, shortId, stateOf, wordOf } from "./goal_text.js";

const MOST_GOALS = 12;
const ROW = 18;
const LETTER = 7.4;
const LEAST_SECONDS = 5;
const REDRAW = 250; // milliseconds between two moves of the bars of active goals

export class Timeline {
  constructor({ withAction }) {
    this.withAction = withAction;
    this.svg = svg("svg", { role: "img", "aria-label": "Timeline of goals" });
    this.width = 0; // observed, since to ask for it makes the browser lay out the list for each frame
    new ResizeObserver(([entry]) => {
      this.width = entry.contentRect.width;
      this.update(...this.latest);
    }).observe(this.svg);
    this.latest = [[], ""];
    this.element = h("section", { class: "card timeline", "aria-label": "Timeline" }, h("h2", {}, "Timeline"), this.svg);
  }

  /** Draw the newest of these goals. */
  update(goals, shown) {
    this.latest = [goals, shown];
    const newest = goals.filter((goal) => goal.sentAt).slice(0, MOST_GOALS);
    this.element.hidden = newest.length === 0;
    const { width } = this;
    if (!width || !newest.length) {
      return;
    }
    const now = Math.floor(Date.now() / REDRAW) * REDRAW;
    const drawn = [width, shown, newest.some((goal) => goal.isActive) && now, ...newest.map(({ key, status, place, awayAt, startedAt, endedAt }) => [key, status, place, awayAt, startedAt, endedAt])].join();
    if (drawn === this.drawn) {
      return;
    }
    this.drawn = drawn;
    const start = Math.min(...newest.map((goal) => goal.sentAt));
    const end = Math.max(start + LEAST_SECONDS * 1000, ...newest.map((goal) => endOf(goal, now)));
    const names = newest.map((goal) => (this.withAction ? `${shortId(goal.id)} ${goal.action}` : shortId(goal.id)));
    const longest = Math.max(...names.map((name) => name.length));
    const isNarrow = longest * LETTER + 12 > width / 3; // then a name stands above its bar
    const label = isNarrow ? 0 : longest * LETTER + 12;
    const high = isNarrow ? 2 * ROW : ROW;
    const scale = (width - label - 70) / (end - start);
    const rows = newest.map((goal, index) => {
      return rowOf(goal, index * high + 2, { start, scale, now, shown, label, name: names[index], isNarrow });
    });
    const height = newest.length * high + 4;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    const words = newest.map((goal) => `${shortId(goal.id)} ${stateOf(goal)}`).join(", ");
    this.svg.setAttribute("aria-label", `Timeline of ${counted(newest.length, "goal")}: ${words}`);
    this.svg.replaceChildren(...rows);
  }
}

function endOf(goal, now) {
  return goal.isActive ? goal.awayAt || now : goal.endedAt || goal.startedAt || goal.sentAt;
}

function rowOf(goal, top, { start, scale, now, shown, label, name, isNarrow }) {
  const y = top + (isNarrow ? ROW - 4 : 0);
  const from = label + (goal.sentAt - start) * scale;
  const begunAt = goal.startedAt || (WAITING.includes(goal.status) ? now : goal.sentAt);
  const begun = label + (begunAt - start) * scale;
  const to = Math.max(label + (endOf(goal, now) - start) * scale, from + 3);
  const waits = Math.max(Math.min(begun, to) - from, 0);
  const text = durationOf(goal.seconds(now));
  return svg(
    "g",
    { class: goal.key === shown ? "current" : null },
    svg("title", {}, `${goal.action} ${shortId(goal.id)}: ${wordOf(goal.status)}${text && `, ${text}`}`),
    svg("text", { x: 0, y: top + 12 }, name),
    svg("rect", { class: "bar accepted", x: from, y, width: waits, height: ROW - 5, rx: 3 }),
    svg("rect", { class: `bar ${goal.status.toLowerCase()}`, x: from + waits, y, width: Math.max(to - from - waits, waits ? 0 : 3), height: ROW - 5, rx: 3 }),
    svg("text", { class: "duration", x: to + 6, y: y + 12 }, text),
  );
}
