/** Lists of goals as files: JSON, and CSV for a table. */

import { h } from "./dom.js";
import { textOf } from "./values.js";

const COLUMNS = ["action", "goal_id", "status", "accepted", "began", "ended", "client", "worker", "labels", "reason", "goal", "result"];

/** Return a goal as a plain object; what is not known is left out. */
function plainOf({ action, id, status, sentAt, startedAt, endedAt, client, worker, labels, reason, goal, result }) {
  const [accepted, began, ended] = [sentAt, startedAt, endedAt].map((time) => (time ? new Date(time).toISOString() : undefined));
  return { action, goal_id: id, status, accepted, began, ended, client, worker, labels, reason, goal, result };
}

/** Return goals as JSON, with bytes as base64. */
export function jsonOf(goals) {
  const known = (goal) => Object.fromEntries(Object.entries(plainOf(goal)).filter(([, value]) => value !== undefined));
  return `${textOf(goals.map(known), { whole: true })}\n`;
}

/** Return goals as CSV with a line of names, where labels, goals and results are JSON. */
export function csvOf(goals) {
  const cell = (value) => {
    const text = typeof value === "string" ? value : textOf(value, { whole: true }).replace(/\n\s*/g, "");
    const safe = /^[=+\-@\t\r]/.test(text) && typeof value === "string" ? `'${text}` : text; // no formula
    return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const lines = goals.map(plainOf).map((goal) => COLUMNS.map((name) => cell(goal[name])));
  return [COLUMNS, ...lines].map((line) => `${line.join(",")}\r\n`).join("");
}

/** Let the browser save a text as a file. */
export function saveFile(name, text, type) {
  const url = URL.createObjectURL(new Blob([text], { type }));
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url));
}
