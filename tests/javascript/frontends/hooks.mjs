// The hooks for frameworks, each within its framework, with a real server: `hooks.mjs NAME URL`.

import assert from "node:assert/strict";
import { createElement } from "react";
import { act, create } from "react-test-renderer";
import { effectScope } from "vue";
import WebSocket from "ws";
import { Connection } from "./fibaction.js";
import { useAction as useInReact } from "./use_action_react.js";
import { useAction as useInSvelte } from "./use_action_svelte.js";
import { useAction as useInVue } from "./use_action_vue.js";

globalThis.IS_REACT_ACT_ENVIRONMENT = true;

const FRAMEWORKS = {
  react(connection) {
    let latest;
    const Component = () => {
      latest = useInReact(connection, "fibonacci");
      return null;
    };
    let root;
    act(() => { root = create(createElement(Component)); });
    return {
      send: (request) => act(() => { latest.send(request); }),
      cancel: () => latest.cancel(),
      state: async () => {
        await act(() => new Promise((resolve) => setTimeout(resolve, 10)));
        return latest;
      },
      remove: () => act(() => root.unmount()),
    };
  },
  vue(connection) {
    const scope = effectScope();
    const used = scope.run(() => useInVue(connection, "fibonacci"));
    return {
      ...used,
      state: async () => {
        await new Promise((resolve) => setTimeout(resolve, 10));
        return { feedback: used.feedback.value, outcome: used.outcome.value, error: used.error.value };
      },
      remove: () => scope.stop(),
    };
  },
  svelte(connection) {
    const used = useInSvelte(connection, "fibonacci");
    let latest;
    const remove = used.subscribe((state) => { latest = state; });
    return {
      ...used,
      state: async () => {
        await new Promise((resolve) => setTimeout(resolve, 10));
        return latest;
      },
      remove,
    };
  },
};

const [name, url] = process.argv.slice(2);
const connection = new Connection(url, { WebSocket });
const all = new Connection(url, { WebSocket });
const goals = new Map();
all.watch("fibonacci", (goal) => goals.set(goal.id, goal.status));
const component = FRAMEWORKS[name](connection);
const until = async (look) => {
  for (;;) {
    const state = await component.state();
    if (look(state)) return state;
  }
};

component.send({ order: 10 });
await until(({ feedback }) => feedback);
const done = await until(({ outcome }) => outcome);
assert.equal(done.outcome.status, "SUCCEEDED");
assert.equal(done.outcome.result.sequence.length, 11);

component.send({ order: -1 });
assert.equal((await until(({ error }) => error)).error.reason, "the order is negative");

component.send({ order: 1_000_000 });
const running = await until(({ feedback }) => feedback);
assert.deepEqual([running.error, running.outcome], [null, null]);
component.cancel();
assert.equal((await until(({ outcome }) => outcome)).outcome.status, "CANCELED");

// Of two that are sent, the later one is shown; both continue when the component has gone.
component.send({ order: 1_000_000 });
component.send({ order: 1_000_001 });
const two = await until(({ feedback }) => feedback && [...goals.values()].filter((one) => one === "EXECUTING").length === 2);
assert.equal(two.error, null);
component.remove();
assert.equal((await all.cancel("fibonacci")).length, 2);
process.exit(0);
