/** The log lines of a goal, read while a person looks at them. */

import { h, setText, show } from "./dom.js";
import { timeOf } from "./goal_text.js";

const ASK_AGAIN = 2000;
const NONE_KEPT = "Its server keeps no log lines. It does if it is made with log_lines=100.";

export class GoalLog {
  constructor(store) {
    this.store = store;
    this.askedAt = 0;
    this.hasAll = false; // after the end of the goal, nothing more comes
    this.lines = h("pre", { tabindex: 0, "aria-label": "Log lines", class: "lines", hidden: true });
    this.note = h("p", { class: "note" }, "Reading…");
    this.element = h("details", { ontoggle: () => this.update(this.record) }, h("summary", {}, "Log"), this.lines, this.note);
    show(this.element, !store.isRecording);
  }

  update(record) {
    this.record = record;
    if (this.element.open && !this.hasAll && Date.now() - this.askedAt > ASK_AGAIN) {
      this.ask(record);
    }
  }

  async ask(record) {
    this.askedAt = Date.now();
    const hasEnded = !record.isActive;
    const told = await this.store.fetched(`${this.store.pathOf(record)}/log`);
    this.hasAll = told !== null && hasEnded;
    const lines = told?.lines ?? [];
    setText(this.lines, lines.map(({ at, level, logger, text }) => `${timeOf(Number(at) / 1e6)}  ${level}  ${logger}: ${text}`).join("\n"));
    show(this.lines, lines.length > 0);
    const none = told?.lines ? "Its executor has logged nothing." : NONE_KEPT;
    setText(this.note, told === null ? "The log cannot be read now." : none);
    show(this.note, !lines.length);
  }
}
