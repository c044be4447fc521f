// The goals of an action in a component of React. Copy this file into your project.
//
//   const { send, cancel, feedback, outcome, error } = useAction(connection, "fibonacci");

import { useCallback, useEffect, useRef, useState } from "react";

const NOTHING = { feedback: null, outcome: null, error: null };

export function useAction(connection, action) {
  const [state, setState] = useState(NOTHING);
  const shown = useRef({});

  useEffect(() => () => {
    shown.current.goal?.leave(); // the goal continues at the server
    shown.current = {};
  }, [connection, action]);

  const send = useCallback(async (request) => {
    const mine = {}; // one that is sent later takes its place
    shown.current.goal?.leave();
    shown.current = mine;
    const set = (change) => mine === shown.current && setState((before) => ({ ...before, ...change }));
    set(NOTHING);
    try {
      const goal = await connection.sendGoal(action, request);
      if (mine !== shown.current) return goal.leave();
      mine.goal = goal;
      for await (const feedback of goal.feedback) set({ feedback });
      set({ outcome: await goal.outcome });
    } catch (error) {
      set({ error });
    }
  }, [connection, action]);

  return { ...state, send, cancel: () => shown.current.goal?.cancel() };
}
