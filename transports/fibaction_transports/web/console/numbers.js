/** The numbers of actions: rates, ends, reasons of failures, and times of waiting and running. */

import { h, setText, show } from "./dom.js";
import { breakable, counted, durationOf, listed, timeOf } from "./goal_text.js";
import { isWithin } from "./scope.js";

const ASK_AGAIN = 10_000;
const SPANS = { "1h": "an hour", "24h": "a day", "7d": "a week" };
const HEADINGS = ["Goals", "per minute", "Succeeded", "Canceled", "Aborted", "Waited p50", "p95", "Ran p50", "p95"];

export class Numbers {
  /** Make the part of a page with the numbers of an action, or of all in a scope. */
  constructor(store, scope) {
    Object.assign(this, { store, scope, askedAt: 0, isAsking: false });
    const options = Object.entries(SPANS).map(([value, text]) => h("option", { value, selected: value === "24h" }, text));
    this.since = h("select", { "aria-label": "Span", oninput: () => this.askAgain() }, ...options);
    this.told = h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Numbers of actions" });
    this.note = h("p", { class: "note" }, "Counting…");
    const span = h("p", { class: "note" }, "The last ten minutes, and ", this.since);
    this.element = h("details", { class: "card numbers", ontoggle: () => this.askAgain() }, h("summary", {}, "Numbers"), span, this.told, this.note);
    show(this.element, !store.isRecording);
  }

  update() {
    if (this.element.open && !this.isAsking && Date.now() - this.askedAt > ASK_AGAIN) {
      this.ask();
    }
  }

  askAgain() {
    this.askedAt = 0;
    this.update();
  }

  /** Ask for the numbers of one action after the other. */
  async ask() {
    const since = this.since.value;
    const all = [...this.store.actions.keys()].sort().filter((name) => isWithin(name, this.scope));
    const names = all.filter((name) => !this.store.awayOf(name));
    if (this.told.firstChild && all.length && !names.length) {
      setText(this.note, `These are the numbers of ${timeOf(this.askedAt)}: the server is away.`);
      return;
    }
    this.isAsking = true;
    const found = [];
    for (const name of names) {
      const path = `actions/${name.split("/").map(encodeURIComponent).join("/")}/stats?since=${since}`;
      const numbers = await this.store.fetched(path);
      if (numbers) {
        found.push([name, numbers]);
      }
    }
    this.isAsking = false;
    this.askedAt = Date.now();
    if (since === this.since.value) {
      this.tell(found, since, all.filter((name) => !found.some(([one]) => one === name)));
    } else {
      this.askAgain();
    }
  }

  tell(found, since, missing) {
    const busy = found.filter(([name, { recent, whole }]) => name === this.scope || [recent, whole].some(hasGoals));
    const rows = busy.flatMap(([name, { recent, whole }]) => [rowOf(name, "ten minutes", recent), rowOf(name, SPANS[since], whole)]);
    const heads = ["Action", "In", ...HEADINGS].map((text) => h("th", { scope: "col" }, text));
    const table = h("table", { class: "servers" }, h("caption", { class: "hidden-text" }, "Numbers"), h("thead", {}, h("tr", {}, ...heads)), h("tbody", {}, ...rows));
    const failures = found.flatMap(([name, { whole }]) => whole.failures.map(({ reason, goals }) => h("li", {}, `${counted(goals, "goal")}${found.length > 1 ? ` of ${name}` : ""}: ${reason}`)));
    const list = failures.length ? [h("h3", {}, `Why goals were aborted in ${SPANS[since]}`), h("ul", { class: "failures" }, ...failures)] : [];
    this.told.replaceChildren(...(busy.length ? [table] : []), ...list);
    const idle = found.length - busy.length;
    const forgetful = found.filter(([, { past }]) => !past).map(([name]) => name);
    const notes = [
      idle ? `${counted(idle, "action")} without a goal in ${SPANS[since]}.` : "",
      forgetful.length ? `Without a history, only goals that the server remembers are counted: ${listed(this.store.serversOf(forgetful))}.` : "",
      missing.length ? `Not counted, since it cannot be asked: ${listed(this.store.serversOf(missing))}.` : "",
    ];
    setText(this.note, notes.filter(Boolean).join(" "));
  }
}

function hasGoals({ accepted, ended }) {
  return accepted > 0 || Object.values(ended).some((count) => count > 0);
}

function rowOf(name, span, { accepted, per_minute: rate, ended, waited, ran }) {
  const { SUCCEEDED, CANCELED, ABORTED } = ended;
  const times = [waited, ran].flatMap((one) => (one ? [lasting(one.p50), lasting(one.p95)] : ["–", "–"]));
  const cells = [span, accepted, Number(rate.toPrecision(3)), SUCCEEDED, CANCELED, ABORTED, ...times];
  return h("tr", {}, h("th", { scope: "row" }, breakable(name)), ...cells.map((text) => h("td", {}, String(text))));
}

function lasting(seconds) {
  return seconds < 1 ? `${Number((seconds * 1000).toPrecision(3))} ms` : durationOf(seconds);
}
