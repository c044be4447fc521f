/** The goals that only the history of the server has, read in pages, the newest ones first. */

import { isWithin } from "./scope.js";

const WATCH_STATUS = 20; // the message of the protocol that asks for a page
const PAGE = 200;

export class PastGoals {
  constructor(store) {
    this.store = store;
    this.reset();
  }

  /** Begin again, with another choice of goals. */
  reset() {
    this.places = new Map();
    this.text = "";
  }

  /** Read the next page of each action of a scope, of the goals that a filter wants. */
  async more(scope, past) {
    const { places } = this;
    const { actions, connection } = this.store;
    const names = [...actions.keys()].filter((name) => isWithin(name, scope) && places.get(name) !== null);
    let count = 0;
    this.tell("Reading the history of the server…");
    try {
      for (const name of past ? names : []) {
        const page = [...past.page, PAGE, places.get(name) ?? null, true];
        const goals = await connection.request(WATCH_STATUS, name, PAGE, page, past.labels);
        if (places !== this.places) {
          return; // others are wanted by now
        }
        const last = goals[goals.length - 1];
        places.set(name, goals.length < PAGE ? null : [last.stamp, bytesOf(last.id)]);
        goals.forEach((told) => this.store.takePast(actions.get(name), told));
        count += goals.length;
      }
      this.tell(count ? "" : "The history of the server has no older goals.");
    } catch (error) {
      this.tell(`The history of the server cannot be read: ${error.message}`);
    }
  }

  tell(text) {
    this.text = text;
    this.store.change();
  }
}

function bytesOf(id) {
  return Uint8Array.from(id.match(/../g), (pair) => parseInt(pair, 16));
}
