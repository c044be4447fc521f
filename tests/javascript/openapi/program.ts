// A program that uses the types that openapi-typescript has written for the REST interface.

import createClient from "openapi-fetch";
import type { paths } from "./api.js";

declare const process: { argv: string[] };

const [, , baseUrl] = process.argv;
const { GET, POST, DELETE } = createClient<paths>({ baseUrl });

const { data: actions } = await GET("/actions");
console.log(actions?.map(({ name }) => name).join());

const target = { type: "shelf", number: 3 } as const;
const fetched = await POST("/actions/fetch/goals", {
  params: { query: { wait: 20 } },
  body: { target, parts: [{ name: "arm", parts: [{ name: "hand" }] }] },
});
console.log(fetched.data?.status, fetched.data?.result?.total);

const goals = "/actions/left/count/goals";
const short = await POST(goals, { body: { order: 3 } });
const path = { goal_id: short.data!.goal_id };
const { data: events } = await GET(`${goals}/{goal_id}/events`, { params: { path }, parseAs: "text" });
console.log((events as string).split("event: feedback").length - 1);

const endless = await POST(goals, { body: { order: 50 } });
const params = { path: { goal_id: endless.data!.goal_id } };
console.log((await DELETE(`${goals}/{goal_id}`, { params })).data?.code);
console.log((await GET(`${goals}/{goal_id}`, { params: { ...params, query: { wait: 20 } } })).data?.status);

// @ts-expect-error: a field of another variant
await POST("/actions/fetch/goals", { body: { target: { type: "point", number: 3 } } });
