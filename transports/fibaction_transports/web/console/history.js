/** Ended goals, kept in this browser: bounded in number and in bytes. */

import { restored, stored } from "./values.js";

const MOST_GOALS = 200;
const MOST_LETTERS = 1_000_000;
const MOST_LETTERS_OF_ONE = 40_000;
const PAUSE = 500;

export class History {
  /** Keep the goals of one server, which is named by its address. */
  constructor(address, storage = window.localStorage) {
    this.name = `fibaction:goals:${address}`;
    this.storage = storage;
    this.texts = new Map();
    this.timer = 0;
    try {
      for (const text of JSON.parse(storage.getItem(this.name) ?? "[]")) {
        const { action, id } = restored(text);
        this.texts.set(`${action}/${id}`, text);
      }
    } catch {
      this.texts.clear(); // of another version, or the browser keeps nothing
    }
    window.addEventListener("pagehide", () => this.write());
  }

  /** Return all goals, the oldest first. */
  goals() {
    return [...this.texts.values()].map(restored);
  }

  /** Keep a goal that has ended. */
  add(record) {
    let text = stored(record.kept());
    if (text.length > MOST_LETTERS_OF_ONE) {
      text = stored({ ...record.kept(), goal: undefined, feedback: undefined, result: undefined, points: [], trails: [] });
    }
    this.texts.delete(record.key);
    this.texts.set(record.key, text);
    let letters = [...this.texts.values()].reduce((sum, one) => sum + one.length, 0);
    for (const [key, one] of this.texts) {
      if (this.texts.size <= MOST_GOALS && letters <= MOST_LETTERS) {
        break;
      }
      letters -= one.length;
      this.texts.delete(key);
    }
    this.timer ||= setTimeout(() => this.write(), PAUSE);
  }

  /** Forget all goals. */
  clear() {
    this.texts.clear();
    this.write();
  }

  /** Write the goals, unless the browser does not let it. */
  write() {
    clearTimeout(this.timer);
    this.timer = 0;
    try {
      this.storage.setItem(this.name, JSON.stringify([...this.texts.values()]));
    } catch {
      // A private window, or the storage is full: then the history ends with the page.
    }
  }
}
