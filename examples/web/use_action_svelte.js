// The goals of an action in a component of Svelte. Copy this file into your project.
//
//   const goal = useAction(connection, "fibonacci");
//   $goal.feedback, $goal.outcome, $goal.error; goal.send({ order: 10 }); goal.cancel()

import { writable } from "svelte/store";

const NOTHING = { feedback: null, outcome: null, error: null };

export function useAction(connection, action) {
  let shown = {};
  const leave = () => {
    shown.goal?.leave(); // the goal continues at the server
    shown = {};
  };
  const state = writable(NOTHING, () => leave); // when the last component has gone

  async function send(request) {
    leave();
    const mine = shown; // one that is sent later takes its place
    const set = (change) => mine === shown && state.update((before) => ({ ...before, ...change }));
    set(NOTHING);
    try {
      const goal = await connection.sendGoal(action, request);
      if (mine !== shown) return goal.leave();
      mine.goal = goal;
      for await (const feedback of goal.feedback) set({ feedback });
      set({ outcome: await goal.outcome });
    } catch (error) {
      set({ error });
    }
  }

  return { subscribe: state.subscribe, send, cancel: () => shown.goal?.cancel() };
}
