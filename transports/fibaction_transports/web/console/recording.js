/**
 * A recording in place of a server: the actions and goals in a file of `fibaction serve --record`.
 *
 * Theory of operation. The file is read once, line by line, and may be large: of each goal only as
 * much is kept as the history keeps, and the place of its first line. When a goal is shown, its lines
 * are read again from there.
 */

import { GoalRecord } from "./goal_record.js";
import { resolverOf, withBytes } from "./schema.js";
import { Store } from "./store.js";
import { bytesOf, parsed } from "./values.js";

const MOST_GOALS = 5000;
const MOST_BYTES_OF_LINE = 2 ** 26;
const LINES_OF_PAUSE = 2000;
const CUT_OFF = "the recording ends before the end of this goal";
const NEWLINE = 10;

/** Yield the lines of a file from a place on, each with its place. */
export async function* linesOf(blob, start = 0) {
  const reader = blob.slice(start).stream().getReader();
  const decoder = new TextDecoder();
  let [rest, at] = [new Uint8Array(0), start];
  try {
    for (;;) {
      const { value, done } = await reader.read();
      const bytes = new Uint8Array(rest.length + (value?.length ?? 0));
      bytes.set(rest);
      bytes.set(value ?? [], rest.length);
      let begin = 0;
      for (let end = bytes.indexOf(NEWLINE); end >= 0; end = bytes.indexOf(NEWLINE, begin)) {
        yield [at + begin, decoder.decode(bytes.subarray(begin, end))];
        begin = end + 1;
      }
      [rest, at] = [bytes.subarray(begin), at + begin];
      if (rest.length > MOST_BYTES_OF_LINE) {
        throw new Error("one of its lines is too long");
      }
      if (done) {
        yield [at, decoder.decode(rest)];
        return;
      }
    }
  } finally {
    await reader.cancel();
  }
}

/** Return the object in a line; null if the line was cut off. */
function lineOf(text) {
  try {
    const line = parsed(text);
    return typeof line?.event === "string" ? line : null;
  } catch {
    return null;
  }
}

export class RecordedStore extends Store {
  /** Read a recording from a file; `decode` reads payloads that are not JSON. */
  constructor(file, name, decode) {
    super(null, { add() {}, clear() {} });
    Object.assign(this, { file, name, decode, isRecording: true, state: `recording ${name}, reading` });
    this.starts = new Map();
    this.wanted = null;
  }

  /** A recording has no more than its file. */
  async fetched() {
    return null;
  }

  /** Read the file to its end. */
  async start() {
    let count = 0;
    try {
      for await (const [at, text] of linesOf(this.file)) {
        this.take(lineOf(text), at);
        count += 1;
        if (count % LINES_OF_PAUSE === 0) {
          this.state = `recording ${this.name}, ${Math.floor((100 * at) / this.file.size)} % read`;
          this.change();
        }
      }
      this.state = this.actions.size ? `recording ${this.name}` : `${this.name} is not a recording, or is empty`;
    } catch (error) {
      this.state = `${this.name} cannot be read: ${error.message}`;
    }
    this.isDescribed = true;
    this.wanted = null;
    [...this.goals.values()].forEach((record) => this.finish(record));
    this.show(this.shown.action, this.shown.goal.slice(this.shown.action.length + 1));
  }

  take(line, at) {
    const { event, action, info } = line ?? {};
    if (event === "server" && info && !this.actions.has(action)) {
      this.actions.set(action, info);
    } else if (event === "accepted" || event === "rejected") {
      const record = this.begin(line);
      this.goals.set(record.key, record);
      this.starts.set(record.key, at);
      if (this.goals.size > MOST_GOALS) {
        this.forgetOldest();
      }
    } else if (line) {
      const record = this.goals.get(`${action}/${line.goal_id}`);
      if (record) {
        this.add(record, line);
        record.thin();
      }
    }
  }

  /** Return the record of a goal by its first line. */
  begin(line) {
    const record = new GoalRecord(line.action, line.goal_id ?? "", this.actions.get(line.action));
    const parent = line.parent ? { id: line.parent, step: line.step ?? "" } : null;
    Object.assign(record, { sentAt: Number(line.time) / 1e6, client: line.client ?? "", parent, isPast: true });
    record.goal = this.valueOf(record, line, "goal");
    if (line.event === "rejected") {
      this.end(record, line, "REJECTED");
    }
    return record;
  }

  /** Add a later line of a goal. */
  add(record, line) {
    const time = Number(line.time) / 1e6;
    if (line.event === "status") {
      record.setStatus(line.status, time);
    } else if (line.event === "feedback") {
      record.addFeedback(this.valueOf(record, line, "feedback"), Number(line.number ?? 0), Number(line.attempt ?? 1), time);
    } else if (line.event === "end") {
      record.result = this.valueOf(record, line, "result");
      this.end(record, line, line.status);
    }
  }

  end(record, line, status) {
    record.setStatus(status, Number(line.time) / 1e6);
    Object.assign(record, { reason: line.reason ?? "", hasEnd: true });
  }

  /** Say of a goal without an end that there is none. */
  finish(record) {
    if (record.isActive) {
      record.setStatus("UNKNOWN", 0);
      record.reason = CUT_OFF;
    }
    return record;
  }

  /** Return the value in a line, with bytes where the schema has them; undefined if there is none. */
  valueOf({ info }, line, part) {
    try {
      if (!("data" in line)) {
        return line.raw ? this.decode(bytesOf(line.raw)) : undefined;
      }
      return info ? withBytes(line.data, info[part], resolverOf(info[part])) : line.data;
    } catch {
      return line.data;
    }
  }

  /** Show an action, and perhaps one of its goals, whose lines are read again. */
  show(action, goal = "") {
    super.show(action, goal);
    const { key } = this.goals.get(this.shown.goal) ?? {};
    if (key && this.isDescribed && this.wanted !== key) {
      this.fill(key);
    }
    this.wanted = key;
  }

  async fill(key) {
    const { action, id } = this.goals.get(key);
    let record = null;
    try {
      for await (const [, text] of linesOf(this.file, this.starts.get(key))) {
        const line = lineOf(text);
        if (line?.action === action && line.goal_id === id) {
          record = record ?? this.begin(line);
          this.add(record, line);
        }
        if (record?.hasEnd || this.wanted !== key) {
          break;
        }
      }
    } catch {
      return; // the file is away: what is known of the goal stays
    }
    if (record && this.wanted === key) {
      this.goals.set(key, this.finish(record));
      this.change();
    }
  }

  /** Nothing of a recording changes. */
  async follow() {}
  async refreshPlaces() {}
  async lookUp() {}
}
