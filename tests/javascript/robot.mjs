// Processes with the robot, and lines to it that can be cut.

import { spawn } from "node:child_process";
import { randomInt } from "node:crypto";
import { once } from "node:events";
import net from "node:net";
import path from "node:path";

const { FIBACTION_PYTHON, FIBACTION_ROOT } = process.env;

/** A free port that no connection gets by chance: see tests/support/ports.py. */
export async function freePort() {
  while (true) {
    const server = net.createServer().listen(randomInt(10_000, 32_768), "127.0.0.1");
    try {
      await once(server, "listening");
    } catch {
      continue;
    }
    const { port } = server.address();
    server.close();
    await once(server, "close");
    return port;
  }
}

/** A process of `fibaction serve`. */
export class Robot {
  static #all = new Set();

  static async killAll() {
    for (const robot of Robot.#all) await robot.kill();
  }

  constructor(port, ...options) {
    Robot.#all.add(this);
    this.url = `http://127.0.0.1:${port}`;
    this.options = options;
  }

  /** Start it; with a token, another robot, since `fibaction serve` takes none. */
  async start(token) {
    const [program, ...command] = token
      ? [FIBACTION_PYTHON, "-m", "tests.browser.robot", this.url, token]
      : [path.join(path.dirname(FIBACTION_PYTHON), "fibaction"), "serve",
        "tests.javascript.robot:servers", this.url, ...this.options];
    this.process = spawn(program, command, { cwd: FIBACTION_ROOT });
    return new Promise((resolve, reject) => {
      let text = "";
      const read = (data) => {
        text += data;
        if (/at http|^http/.test(text)) resolve(this);
      };
      this.process.stdout.on("data", read);
      this.process.stderr.on("data", read);
      this.process.on("exit", () => reject(new Error(`the robot has ended: ${text}`)));
    });
  }

  async kill(signal = "SIGKILL") {
    if (!this.process?.kill(signal)) return;
    if (this.process.exitCode === null && this.process.signalCode === null) {
      await once(this.process, "exit");
    }
  }
}

/** A line to a server that can be cut, as often as you like. */
export class Line {
  #sockets = new Set();

  async open(url) {
    const { hostname, port } = new URL(url);
    this.server = net.createServer((near) => {
      const far = net.connect(Number(port), hostname);
      for (const [one, other] of [[near, far], [far, near]]) {
        this.#sockets.add(one);
        one.pipe(other);
        one.on("error", () => {});
        one.on("close", () => {
          this.#sockets.delete(one);
          other.destroy();
        });
      }
    });
    this.server.listen(0, "127.0.0.1");
    await once(this.server, "listening");
    this.url = `ws://127.0.0.1:${this.server.address().port}`;
    return this;
  }

  cut() {
    for (const socket of this.#sockets) socket.destroy();
  }

  close() {
    this.cut();
    this.server.close();
  }
}
