// The client in a runtime that has a WebSocket of its own: `runtime.mjs URL`, in Deno and in Bun.

import process from "node:process";
import { Connection } from "./fibaction.js";

const connection = new Connection(process.argv[2]);
const goal = await connection.sendGoal("fibonacci", { order: 10 });
let count = 0;
for await (const { partial_sequence: sequence } of goal.feedback) count += sequence.length > 2;
const { status, result } = await goal.outcome;
const names = (await connection.actions()).map(({ name }) => name);
console.log(JSON.stringify({ status, length: result.sequence.length, hasFeedback: count > 0, names }));
const long = await connection.sendGoal("fibonacci", { order: 1_000_000 });
await long.cancel();
console.log((await long.outcome).status);
connection.close();
