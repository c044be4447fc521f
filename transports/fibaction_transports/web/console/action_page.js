/** The page of one action, or of all of them: form, goals, timeline, and the goal that is shown. */

import { announce, errorPlace, h, setText, show, tellError } from "./dom.js";
import { confirmed } from "./dialogs.js";
import { GoalForm } from "./form.js";
import { GoalList } from "./goal_list.js";
import { breakable, counted, linkTo, listed, openLink, shortId, stateOf, timeOf } from "./goal_text.js";
import { GoalView } from "./goal_view.js";
import { Levers } from "./levers.js";
import { Numbers } from "./numbers.js";
import { descriptionOf } from "./schema.js";
import { isWithin } from "./scope.js";
import { Timeline } from "./timeline.js";

const A_MOMENT = 1000;

export class ActionPage {
  /** Make the page of an action; without an `info`, that of all actions, or of a namespace. */
  constructor(store, info, scope, onfilter) {
    this.store = store;
    this.info = info;
    this.scope = scope;
    this.view = null;
    this.states = new Map();
    this.timeline = new Timeline({ withAction: !info });
    this.list = new GoalList({
      store,
      info,
      withAction: !info,
      oncancel: (record) => this.cancel(record),
      oncancelAll: () => this.cancelAll(),
      onforget: store.isRecording ? null : () => this.forget(),
      onfilter: () => {
        onfilter(this.list.filter.query);
        store.change();
      },
      onfail: (text) => this.fail(text),
    });
    this.levers = new Levers(store, info, scope, (text) => this.fail(text));
    this.numbers = new Numbers(store, scope);
    this.missing = h("p", { class: "error", role: "status", hidden: true });
    this.away = h("p", { class: "error", role: "status", hidden: true });
    this.error = errorPlace();
    this.place = h("div", { class: "goal-place" });
    this.form = info && !store.isRecording ? new GoalForm(info, (goal) => this.send(goal)) : null;
    const title = h("h1", {}, breakable(info?.name ?? (scope || "All actions")));
    const type = info?.type_name ?? info?.typeName;
    const head = h("div", { class: "title" }, title, type ? h("code", {}, type) : null, this.levers.element);
    const about = this.form && descriptionOf(info.goal);
    const parts = [h("h2", {}, "New goal"), about ? h("p", { class: "about" }, about) : null, this.form?.element];
    const form = this.form && h("section", { class: "card", "aria-label": "New goal" }, ...parts);
    const left = h("div", { class: "left" }, form, this.timeline.element);
    this.element = h("div", { class: "page" }, head, this.missing, this.away, this.levers.note, this.error, h("div", { class: "halves" }, left, this.place), this.numbers.element, this.list.element);
  }

  /** Show what there is now. */
  update() {
    const goals = this.store.goalsOf(this.scope);
    const record = this.store.goals.get(this.store.shown.goal);
    if (!record) {
      this.view = null;
      this.place.replaceChildren();
    } else if (this.view?.record.key !== record.key) {
      this.view = new GoalView(record, {
        store: this.store,
        oncancel: (one) => this.cancel(one),
        onagain: this.store.isRecording ? null : (one) => this.useAgain(one),
        onretry: (one) => this.retry(one),
        onrerun: (one) => this.rerun(one),
        onlabel: (label) => this.choose("label", label),
      });
      this.place.replaceChildren(this.view.element);
    }
    this.element.classList.toggle("with-goal", Boolean(record));
    this.view?.update(record);
    this.list.update(goals, record?.key, this.scope && this.namesOf());
    this.timeline.update(goals, record?.key);
    this.levers.update();
    this.numbers.update();
    this.tellAway();
    this.tellEnds(goals);
  }

  /** Return the names of the actions that the page is about. */
  namesOf() {
    return [...this.store.actions.keys()].filter((name) => isWithin(name, this.scope));
  }

