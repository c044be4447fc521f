"""The active goals: `Runs` starts their executors, interrupts them, and ends their goals.

Theory of operation
-------------------

Each active goal has a `Run`: its record in the registry, its `FeedbackLog` and its `Execution`.
`add` makes the run. `begin` adds it to the task pool, in which `_run` awaits the executor; with a
schedule, a run may have to wait before that (`is_waiting`).

The end of a goal has two steps, in `_finish` and nowhere else. `_fix_outcome` decides the outcome,
which never changes afterwards. `_tell_end` makes it the goal's, moves the goal from the active to
the ended ones, and notifies followers. Without a store, one follows the other at once. With one,
the outcome is written between them, and told when it is kept; no task waits for that. In the same
way the begin of an attempt is written before the executor starts, and a cancel before it is told.

A goal that is not to end here (`_let_go`) just leaves, and its streams fail: the server stops and
keeps its goals, its store has failed, or another server has taken the goal over.

An executor may end by itself, or because of a cancel (`cancel`), or because the server ends the
goal for a reason of its own (`interrupt`). Each interrupts it once. They differ in the
reason, which `_fix_outcome` takes from the goal's record. An executor whose clean-up takes too long
is killed: its goal is finished first, so `_run` does not find it among the active ones any more.

An executor may go on as another goal (`take_over`). The first goal is finished then. The run of the
other goal gets the execution, and `_run` finishes that one at the end.

`on_left` is called for each goal whose executor is gone, also after a killed one has ended at last,
and for goals that end without one. From then on, the goal takes no place in a schedule.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextvars import Context
from functools import partial
from typing import Any, Generic

from anyio import current_time
from anyio.abc import TaskGroup

from fibaction.action import Action, FeedbackT, GoalT, ResultT
from fibaction.exceptions import GoalKept
from fibaction.goal_store import RecordTooLarge
from fibaction.goals import GoalID, Outcome
from fibaction.server._interruption import CancelOnce
from fibaction.server._task_pool import TaskPool
from fibaction.server._watchdog import Watch
from fibaction.server.checkpoints import Checkpoints
from fibaction.server.executor import Execution, Executor
from fibaction.server.feedback_log import FeedbackLog
from fibaction.server.goal_handle import GoalHandle, Succession
from fibaction.server.goal_keeper import STORE_FAILED, STORE_IS_LATE, GoalKeeper
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.goal_record import NO_PLACE, Ending, EndKind, GoalRecord
from fibaction.server.registry import GoalRegistry
from fibaction.states import GoalStatus

GOAL_IS_KEPT = "the server has stopped, and runs the goal again after its next start"
GOAL_IS_TAKEN = "another server has taken the goal over"
CANCELED_UNASKED = "the executor ended as canceled, but no cancel was requested"


class Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: its record, its log with the followers, and its executor."""

    __slots__ = ("execution", "goal", "has_begun", "is_waiting", "log", "outcome")

    def __init__(
        self, goal: GoalRecord, log: FeedbackLog, execution: Execution[GoalT, FeedbackT, ResultT]
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution
        self.is_waiting = True
        """True until the executor is to begin."""
        self.has_begun = False
        """True when the executor begins: with a store, when its begin is kept."""
        self.outcome: Outcome[bytes] | None = None
        """The outcome once it is fixed; the goal's record has it once it is told."""


class Runs(Generic[GoalT, FeedbackT, ResultT]):
    """All active goals of one server."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        registry: GoalRegistry,
        logs: GoalLogs,
        *,
        stall_timeout: float,
        watch: Watch,
    ) -> None:
        self._action = action
        self._executor = executor
        self._registry = registry
        self._logs = logs
        self._keeper: GoalKeeper | None = None
        self._checkpoints = Checkpoints(action.name, action.checkpoint)
        self._kept_for = ""  # the reason of a stop that keeps the goals
        self._stall_timeout = stall_timeout
        self._watch = watch
        self._runs: dict[GoalID, Run[GoalT, FeedbackT, ResultT]] = {}
        self._pool: TaskPool
        logs.find_active = self._log_of
        self.on_left: Callable[[GoalID], None] | None = None
        """The function that is called when an executor is gone; None without a schedule."""
        self.succession: Succession[GoalT] | None = None
        """The successors of goals, for their handles; None without a schedule."""

    def __len__(self) -> int:
        return len(self._runs)

    def keep_by(self, keeper: GoalKeeper) -> None:
        """Write through this keeper."""
        self._keeper = self._checkpoints.keeper = keeper

    def open(self, tasks: TaskGroup) -> None:
        """Use these tasks for executors."""
        self._pool = TaskPool(tasks, f"goal of {self._action.name}")

    # Start

    def add(
        self,
        goal: GoalRecord,
        request: GoalT,
        *,
        begin: bool,
        context: Context | None = None,
        restored: Any = None,
    ) -> FeedbackLog:
        """Add an accepted goal, and return its log. Unless it is to begin, it waits for `begin`.

        Its executor runs with the context variables of `context`, or of the caller, and gets the
        checkpoint `restored`.
        """
        log = self._logs.open(goal)
        handle = GoalHandle(goal, request, self._checkpoints, self.succession, restored)
        execution = Execution(
            self._action, self._executor, handle, log, self._stall_timeout, self._watch, context
        )
        run = self._runs[goal.goal_id] = Run(goal, log, execution)
        self._logs.tell_status(log)
        if begin:
            self._begin(run)
        return log

    def begin(self, goal_id: GoalID) -> None:
        """Run the executor of a goal that waits, beginning in the next turn of the event loop."""
        run = self._runs.get(goal_id)
        if run is None or run.goal.is_over:
            return  # its end is being written
        run.goal.place = NO_PLACE
        keeper, stored = self._keeper, run.goal.stored
        if keeper is None or stored is None:
            self._begin(run)
        elif not stored.is_running:
            run.is_waiting = False  # it has its place, and gives it back by `_leave`
            keeper.begin(run.goal, partial(self._begin, run))
        else:
            self._begin(run)

    def _begin(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if run.goal.is_over:  # it was killed while its begin was written
            self._leave(run.goal.goal_id)
            return
        run.is_waiting, run.has_begun = False, True
        self._pool.add(partial(self._run, run), run.goal.sender.owner)

    async def _run(self, run: Run[GoalT, FeedbackT, ResultT], scopes: CancelOnce) -> None:
        execution = run.execution
        try:
            if execution.handle.cancel_requested:
                ending = Ending(EndKind.CANCELED)
            else:
                self._execute(run)
                ending = await execution.run(scopes)
        except BaseException as exc:
            # KeyboardInterrupt or SystemExit, which end the program.
            self._end(execution, Ending(EndKind.FAILED, reason=type(exc).__name__))
            raise
        self._end(execution, ending)

    def _end(self, execution: Execution[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        """Finish the goal that an executor has run last, unless it was killed."""
        goal_id = execution.goal.goal_id
        run = self._runs.get(goal_id)
        # The ID of a goal that was killed may be that of another one by now.
        if run is not None and run.execution is execution and not run.goal.is_over:
            self._finish(run, ending)
        self._leave(goal_id)

    def _leave(self, goal_id: GoalID) -> None:
        if self.on_left is not None:
            self.on_left(goal_id)

    def _execute(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if run.goal.status is GoalStatus.ACCEPTED:  # else an earlier attempt has begun
            self._registry.execute(run.goal)
            self._logs.tell_status(run.log)

    def _log_of(self, goal_id: GoalID) -> FeedbackLog | None:
        run = self._runs.get(goal_id)
        return None if run is None else run.log

    def handle_of(self, goal_id: GoalID) -> GoalHandle[GoalT]:
        """Return the handle of an active goal."""
        return self._runs[goal_id].execution.handle

    def record_of(self, goal_id: GoalID) -> GoalRecord | None:
        """Return the record of an active goal; None if it is not accepted yet."""
        run = self._runs.get(goal_id)
        return None if run is None else run.goal

    def is_interrupted(self, goal_id: GoalID) -> bool:
        """Return whether the executor of a goal was interrupted, or is gone."""
        run = self._runs.get(goal_id)
        return run is None or run.execution.is_interrupted

    def take_over(self, goal_id: GoalID, successor: GoalID) -> None:
        """Let the executor of a goal go on as its successor, which waits, and end the goal.

        Raises:
            RuntimeError: The executor has yielded the result of the goal already.
        """
        old, new = self._runs[goal_id], self._runs[successor]
        old.execution.go_on_as(new.execution.handle, new.log)
        new.execution, new.is_waiting, new.has_begun = old.execution, False, True
        if self._keeper is not None:
            # The executor runs already. Nothing of this attempt may be told before it is kept: the
            # next attempt would have the same number.
            new.log.is_hidden = True
            self._keeper.begin(new.goal, new.log.reveal)
        self._finish(old, Ending(EndKind.CANCELED, reason=f"preempted by {successor}"))
        self._execute(new)

    # Stop

    def cancel(self, goal: GoalRecord, before: GoalStatus, *, interrupt: bool) -> None:
        """Tell followers that a goal is CANCELING, which was `before`, and interrupt its executor
        if `interrupt`.

        A goal that waits ends at once.
        """
        run = self._runs[goal.goal_id]
        if self._keeper is None:
            self._logs.tell_status(run.log)
        else:
            goal.earlier_status = before
            self._keeper.cancel(goal, partial(self._tell_cancel, run))
        if run.is_waiting:
            self._end(run.execution, Ending(EndKind.CANCELED))
        elif interrupt:
            run.execution.interrupt()

    def _tell_cancel(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        run.goal.earlier_status = None
        self._logs.tell_status(run.log)

    def interrupt(self, goal_id: GoalID, reason: str) -> None:
        """End a goal as ABORTED for that reason: interrupt its executor if it has begun."""
        run = self._runs.get(goal_id)
        if run is None or run.goal.is_over:
            return  # it has ended since it was chosen
        run.goal.stop_reason = run.goal.stop_reason or reason
        if run.is_waiting:
            self._finish(run, Ending(EndKind.CANCELED))
        else:
            run.execution.interrupt()

    def end(self, goal_id: GoalID, ending: Ending) -> None:
        """End a goal that waits."""
        self._finish(self._runs[goal_id], ending)

    def lose(self, goal_id: GoalID) -> None:
        """Interrupt the executor of a goal that another server has taken over."""
        run = self._runs.get(goal_id)
        if run is not None:
            self._let_go(run, GOAL_IS_TAKEN)
            if run.has_begun:
                run.execution.interrupt()
            else:
                self._leave(goal_id)

    def kill(self, goal_id: GoalID, reason: str = "", *, for_good: bool) -> None:
        """Kill the executor of a goal that was interrupted, and end the goal, for that reason if it
        has no other.

        An executor that survives this is given up if `for_good`; otherwise it runs on.
        """
        run = self._runs.get(goal_id)
        if run is not None and not run.goal.is_over:
            run.goal.stop_reason = run.goal.stop_reason or reason
            self._finish(run, Ending(EndKind.FAILED, reason=run.goal.stop_reason), killed=True)
            run.execution.kill(for_good=for_good)

    def active(self) -> tuple[GoalID, ...]:
        """Return the goals whose end is not fixed."""
        return tuple(goal_id for goal_id, run in self._runs.items() if not run.goal.is_over)

    def close(self) -> None:
        """End the tasks for executors, after the last goal."""
        self._pool.close()

    def keep_for(self, reason: str) -> None:
        """Keep the goals in the store that are interrupted for this reason, and not end them."""
        self._kept_for = reason

    def abandon_ends(self) -> None:
        """Let go of goals whose begin or end is being written: the store has failed."""
        for run in tuple(self._runs.values()):
            if run.goal.is_over or not (run.is_waiting or run.has_begun):
                self._let_go(run, STORE_FAILED)

    def let_go(self) -> None:
        """Let go of all goals: the server has stopped before its store has answered."""
        for run in tuple(self._runs.values()):
            self._let_go(run, STORE_IS_LATE)

    # Finish

    def _finish(
        self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending, *, killed: bool = False
    ) -> None:
        keeper = self._keeper
        if keeper is None:
            self._fix_outcome(run, ending)
            self._tell_end(run)
        elif keeper.failure is not None:
            self._let_go(run, STORE_FAILED)
        elif self._is_kept(run.goal, ending, killed=killed):
            self._release(keeper, run)
        else:
            self._fix_outcome(run, ending)
            self._keep_end(keeper, run)

    def _keep_end(self, keeper: GoalKeeper, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Write the outcome; one that is too large is replaced by the reason."""

        def replace_result(error: RecordTooLarge) -> None:
            run.outcome = Outcome(GoalStatus.ABORTED, None, f"the result is not kept: {error}")
            self._keep_end(keeper, run)

        assert run.outcome is not None
        keeper.end(run.goal, run.outcome, partial(self._tell_end, run), replace_result)

    def _is_kept(self, goal: GoalRecord, ending: Ending, *, killed: bool) -> bool:
        """Return whether a goal stays in the store: it has not ended by itself."""
        return (
            bool(self._kept_for)
            and goal.stop_reason == self._kept_for
            and goal.status is not GoalStatus.CANCELING
            and (killed or ending.kind is EndKind.CANCELED)
        )

    def _release(self, keeper: GoalKeeper, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        run.goal.is_over = True
        stored = run.goal.stored
        # A goal that had begun in an earlier process counts as running in the store.
        if stored is not None and (stored.is_running or stored.attempt):
            keeper.release(run.goal, partial(self._let_go, run, GOAL_IS_KEPT))
        else:
            self._let_go(run, GOAL_IS_KEPT)

    def _let_go(self, run: Run[GoalT, FeedbackT, ResultT], reason: str) -> None:
        run.goal.is_over = True
        del self._runs[run.goal.goal_id]
        self._registry.release(run.goal)
        error = GoalKept(reason)
        run.log.fail(error)
        if reason != GOAL_IS_TAKEN:
            self._logs.kept = error
        self._logs.ended.notify()

    def _fix_outcome(self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        """Decide the outcome, which never changes afterwards."""
        goal = run.goal
        if self._keeper is None:
            self._execute(run)  # the table has no edge from ACCEPTED to an end
        elif goal.status is GoalStatus.ACCEPTED:
            goal.earlier_status = goal.status  # it is told together with the end
            self._registry.execute(goal)
        if ending.kind is EndKind.CANCELED and goal.status is GoalStatus.EXECUTING:
            reason = goal.stop_reason or ending.reason or CANCELED_UNASKED
            ending = Ending(EndKind.CANCELED, ending.result, reason)
        run.outcome = self._registry.outcome_for(goal, ending)
        goal.is_over = True

    def _tell_end(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Make the outcome the goal's, for as long as results are kept, and tell it."""
        assert run.outcome is not None
        if run.goal.earlier_status is not None:
            run.goal.earlier_status = None
            self._logs.tell_status(run.log)
        now = current_time()
        self._registry.finish(run.goal, run.outcome, now=now, stamp=time.time_ns())
        del self._runs[run.goal.goal_id]
        self._logs.end(run.log, now)
        self._logs.tell_outcome(run.log, now)
