/** Topics of a robot beside a goal, such as a camera: those that its action names, or a person adds. */

import { decode } from "../fibaction.js";
import { arrange, button, h, setText, show } from "./dom.js";
import { FeedbackView } from "./feedback_view.js";
import { GoalRecord } from "./goal_record.js";
import { resolverOf } from "./schema.js";
import { textOf } from "./values.js";

const NAME = "fibaction:topics";
const AGAIN = 2000;
const LOOK = 1000;
const HEAD = 4; // bytes with the length of a piece
const MOST = 4; // a browser opens six connections to a server, and each topic holds one

/** Yield the pieces of a stream, each of which has its length in front. */
export async function* piecesOf(stream) {
  const reader = stream.getReader();
  const endOf = (bytes) => (bytes.length < HEAD ? Infinity : HEAD + new DataView(bytes.buffer, bytes.byteOffset).getUint32(0));
  let rest = new Uint8Array();
  for (let next = await reader.read(); !next.done; next = await reader.read()) {
    const joined = new Uint8Array(rest.length + next.value.length);
    joined.set(rest);
    joined.set(next.value, rest.length);
    rest = joined;
    for (let end = endOf(rest); end <= rest.length; end = endOf(rest)) {
      yield rest.slice(HEAD, end);
      rest = rest.subarray(end);
    }
  }
}

/** One topic, read for as long as it is on the page. */
class TopicView {
  constructor(store, topic, onremove) {
    this.store = store;
    this.topic = topic;
    this.note = h("p", { class: "note", role: "status" }, "Waiting for a message…");
    this.latest = h("pre", { tabindex: 0, "aria-label": `Latest message of ${topic}`, hidden: true });
    this.shown = h("div");
    const remove = button("Remove", onremove, { class: "quiet", "aria-label": `Remove ${topic}` });
    const title = h("div", { class: "buttons" }, h("h3", {}, "Topic ", h("code", {}, topic)), remove);
    this.element = h("section", { class: "topic", "aria-label": `Topic ${topic}` }, title, this.note, this.shown, this.latest);
    this.reading = new AbortController();
    const look = setInterval(() => {
      if (!this.element.isConnected) {
        clearInterval(look);
        this.reading.abort();
      } else if (store.ownAway) {
        setText(this.note, "The server does not answer: this is the last message.");
        show(this.note, true);
      }
    }, LOOK);
    this.read();
  }

  async read() {
    const { signal } = this.reading;
    while (!signal.aborted) {
      try {
        await this.readOnce(signal);
        setText(this.note, "The topic has ended. It is tried again.");
      } catch (error) {
        setText(this.note, `${error.message}. It is tried again.`);
      }
      show(this.note, true);
      await new Promise((resolve) => setTimeout(resolve, AGAIN));
    }
  }

  async readOnce(signal) {
    const answer = await this.store.ask(`topics/${this.topic}`, signal);
    if (!answer.ok) {
      throw new Error((await answer.json()).detail);
    }
    let record = null;
    for await (const piece of piecesOf(answer.body)) {
      const message = decode(piece);
      if (record) {
        record.addFeedback(message, record.number + 1, 1);
        this.change(record);
      } else {
        record = this.recordOf(message);
      }
    }
  }

  /** Begin with the type of the topic: its messages are shown as the feedback of a goal is. */
  recordOf([kind, feedback]) {
    const record = new GoalRecord(this.topic, "", { name: this.topic, typeName: kind, goal: {}, feedback, result: {} });
    record.sentAt = Date.now();
    this.view = new FeedbackView(record, "topic");
    this.shown.replaceChildren(this.view.element);
    return record;
  }

  /** Show the newest message at the next frame. */
  change(record) {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      show(this.note, false);
      show(this.latest, true);
      setText(this.latest, textOf(record.feedback));
      this.view.update(record);
      this.store.change();
    });
  }
}

/** The topics beside the goals of one action. */
export class Topics {
  constructor(store, info) {
    this.store = store;
    this.action = info?.name ?? "";
    this.named = info ? (resolverOf(info.goal)(info.goal)["x-topics"] ?? info.goal["x-topics"] ?? []) : [];
    this.views = new Map();
    this.choice = h("select", { "aria-label": "Add a topic", onfocus: () => this.look(), oninput: () => this.add(this.choice.value) });
    this.list = h("div");
    this.element = h("section", { class: "topics", "aria-label": "Topics", hidden: true }, this.list, this.choice);
    this.look();
  }

  /** The messages of each topic, as the feedback of a goal. */
  get records() {
    return [...this.views.values()].map(({ view }) => view?.record).filter(Boolean);
  }

  /** Ask which topics there are. */
  async look() {
    this.all = Object.entries((await this.store.fetched("topics")) ?? {}).sort();
    show(this.element, this.all.length > 0);
    const options = this.all.map(([name, kind]) => h("option", { value: name }, `${name} (${kind})`));
    this.choice.replaceChildren(h("option", { value: "" }, "Add a topic…"), ...options);
    this.update();
  }

  /** Return the topics that are shown: those chosen last, or else those that the action names. */
  get wanted() {
    const chosen = kept()[this.action];
    const names = this.all.map(([name]) => name);
    return (chosen ?? this.named.map((one) => topicOf(one, this.action, names)).filter(Boolean)).slice(-MOST);
  }

  add(name) {
    if (name) {
      this.keep([...new Set([...this.wanted, name])]);
    }
    this.choice.value = "";
  }

  keep(names) {
    try {
      localStorage.setItem(NAME, JSON.stringify({ ...kept(), [this.action]: names }));
    } catch {
      // The browser keeps nothing, and so shows those of the action only.
    }
    this.update();
  }

  update() {
    const { wanted } = this;
    for (const name of this.views.keys()) {
      if (!wanted.includes(name)) {
        this.views.delete(name);
      }
    }
    for (const name of wanted.filter((one) => !this.views.has(one))) {
      this.views.set(name, new TopicView(this.store, name, () => this.keep(this.wanted.filter((one) => one !== name))));
    }
    arrange(this.list, [...this.views.values()].map((view) => view.element));
  }
}

/** Return the topic that an action names: of its own server, or else of another one. */
function topicOf(name, action, all) {
  const path = `/${name.replace(/^\//, "")}`;
  const found = all.filter((topic) => `/${topic}`.endsWith(path));
  return found.find((topic) => action.startsWith(topic.slice(0, topic.length + 1 - path.length))) ?? found[0];
}

function kept() {
  try {
    return JSON.parse(localStorage.getItem(NAME) ?? "{}");
  } catch {
    return {};
  }
}