  /** Say which servers are away. */
  tellAway() {
    const away = this.namesOf().filter((name) => this.store.awayOf(name));
    show(this.away, away.length > 0);
    if (away.length) {
      const servers = new Map(this.store.serversOf(away).map((name) => [name, this.store.awayOf(away.find((one) => isWithin(one, name) || isWithin(one, `${name}/`)))]));
      const [[first, { since, reason }]] = servers;
      const each = [...servers].map(([name, one]) => `${name} since ${timeOf(one.since)}`);
      const one = `The server of ${first} is away since ${timeOf(since)}, and is tried again. Its goals are shown as they were then.`;
      setText(this.away, servers.size === 1 ? one : `Away, and tried again: ${listed(each)}. Their goals are shown as they were then.`);
      this.away.title = reason;
    }
  }

  /** Tell a screen reader how the goals of this page go. */
  tellEnds(goals) {
    for (const goal of goals.filter((one) => one.isMine)) {
      const state = stateOf(goal);
      if (this.states.get(goal.key) !== state) {
        this.states.set(goal.key, state);
        announce(`Goal ${shortId(goal.id)}: ${state} ${goal.reason}`);
      }
    }
  }

  /** Say what the address names and the server does not have, if it still has not in a moment. */
  tellMissing(text) {
    if (this.missing.textContent !== text) {
      this.missing.textContent = text;
      show(this.missing, false);
      clearTimeout(this.telling);
      this.telling = setTimeout(() => show(this.missing, Boolean(this.missing.textContent)), A_MOMENT);
    }
  }

  async send(goal) {
    const record = await this.store.send(this.info, goal);
    openLink(linkTo(record.action, record.id), false);
  }

  /** Send a goal once more as a new one, with its labels, after a question. */
  async retry(record) {
    const info = this.store.actions.get(record.action);
    const text = `This sends the goal ${shortId(record.id)} of ${record.action} once more, as a new goal.`;
    if (await confirmed("Send this goal again?", text, "Send again", "Do not send")) {
      try {
        const sent = await this.store.send(info, record.goal, record.labels);
        this.fail("");
        openLink(linkTo(sent.action, sent.id));
      } catch (error) {
        this.fail(error.reason ? `Rejected: ${error.reason}` : error.message);
      }
    }
  }

  /** Run a goal again that was given up, after a question. */
  async rerun(record) {
    const text = `The server runs goal ${shortId(record.id)} of ${record.action} again, as a new goal from its last checkpoint.`;
    if (await confirmed("Run this goal again?", text, "Run again", "Do not run")) {
      try {
        const id = await this.store.rerun(record);
        this.fail("");
        openLink(linkTo(record.action, id));
      } catch (error) {
        this.fail(error.message);
      }
    }
  }

  /** List the goals of a label, or of a client. */
  choose(name, value) {
    this.list.filter.choose(name, value);
    this.list.element.scrollIntoView({ block: "nearest" });
  }

  useAgain(record) {
    if (this.form) {
      this.form.set(record.goal);
      this.focusForm();
    } else {
      openLink(linkTo(record.action, record.id), false);
    }
  }

  focusForm() {
    this.form?.element.querySelector("input, select, textarea, button")?.focus();
  }

  fail(text) {
    tellError(this.error, text);
  }

  async cancel(record) {
    const name = `goal ${shortId(record.id)} of ${record.action}`;
    if (await confirmed("Cancel this goal?", `This asks the server to cancel ${name}.`, "Cancel the goal", "Keep it")) {
      try {
        await this.store.cancel(record);
        this.fail("");
      } catch (error) {
        this.fail(`The cancel of ${name} was rejected: ${error.reason ?? error.message}`);
      }
    }
  }

  async cancelAll() {
    const active = this.store.goalsOf(this.scope).filter((goal) => goal.isActive);
    const text = `This asks the server to cancel ${counted(active.length, "active goal")}, those of other clients included.`;
    if (await confirmed("Cancel all goals?", text, "Cancel all", "Keep them")) {
      const reasons = await this.store.cancelAll(this.scope);
      this.fail(reasons.length ? `${counted(reasons.length, "cancel")} rejected: ${reasons[0]}` : "");
    }
  }

  async forget() {
    const text = "This browser forgets the goals that have ended. The server does not.";
    if (await confirmed("Clear the list?", text, "Clear", "Keep it")) {
      this.store.forgetEnded();
    }
  }
}
