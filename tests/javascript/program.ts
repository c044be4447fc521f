// A program that uses all of the client: its types are checked, and it never runs.

import { CancelRefused, Connection, GoalRejected, type GoalInfo, type Outcome } from "./fibaction.js";

interface Fibonacci {
  goal: { order: number };
  feedback: { partial_sequence: number[] };
  result: { sequence: number[] };
}

const connection = new Connection("ws://127.0.0.1:8080", {
  token: "secret",
  onstate: (state) => state === "lost" && console.log("lost"),
  reconnectTimeout: 5,
  WebSocket,
});
await connection.ready;
for (const { name, typeName, goal } of await connection.actions()) console.log(name, typeName, goal);
const stops: (() => void)[] = [
  connection.watch("fibonacci", (info: GoalInfo) => console.log(info.stamp / 1_000_000n)),
];

try {
  const goal = await connection.sendGoal<Fibonacci>("fibonacci", { order: 10 }, {
    signal: AbortSignal.timeout(1000),
    meta: { traceparent: "00-1" },
  });
  goal.onstatus = (status) => console.log(status.toLowerCase());
  for await (const { partial_sequence } of goal.feedback) console.log(partial_sequence[0]?.toFixed());
  const outcome: Outcome<Fibonacci["result"]> = await goal.outcome;
  console.log(outcome.result?.sequence, outcome.status, outcome.feedbackDropped + 1);
  // @ts-expect-error: it is a number
  await connection.sendGoal<Fibonacci>("fibonacci", { order: "10" });
  // @ts-expect-error: no such field
  console.log(goal.place);
} catch (error) {
  if (error instanceof GoalRejected) console.log(error.reason.trim());
  if (error instanceof CancelRefused) console.log(error.code === 3);
}

const untyped = await connection.attach("fibonacci", "00".repeat(16), { after: 0, observe: true });
for await (const feedback of untyped.feedback) console.log(feedback.anything);
console.log(untyped.checkpoint?.anything);
await untyped.cancel();
untyped.leave();
await connection.cancel("fibonacci", { before: 5n });
stops.forEach((stop) => stop());
connection.close();
