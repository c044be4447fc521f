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

A goal that is not to end here (`_let_go`) just leaves, and its streams fail. If the server stops
and keeps its goals, or its store has failed, clients are told nothing (`GoalKept`), and come back.
If another server has taken the goal over (`lose`), this one goes on, so they are told to look
elsewhere (`ConnectionLost`). The executor of such a goal is interrupted, and is in `lost` until it
has ended: the same goal may come back before that, as another run.

If the store has a lease and it is over, no executor may go on (`_is_fenced`). It is interrupted,
and its goal is released in the store, unless it turns out to be lost.

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

from fibaction.border.goal_store import RecordTooLarge
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.durability.checkpoints import Checkpoints
from fibaction.server.durability.goal_keeper import (
    GOAL_IS_TAKEN,
    STORE_FAILED,
    STORE_IS_LATE,
    GoalKeeper,
)
from fibaction.server.execution.executor import Execution, Executor, Fence
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.lost_executors import LostExecutors
from fibaction.server.execution.run import Run
from fibaction.server.execution.task_pool import TaskPool
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_handle import GoalHandle, Succession
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.registry.goal_record import NO_PLACE, Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import ConnectionLost, GoalKept
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus

GOAL_IS_KEPT = "the server has stopped, and runs the goal again after its next start"
LEASE_IS_OVER = "the server was cut off from its store for too long"
CANCELED_UNASKED = "the executor ended as canceled, but no cancel was requested"


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
        kill_after: float,
        watch: Watch,
    ) -> None:
        """Kill executors of lost goals `kill_after` seconds after they were interrupted."""
        self._action = action
        self._executor = executor
        self._registry = registry
        self._logs = logs
        self._keeper: GoalKeeper | None = None
        self.checkpoints = Checkpoints(action.name, action.checkpoint)
        """The checkpoints of the goals."""
        self.lost = LostExecutors(action.name, kill_after=kill_after, kill=self._kill_late)
        """The executors of goals that belong to other servers by now."""
        self._kept_for = {LEASE_IS_OVER}  # the reasons for which goals stay in the store
        self._fence: Fence | None = None
        self._stall_timeout = stall_timeout
        self._watch = watch
        self._runs: dict[GoalID, Run[GoalT, FeedbackT, ResultT]] = {}
        self._pool: TaskPool
        logs.find_active = self._log_of
        self.on_left: Callable[[GoalID], None] | None = None
        """The function that is called when an executor is gone; None without a schedule."""
        self.on_lost: Callable[[GoalID], None] = lambda _: None
        """The function that is called when a goal that runs is lost, before its executor is gone.
        """
        self.succession: Succession[GoalT] | None = None
        """The successors of goals, for their handles; None without a schedule."""

    def __len__(self) -> int:
        return len(self._runs)

    @property
    def are_left(self) -> bool:
        """True if there are active goals, or executors of lost ones."""
        return bool(self._runs or self.lost)

    def keep_by(self, keeper: GoalKeeper) -> None:
        """Write through this keeper."""
        self._keeper = self.checkpoints.keeper = keeper

    def open(self, tasks: TaskGroup) -> None:
        """Use these tasks for executors; the store is open."""
        self._pool = TaskPool(tasks, f"goal of {self._action.name}")
        if self._keeper is not None:
            tasks.start_soon(self.lost.run, name=f"lost goals of {self._action.name}")
            if self._keeper.has_lease:
                self._fence = self._is_fenced

    # Start

    def add(
        self,
        goal: GoalRecord,
        request: GoalT,
        payload: bytes,
        *,
        begin: bool,
        context: Context | None = None,
        restored: Any = None,
    ) -> FeedbackLog[GoalRecord]:
        """Add an accepted goal, and return its log. Unless it is to begin, it waits for `begin`.

        Its executor gets the `request`, which the client has sent as the `payload`, and the
        checkpoint `restored`; it runs with the context variables of `context`, or of the caller.
        """
        log = self._logs.open(goal, payload)
        handle = GoalHandle(goal, request, self.checkpoints, self.succession, restored)
        execution = Execution(
            self._action, self._executor, handle, log, self._stall_timeout, self._watch, context
        )
        execution.fence = self._fence
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
        if keeper is None or stored is None or stored.is_running:
            self._begin(run)
        else:
            run.is_waiting = False  # it has its place, and gives it back by `_leave`
            keeper.begin(run.goal, partial(self._begin, run))

    def _begin(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if run.goal.is_over:  # it was killed while its begin was written
            self._leave(run.goal.goal_id)
            return
        run.is_waiting, run.has_begun = False, True
        self._pool.add(partial(self._run, run), run.goal.sender.owner)

    async def _run(self, run: Run[GoalT, FeedbackT, ResultT], scopes: CancelOnce) -> None:
        execution = run.execution
        try:
            if self._fence is not None:
                self._fence(execution)
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
        execution.has_ended = True
        run = self._runs.get(goal_id)
        # The ID of a goal that was killed, or lost, may be that of another one by now.
        if run is not None and run.execution is execution and not run.goal.is_over:
            self._finish(run, ending)
        was_lost = self.lost.discard(execution)
        self._leave(goal_id)
        if was_lost:
            self._logs.ended.notify()

    def _leave(self, goal_id: GoalID) -> None:
        # A goal that has come back has no place before its old executor is gone.
        if self.on_left is not None and goal_id not in self.lost:
            self.on_left(goal_id)

    def _execute(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if run.goal.status is GoalStatus.ACCEPTED:  # else an earlier attempt has begun
            self._registry.execute(run.goal)
            self._logs.tell_status(run.log)

    def _log_of(self, goal_id: GoalID) -> FeedbackLog[GoalRecord] | None:
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
            self._keeper.begin(new.goal, partial(self._tell_begin, new))
        self._finish(old, Ending(EndKind.CANCELED, reason=f"preempted by {successor}"))
        if self._keeper is None:
            self._execute(new)
        else:
            new.goal.earlier_status = new.goal.status
            self._registry.execute(new.goal)

    def _tell_begin(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Tell of an attempt that is kept by now, and has begun before."""
        # A cancel may have been accepted since, and not be kept yet.
        is_newest = run.goal.status is GoalStatus.EXECUTING
        run.goal.earlier_status = None if is_newest else GoalStatus.EXECUTING
        self._logs.tell_status(run.log)
        run.log.reveal()

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
            if goal.earlier_status is None:
                goal.earlier_status = before
            self._keeper.cancel(goal, partial(self._tell_status, run))
        if run.is_waiting:
            self._end(run.execution, Ending(EndKind.CANCELED))
        elif interrupt:
            run.execution.interrupt()

    def _tell_status(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Tell a status that is kept by now."""
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

    def lose(self, goal: GoalRecord) -> None:
        """Let go of a goal that another server has taken over, and interrupt its executor."""
        run = self._runs.get(goal.goal_id)
        if run is None or run.goal is not goal:
            return
        goal.stop_reason = goal.stop_reason or GOAL_IS_TAKEN  # its executor may look for that
        self._let_go(run, ConnectionLost(GOAL_IS_TAKEN))
        execution = run.execution
        if not run.has_begun:
            self._leave(goal.goal_id)
        elif execution.goal is goal and not execution.has_ended:  # else it runs another goal
            self.on_lost(goal.goal_id)
            self.lost.add(execution)

    def _is_fenced(self, execution: Execution[GoalT, FeedbackT, ResultT]) -> bool:
        """Interrupt an executor, and return True, if its goal may be another server's by now."""
        assert self._keeper is not None
        if self._keeper.is_valid:
            return False
        goal = execution.goal
        if not (goal.is_over or execution.is_interrupted):
            goal.stop_reason = goal.stop_reason or LEASE_IS_OVER
            self.lost.interrupt(execution)
        return True

    def _kill_late(self, execution: Execution[GoalT, FeedbackT, ResultT]) -> None:
        goal = execution.goal
        if goal.is_over:
            execution.kill(for_good=False)
        else:
            self.kill(goal.goal_id, for_good=False)

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
        self._kept_for.add(reason)

    def abandon_ends(self) -> None:
        """Let go of goals whose begin or end is being written: the store has failed."""
        for run in tuple(self._runs.values()):
            if run.goal.is_over or not (run.is_waiting or run.has_begun):
                self._let_go(run, GoalKept(STORE_FAILED))

    def let_go(self) -> None:
        """Let go of all goals: the server has stopped before its store has answered."""
        for run in tuple(self._runs.values()):
            self._let_go(run, GoalKept(STORE_IS_LATE))

    # Finish

    def _finish(
        self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending, *, killed: bool = False
    ) -> None:
        keeper = self._keeper
        if keeper is None:
            self._fix_outcome(run, ending)
            self._tell_end(run)
        elif keeper.failure is not None:
            self._let_go(run, GoalKept(STORE_FAILED))
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
            goal.stop_reason in self._kept_for
            and goal.status is not GoalStatus.CANCELING
            and (killed or ending.kind is EndKind.CANCELED)
        )

    def _release(self, keeper: GoalKeeper, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        run.goal.is_over = True
        # Also one that waits: in a store that servers share, it is free for the others from now on.
        error: ConnectionLost = GoalKept(GOAL_IS_KEPT)
        if run.goal.stop_reason == LEASE_IS_OVER:
            error = ConnectionLost(LEASE_IS_OVER)
        keeper.release(run.goal, partial(self._let_go, run, error))

    def _let_go(self, run: Run[GoalT, FeedbackT, ResultT], error: ConnectionLost) -> None:
        """End the streams of a goal that does not end here, and forget it."""
        run.goal.is_over = True
        del self._runs[run.goal.goal_id]
        self._registry.release(run.goal)
        if isinstance(error, GoalKept):
            self._logs.keep(run.log, error)
        else:
            self._logs.lose(run.log, error)

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
            self._tell_status(run)
        now = current_time()
        self._registry.finish(run.goal, run.outcome, now=now, stamp=time.time_ns())
        del self._runs[run.goal.goal_id]
        self._logs.end(run.log, now)
        self._logs.tell_outcome(run.log, now)
