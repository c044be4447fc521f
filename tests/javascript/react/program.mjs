// The hook and the component of the page "In the browser", with a real server.

import assert from "node:assert/strict";
import { Connection } from "fibaction";
import { Root } from "react";
import WebSocket from "ws";
import { Fibonacci } from "./fibonacci.js";
import { useAction } from "./use_action.js";

const LONG = { order: 1_000_000 };
const connection = new Connection(process.argv[2], { WebSocket });
const all = new Connection(process.argv[2], { WebSocket });

/** Return a component that has only the hook: what the hook returns is its tree. */
const hook = (action = "fibonacci") =>
  new Root((props) => useAction(connection, props.action), { action });

/** Return the goals that are active, and cancel them. */
const cancelAll = async () => (await all.cancel("fibonacci")).map((goal) => goal.id);

// The component shows the feedback, then the result.
const page = new Root(Fibonacci, { connection });
page.press("Send");
await page.until(() => page.text("pre").startsWith("0,1,1"));
await page.until(() => page.text("p") === "SUCCEEDED");
assert.ok(page.text("pre").startsWith("0,1,1,2,3,5,8,13,21,34"));
page.remove();

// A rejection and an unknown action are errors to show; the next goal begins without them.
const one = hook();
one.tree.send({ order: -1 });
await one.until(() => one.tree.error);
assert.equal(one.tree.error.reason, "the order is negative");
one.tree.send(LONG);
await one.until(() => one.tree.feedback);
assert.equal(one.tree.error, null);
one.tree.cancel();
await one.until(() => one.tree.outcome);
assert.equal(one.tree.outcome.status, "CANCELED");

// A second goal takes the place of the first one, which continues at the server.
one.tree.send(LONG);
await one.until(() => one.tree.feedback?.partial_sequence.length > 3);
one.tree.send({ order: 2 });
await one.until(() => one.tree.outcome);
assert.deepEqual(one.tree.outcome.result, { sequence: [0, 1, 1] });
assert.equal(connection._calls.size, 0);
assert.equal(one.tree.error, null);
assert.equal((await cancelAll()).length, 1);

// A component that is removed leaves its goal, and one that is sent at that moment.
for (const isEarly of [true, false]) {
  const gone = hook();
  const sent = gone.tree.send(LONG);
  if (!isEarly) await gone.until(() => gone.tree.feedback);
  gone.remove();
  await sent;
  assert.equal(connection._calls.size, 0);
  assert.equal((await cancelAll()).length, 1);
}

connection.close();
all.close();
