/** The levers of an operator: to pause an action, to drain its server, and to take goals again. */

import { confirmed } from "./dialogs.js";
import { announce, button, h, setText, show } from "./dom.js";
import { isWithin } from "./scope.js";

const WAYS = { hold: "New goals wait.", refuse: "New goals are rejected." };

export class Levers {
  /** Make the levers of an action; of all actions, or of a namespace, only what is paused. */
  constructor(store, info, scope, fail) {
    Object.assign(this, { store, info, scope, fail });
    const levers = info && !store.isRecording;
    this.pause = button("Pause…", () => this.askPause(), { class: "quiet" });
    this.drain = button("Drain…", () => this.askDrain(), { class: "quiet" });
    this.resume = button("Resume…", () => this.askResume(), { class: "quiet", hidden: true });
    this.element = h("span", { class: "levers" }, ...(levers ? [this.pause, this.drain, this.resume] : []));
    this.note = h("p", { class: "error", role: "status", hidden: true });
  }

  update() {
    const paused = [...this.store.intakes].filter(([name]) => isWithin(name, this.scope));
    const text = paused.map(([name, { text: why }]) => `${name}: ${why}.`).join(" ");
    setText(this.note, text);
    show(this.note, Boolean(text));
    const mode = this.info && this.store.intakes.get(this.info.name)?.mode;
    show(this.resume, Boolean(mode));
    show(this.pause, mode !== "drain");
    show(this.drain, mode !== "drain");
    const fixed = this.info && this.store.fixed.get(this.info.name);
    for (const lever of [this.pause, this.drain]) {
      lever.disabled = Boolean(fixed);
      lever.title = fixed ? `${this.info.name}: ${fixed}.` : "";
    }
  }

  async askPause() {
    const way = h("select", { "aria-label": "New goals" }, ...Object.entries(WAYS).map(([value, text]) => h("option", { value }, text)));
    const text = `No other goal of ${this.info.name} begins until somebody resumes it, for all clients. Those that run go on.`;
    await this.change("Pause this action?", text, "Pause", "Do not pause", () => way.value, way);
  }

  async askDrain() {
    const text = `The server of ${this.info.name}, or each worker of its fleet, rejects new goals of it until it is started again. The others run to their ends.`;
    await this.change("Drain the server of this action?", text, "Drain", "Do not drain", () => "drain");
  }

  async askResume() {
    const why = this.store.intakes.get(this.info.name)?.text ?? "";
    await this.change("Take goals again?", `${why}.`, "Resume", "Leave it so", () => "open");
  }

  /** Change how the action takes goals, after a question; the reason is noted by the server. */
  async change(title, text, yes, no, mode, ...parts) {
    const reason = h("input", { type: "text", maxlength: 200, placeholder: "Reason (optional)", "aria-label": "Reason" });
    if (!(await confirmed(title, text, yes, no, h("div", { class: "buttons" }, ...parts, reason)))) {
      return;
    }
    const path = `actions/${this.info.name.split("/").map(encodeURIComponent).join("/")}/intake`;
    const body = JSON.stringify({ mode: mode(), reason: reason.value });
    try {
      await this.store.checkIsThere(this.info.name, "nothing was changed");
      const answer = await this.store.ask(path, undefined, { method: "PUT", body, headers: { "Content-Type": "application/json" } });
      if (!answer.ok) {
        throw new Error((await answer.json()).detail ?? answer.statusText);
      }
      this.fail("");
      announce(`${this.info.name}: ${yes}`);
    } catch (error) {
      this.fail(`${yes}: ${error.message}`);
    }
    await this.store.askAway();
  }
}
