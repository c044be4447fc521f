import { Connection, type ActionTypes, type AnyAction, type Goal } from "./fibaction.js";
import type { Actions } from "./robot_types.js";

const connection = new Connection<Actions>("ws://127.0.0.1:8080");
const pick = await connection.sendGoal("pick_up", { thing: "cup" });
for await (const { progress } of pick.feedback) console.log(progress.toFixed());
const goal: Goal<Actions["fibonacci"]> = await connection.sendGoal("fibonacci", { order: 3 });
console.log((await goal.outcome).result?.sequence[0]?.toFixed());
const followed = await connection.attach("fibonacci", goal.id);
console.log((await followed.outcome).result?.sequence[0]?.toFixed());
const stop: () => void = connection.watch("pick_up", ({ stamp }) => console.log(stamp + 1n));
await connection.cancel("pick_up");
// @ts-expect-error: it is text
await connection.sendGoal("pick_up", { thing: 1 });
// @ts-expect-error: the order is missing
await connection.sendGoal("fibonacci", {});
// @ts-expect-error: there is no such feedback
for await (const { progress } of followed.feedback) console.log(progress);
// @ts-expect-error: it is of another action
const other: Goal<Actions["fibonacci"]> = await connection.sendGoal("pick_up", { thing: "cup" });
// @ts-expect-error: there is no such action
await connection.sendGoal("pick", { thing: "cup" });
// @ts-expect-error: there is no such action
await connection.attach("pick", goal.id);
// @ts-expect-error: there is no such action
await connection.cancel("pick");
// @ts-expect-error: there is no such action
connection.watch("pick", stop);
// @ts-expect-error: an action has a result, too
new Connection<{ pick: { goal: number; feedback: number } }>("ws://127.0.0.1:8080");

const untyped = new Connection("ws://127.0.0.1:8080");
const any: Goal<AnyAction> = await untyped.sendGoal("pick", { thing: 1 });
console.log((await any.outcome).result.anything);
const named = await untyped.sendGoal<Actions["fibonacci"]>("fibonacci", { order: 3 });
console.log((await named.outcome).result?.sequence[0]?.toFixed());
// @ts-expect-error: the order is missing
await untyped.sendGoal<Actions["fibonacci"]>("fibonacci", {});

type Typed<All> = { [Name in keyof All]: ActionTypes };
export function send<All extends Typed<All>, Name extends keyof All & string>(
  by: Connection<All>, name: Name, goal: All[Name]["goal"],
): Promise<Goal<All[Name]>> {
  return by.sendGoal(name, goal);
}
console.log((await (await send(connection, "fibonacci", { order: 3 })).outcome).result?.sequence);
