/** The goals of a list that a person has chosen, and what can be done with all of them. */

import { confirmed } from "./dialogs.js";
import { button, h, setText, show } from "./dom.js";
import { csvOf, jsonOf, saveFile } from "./goal_export.js";
import { counted } from "./goal_text.js";

const AT_ONCE = 20;
const MOST_NAMED = 3;

export class ChosenGoals {
  /** Act at the server of a store; `onfail` is told errors, and `onchange` that others are chosen. */
  constructor({ store, found, onfail, onchange }) {
    Object.assign(this, { store, found, onfail, onchange });
    this.records = new Map();
    this.total = 0;
    this.isBusy = false;
    this.count = h("span", { role: "status" });
    this.every = button("", () => this.chooseAll(), { class: "quiet" });
    this.cancel = button("Cancel", () => this.cancelAll(), { class: "danger" });
    this.again = button("Send again", () => this.sendAgain());
    const none = button("Choose none", () => this.clear(), { class: "quiet" });
    this.element = h("div", { class: "tools chosen", role: "group", "aria-label": "Chosen goals", hidden: true }, this.count, this.every, h("span", { class: "space" }), this.again, this.cancel, none);
  }

  has(record) {
    return this.records.has(record.key);
  }

  /** Choose goals, or no longer. */
  choose(records, isChosen) {
    for (const record of records) {
      if (isChosen) {
        this.records.set(record.key, record);
      } else {
        this.records.delete(record.key);
      }
    }
    this.onchange();
  }

  clear() {
    this.records.clear();
    this.onchange();
  }

  /** Show how many are chosen, of so many that were found. */
  update(total) {
    this.total = total;
    const { size } = this.records;
    show(this.element, size > 0);
    if (!this.isBusy) {
      setText(this.count, `${counted(size, "goal")} chosen`);
    }
    setText(this.every, `Choose all ${total}`);
    show(this.every, size < total);
    const mayAct = !this.store.isRecording;
    show(this.cancel, mayAct && this.active.length > 0);
    show(this.again, mayAct && this.ended.length > 0);
  }

  get active() {
    return [...this.records.values()].filter((record) => record.isActive);
  }

  get ended() {
    return [...this.records.values()].filter((record) => !record.isActive && record.info);
  }

  async chooseAll() {
    this.choose(await this.found.all().catch((error) => (this.onfail(error.message), [])), true);
  }

  /** Cancel those of some goals that are active, after a question. */
  async cancelAll(records = [...this.records.values()]) {
    const active = records.filter((record) => record.isActive);
    const clients = [...new Set(active.map(({ isMine, client }) => (isMine ? "this page" : client || "an unknown client")))];
    const of = clients.length > MOST_NAMED ? counted(clients.length, "client") : clients.join(", ");
    const text = `This asks the server to cancel ${counted(active.length, "goal")} of ${of}.`;
    if (await confirmed("Cancel these goals?", text, "Cancel them", "Keep them")) {
      this.choose(active, true);
      await this.each(active, "canceled", (record) => this.store.cancel(record));
    }
  }

  /** Send all goals that are found again, after a question. */
  async sendAllAgain() {
    this.records.clear();
    await this.chooseAll();
    await this.sendAgain();
  }

  /** Send those that have ended as new goals with their labels, after a question. */
  async sendAgain() {
    const ended = this.ended.reverse(); // the goal that was sent first goes first
    const text = `This sends ${counted(ended.length, "goal")} once more, as new goals with the same labels.`;
    if (await confirmed("Send the chosen goals again?", text, "Send them again", "Do not send")) {
      await this.each(ended, "sent", async (record) => {
        const goal = await this.found.readGoal(record);
        if (goal === undefined) {
          throw new Error("what was sent is not known");
        }
        await this.store.send(record.info, goal, record.labels);
      }, 1);
    }
  }

  /** Do something with each goal, and tell how far it is; those with which it was done are left. */
  async each(records, done, act, atOnce = AT_ONCE) {
    const reasons = [];
    const left = [...records];
    const work = async () => {
      for (let record = left.shift(); record; record = left.shift()) {
        try {
          await act(record);
          this.records.delete(record.key);
        } catch (error) {
          reasons.push(error.reason ?? error.message);
        }
        setText(this.count, `${records.length - left.length} of ${counted(records.length, "goal")} ${done}`);
        this.onchange();
      }
    };
    this.isBusy = true;
    await Promise.all(Array.from({ length: atOnce }, work));
    this.isBusy = false;
    this.onfail(reasons.length ? `${counted(reasons.length, "goal")} not ${done}: ${reasons[0]}` : "");
    this.onchange();
  }

  /** Save those that are chosen with what was sent and the results, or else all that are found. */
  async save(ending, shown) {
    let records = [...this.records.values()];
    if (records.length) {
      for (const record of records.filter((one) => one.isListed && one.result === undefined)) {
        await this.found.readGoal(record);
      }
    } else {
      records = this.store.isRecording ? shown : await this.found.all().catch(() => shown);
    }
    const isTable = ending === "csv";
    saveFile(`goals.${ending}`, isTable ? csvOf(records) : jsonOf(records), isTable ? "text/csv" : "application/json");
  }
}
