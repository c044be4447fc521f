/** Tells a person who looks elsewhere that a goal was aborted or that a server has gone. */

import { shortId } from "./goal_text.js";
import { settings } from "./settings.js";

const MARK = /^\(\d+\) /;
const BEEP = { hertz: 660, seconds: 0.25, volume: 0.15 };

export class Notices {
  constructor() {
    this.active = new Set();
    this.gone = new Set();
    this.count = 0;
    window.addEventListener("focus", () => this.see());
    document.addEventListener("visibilitychange", () => this.see());
  }

  /** Compare with what was there before, and tell what has happened since. */
  update(store) {
    for (const goal of store.goals.values()) {
      if (goal.isActive) {
        this.active.add(goal.key);
      } else if (this.active.delete(goal.key) && goal.status === "ABORTED") {
        this.tell(`${goal.action}: goal ${shortId(goal.id)} was aborted`, goal.reason);
      }
    }
    const names = [...store.servers.filter(({ away }) => away).map(({ name, url }) => name || url), ...store.away.keys(), ...(store.ownAway ? ["this page"] : [])];
    const [first] = names.filter((name) => !this.gone.has(name) && !names.some((one) => one !== name && name.startsWith(`${one}/`)));
    if (first && store.isDescribed && this.wasThere) {
      this.tell(`The server of ${first} is away`, "");
    }
    this.gone = new Set(names);
    this.wasThere = store.isDescribed;
  }

  tell(text, body) {
    this.count += 1;
    this.mark();
    if (settings.sound) {
      beep();
    }
    if (settings.notification && globalThis.Notification?.permission === "granted") {
      new Notification(text, { body, icon: "console/icon.svg" }).addEventListener("click", () => window.focus());
    }
  }

  /** Put the number of what was not seen yet into the title; of a page that is shown, for a moment. */
  mark() {
    const title = document.title.replace(MARK, "");
    document.title = settings.title && this.count ? `(${this.count}) ${title}` : title;
  }

  see() {
    if (document.hasFocus()) {
      this.count = 0;
      this.mark();
    }
  }
}

function beep() {
  const sound = new AudioContext();
  const [tone, volume] = [sound.createOscillator(), sound.createGain()];
  tone.frequency.value = BEEP.hertz;
  volume.gain.value = BEEP.volume;
  tone.connect(volume).connect(sound.destination);
  tone.start();
  tone.stop(sound.currentTime + BEEP.seconds);
  tone.addEventListener("ended", () => sound.close());
}
