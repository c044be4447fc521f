/** Words for goals: statuses, times, and places in a queue. */

import { h } from "./dom.js";
import { settings } from "./settings.js";

const WORDS = {
  SENDING: ["sending", "…"],
  ACCEPTED: ["waiting", "◷"],
  EXECUTING: ["executing", "▶"],
  CANCELING: ["canceling", "■"],
  SUCCEEDED: ["succeeded", "✓"],
  CANCELED: ["canceled", "⊘"],
  ABORTED: ["aborted", "✕"],
  REJECTED: ["rejected", "✕"],
  UNKNOWN: ["unknown", "?"],
};

/** Return the word for a status. */
export function wordOf(status) {
  return (WORDS[status] ?? WORDS.UNKNOWN)[0];
}

/** Return the word for the state of a goal, with its place if it waits, or as it was last known. */
export function stateOf(record) {
  if (record.awayAt && record.isActive) {
    return `was ${wordOf(record.status)}`;
  }
  if (record.status === "ACCEPTED" && record.place) {
    return `waiting, ${record.place} of ${record.queueLength}`;
  }
  return wordOf(record.status);
}

/** Make a badge show the state of a goal. */
export function showBadge(badge, record) {
  const icon = (WORDS[record.status] ?? WORDS.UNKNOWN)[1];
  const text = `${icon} ${stateOf(record)}`;
  if (badge.textContent !== text) {
    badge.className = `badge ${record.awayAt && record.isActive ? "away" : record.status.toLowerCase()}`;
    badge.replaceChildren(h("span", { "aria-hidden": "true" }, icon), ` ${stateOf(record)}`);
  }
}

/** Return seconds as a person says them; nothing if they are not known. */
export function durationOf(seconds) {
  if (seconds === null) {
    return "";
  }
  if (seconds < 10) {
    return `${seconds.toFixed(1)} s`;
  }
  if (seconds < 60) {
    return `${Math.round(seconds)} s`;
  }
  const minutes = Math.floor(seconds / 60);
  const rest = String(Math.floor(seconds % 60)).padStart(2, "0");
  return minutes < 60 ? `${minutes}:${rest} min` : `${(minutes / 60).toFixed(1)} h`;
}

const MOST_LISTED = 6;

// One for each zone, since it takes longer to make one than to use it.
const PARTS = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
const CLOCKS = { local: new Intl.DateTimeFormat([], PARTS), UTC: new Intl.DateTimeFormat([], { ...PARTS, timeZone: "UTC", hourCycle: "h23" }) };

/** Return a time of the day, and the day if it is not today, in the zone that was chosen. */
export function timeOf(stamp) {
  const time = new Date(stamp);
  const timeZone = settings.zone === "UTC" ? "UTC" : undefined;
  const clock = CLOCKS[settings.zone].format(time) + (timeZone ? " UTC" : "");
  const day = (one) => (timeZone ? one.toISOString().slice(0, 10) : one.toDateString());
  return day(time) === day(new Date()) ? clock : `${time.toLocaleDateString([], { timeZone })} ${clock}`;
}

/** Return a number of things with their name. */
export function counted(number, name) {
  return `${number} ${name}${number === 1 ? "" : "s"}`;
}

/** Return texts as a list for people, which is cut if it is long. */
export function listed(texts) {
  const more = texts.length - MOST_LISTED;
  return texts.slice(0, MOST_LISTED).join(", ") + (more > 0 ? ` and ${more} more` : "");
}

/** Return a name that breaks where its parts end, and not within a word. */
export function breakable(name) {
  const parts = name.split(/(?<=[/_.])/);
  return h("span", {}, ...parts.flatMap((part) => [part, h("wbr")]).slice(0, -1));
}

/** Return the first letters of a goal's ID. */
export function shortId(id) {
  return id.slice(0, 8);
}

/** Return the name of the step that a goal with this parent is. */
export function stepOf(parent) {
  return parent.step || "without a name";
}

/** Go to an address within the page, and perhaps to its content. */
export function openLink(address, hasFocus = true) {
  window.location.hash = address.slice(1);
  if (hasFocus) {
    document.getElementById("content").focus();
  }
}

/** Return the address of a goal within the page: with the whole ID, which stays true. */
export function linkTo(action, id = "") {
  const name = action.split("/").map(encodeURIComponent).join("/");
  return `#/${name}${id && `/${id}`}`;
}
