// The goals of an action in a component of Vue. Copy this file into your project.
//
//   const { send, cancel, feedback, outcome, error } = useAction(connection, "fibonacci");

import { onScopeDispose, shallowRef } from "vue";

export function useAction(connection, action) {
  const [feedback, outcome, error] = [shallowRef(null), shallowRef(null), shallowRef(null)];
  let shown = {};

  onScopeDispose(() => {
    shown.goal?.leave(); // the goal continues at the server
    shown = {};
  });

  async function send(request) {
    const mine = {}; // one that is sent later takes its place
    shown.goal?.leave();
    shown = mine;
    feedback.value = outcome.value = error.value = null;
    try {
      const goal = await connection.sendGoal(action, request);
      if (mine !== shown) return goal.leave();
      mine.goal = goal;
      for await (const one of goal.feedback) if (mine === shown) feedback.value = one;
      const ended = await goal.outcome;
      if (mine === shown) outcome.value = ended;
    } catch (problem) {
      if (mine === shown) error.value = problem;
    }
  }

  return { feedback, outcome, error, send, cancel: () => shown.goal?.cancel() };
}
