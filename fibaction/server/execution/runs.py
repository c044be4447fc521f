"""The active goals: `Runs` starts their executors, interrupts them, and ends their goals.

Theory of operation
-------------------

Each active goal has a `Run`: its record in the registry, its `FeedbackLog` and its `Execution`.
`add` makes the run. `begin` adds it to the task pool, in which `_run` awaits the executor; with a
schedule, a run may have to wait before that. What happens to a goal goes through `_step`, which
looks its effects up in the table of a goal's life, and carries them out.

The end of a goal has two steps. `_finish`, and nothing else, decides the outcome, which never
changes afterwards. `_tell_end` makes it the goal's, moves the goal from the active to
the ended ones, and notifies followers. Between them, the outcome is written, and no task waits for
that; without a store, one follows the other at once. In the same way the begin of an attempt is
written before the executor starts, and a cancel before it is told.

A goal that is not to end here (`_let_go`) just leaves, and its streams fail. If the server stops
and keeps its goals, or its store has failed, clients are told nothing (`GoalKept`), and come back.
If another server has taken the goal over (`lose`), this one goes on, so they are told to look
elsewhere (`ConnectionLost`). The executor of such a goal is interrupted, and is in `lost` until it
has ended: the same goal may come back before that, as another run.

If the store has a lease and it is over, no executor may go on (`_is_fenced`). It is interrupted,
and its goal is released in the store, unless it turns out to be lost.

An executor may end by itself, or because of a cancel (`cancel`), or because the server ends the
goal for a reason of its own (`interrupt`). Each interrupts it once. They differ in the
reason, which `_finish` takes from the goal's record. An executor whose clean-up takes too long
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
from fibaction.server.durability.goal_keeper import GOAL_IS_TAKEN, STORE_FAILED, STORE_IS_LATE
from fibaction.server.durability.keeper import Keeper, NoStoreKeeper
from fibaction.server.execution.executor import Execution, Executor, Fence
from fibaction.server.execution.executor_life import (
    EXECUTOR_LIFE,
    ExecutorEvent,
    ExecutorPhase,
)
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.lost_executors import LostExecutors
from fibaction.server.execution.run import Run
from fibaction.server.execution.task_pool import TaskPool
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_handle import GoalHandle, Succession
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.life import LIFE, Effect, Event, LifeTable, Phase
from fibaction.server.registry.goal_record import NO_PLACE, Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import ConnectionLost, GoalKept
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus

GOAL_IS_KEPT = "the server has stopped, and runs the goal again after its next start"
LEASE_IS_OVER = "the server was cut off from its store for too long"
CANCELED_UNASKED = "the executor ended as canceled, but no cancel was requested"

# Looked up for each goal: a name of this module is found faster than a member of an enum.
BEGIN, BEGIN_KEPT, EXECUTE = Event.BEGIN, Event.BEGIN_KEPT, Event.EXECUTE
END, END_KEPT = Event.END, Event.END_KEPT
CALL, LEAVE = ExecutorEvent.CALL, ExecutorEvent.LEAVE
LOST = Phase.LOST


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
        self._keeper: Keeper = NoStoreKeeper()
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
        acts = self._acts()
        self._life = LifeTable(
            (at, (step.phase, tuple(acts[effect] for effect in step.effects)))
            for at, step in LIFE.items()
        )
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

    def keep_by(self, keeper: Keeper) -> None:
        """Write through this keeper."""
        self._keeper = self.checkpoints.keeper = keeper

    def open(self, tasks: TaskGroup) -> None:
        """Use these tasks for executors; the store is open."""
        self._pool = TaskPool(tasks, f"goal of {self._action.name}")
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
            self._step(run, BEGIN)
        return log

    def begin(self, goal_id: GoalID) -> None:
        """Run the executor of a goal that waits, beginning in the next turn of the event loop."""
        run = self._runs.get(goal_id)
        if run is not None:
            run.goal.place = NO_PLACE
            self._step(run, BEGIN)

    def _write_begin(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if self._keeper.begin(run.goal, BEGIN_KEPT, self._step_later):
            self._step(run, BEGIN_KEPT)

    def _call(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        execution = run.execution
        execution.phase = EXECUTOR_LIFE[execution.phase, CALL]
        self._pool.add(partial(self._run, run), run.goal.sender.owner)

    # The table

    def _step(self, run: Run[GoalT, FeedbackT, ResultT], event: Event) -> None:
        """Let a goal make the step that follows from an event: see `life`."""
        goal = run.goal
        goal.phase, acts = self._life[goal.phase, event]
        for act in acts:
            act(run)

    def _step_later(self, goal: GoalRecord, event: Event) -> None:
        """Let a goal make the step that follows from a write, which is kept by now."""
        self._step(self._runs[goal.goal_id], event)

    def _acts(self) -> dict[Effect, Callable[[Run[GoalT, FeedbackT, ResultT]], None]]:
        """Return the methods that carry out the effects."""
        return {
            Effect.WRITE_BEGIN: self._write_begin,
            Effect.WRITE_TAKE_OVER: self._write_take_over,
            Effect.WRITE_CANCEL: self._write_cancel,
            Effect.WRITE_END: self._write_end,
            Effect.WRITE_RELEASE: self._write_release,
            Effect.CALL: self._call,
            Effect.INTERRUPT: lambda run: run.execution.interrupt(),
            Effect.END_UNBEGUN: lambda run: self._finish(run, Ending(EndKind.CANCELED)),
            Effect.END_AND_LEAVE: lambda run: self._end(run.execution, Ending(EndKind.CANCELED)),
            Effect.TELL_EXECUTING: self._tell_executing,
            Effect.TELL_TAKE_OVER: self._tell_take_over,
            Effect.TELL_CANCELING: lambda run: self._tell(run, run.goal.status),
            Effect.TELL_END: self._tell_end,
            Effect.TELL_GONE: self._tell_gone,
            Effect.LEAVE: lambda run: self._leave(run.goal.goal_id),
            Effect.PART: self._part,
        }

    async def _run(self, run: Run[GoalT, FeedbackT, ResultT], scopes: CancelOnce) -> None:
        execution = run.execution
        try:
            if self._fence is not None:
                self._fence(execution)
            if run.goal.stop_reason or run.goal.status is GoalStatus.CANCELING:
                ending = Ending(EndKind.CANCELED)
            else:
                self._step(run, EXECUTE)
                ending = await execution.run(scopes)
        except BaseException as exc:
            # KeyboardInterrupt or SystemExit, which end the program.
            self._end(execution, Ending(EndKind.FAILED, reason=type(exc).__name__))
            raise
        self._end(execution, ending)

    def _end(self, execution: Execution[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        """Finish the goal that an executor has run last, unless it was killed."""
        goal_id = execution.goal.goal_id
        execution.phase = EXECUTOR_LIFE[execution.phase, LEAVE]
        run = self._runs.get(goal_id)
        # The ID of a goal that was killed, or lost, may be that of another one by now.
        if run is not None and run.execution is execution and run.goal.phase.is_open:
            self._finish(run, ending)
        was_lost = execution.goal.phase is LOST and self.lost.discard(execution)
        if self.on_left is not None:
            self._leave(goal_id)
        if was_lost:
            self._logs.ended.notify()

    def _leave(self, goal_id: GoalID) -> None:
        # A goal that has come back has no place before its old executor is gone.
        if self.on_left is not None and goal_id not in self.lost:
            self.on_left(goal_id)

    def _tell_executing(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if run.goal.status is GoalStatus.ACCEPTED:  # else an earlier attempt has begun
            self._registry.execute(run.goal)
            run.goal.told_status = run.goal.status
            self._logs.tell_status(run.log)

    def _tell(self, run: Run[GoalT, FeedbackT, ResultT], status: GoalStatus) -> None:
        """Tell a status that is kept by now."""
        run.goal.told_status = status
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
        if run is None or run.goal.stop_reason:
            return True
        return run.execution.phase is ExecutorPhase.INTERRUPTED

    def take_over(self, goal_id: GoalID, successor: GoalID) -> None:
        """Let the executor of a goal go on as its successor, which waits, and end the goal.

        Raises:
            RuntimeError: The executor has yielded the result of the goal already.
        """
        old, new = self._runs[goal_id], self._runs[successor]
        old.execution.go_on_as(new.execution.handle, new.log)
        new.execution = old.execution
        self._finish(old, Ending(EndKind.CANCELED, reason=f"preempted by {successor}"))
        self._step(new, Event.TAKE_OVER)

    def _write_take_over(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        # The executor runs already. Nothing of this attempt may be told before it is kept: the next
        # attempt would have the same number.
        self._registry.execute(run.goal)
        run.log.is_hidden = True
        if self._keeper.begin(run.goal, Event.TAKE_OVER_KEPT, self._step_later):
            self._step(run, Event.TAKE_OVER_KEPT)

    def _tell_take_over(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        self._tell(run, GoalStatus.EXECUTING)  # a cancel of it may not be kept yet
        run.log.reveal()

    # Stop

    def cancel(self, goal: GoalRecord, *, interrupt: bool) -> None:
        """Write and tell that a goal is CANCELING, and interrupt its executor if `interrupt`.

        A goal that waits ends at once.
        """
        run = self._runs[goal.goal_id]
        self._step(run, Event.CANCEL if interrupt else Event.CANCEL_GENTLY)

    def _write_cancel(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        if self._keeper.cancel(run.goal, self._step_later):
            self._step(run, Event.CANCEL_KEPT)

    def interrupt(self, goal_id: GoalID, reason: str) -> None:
        """End a goal as ABORTED for that reason: interrupt its executor if it has begun."""
        run = self._runs.get(goal_id)
        if run is not None and run.goal.phase.is_open:  # else it has ended since it was chosen
            run.goal.stop_reason = run.goal.stop_reason or reason
            self._step(run, Event.STOP)

    def end(self, goal_id: GoalID, ending: Ending) -> None:
        """End a goal that waits."""
        self._finish(self._runs[goal_id], ending)

    def lose(self, goal: GoalRecord) -> None:
        """Let go of a goal that another server has taken over, and interrupt its executor."""
        run = self._runs.get(goal.goal_id)
        if run is None or run.goal is not goal:
            goal.happen(Event.LOSE)
            return
        goal.stop_reason = goal.stop_reason or GOAL_IS_TAKEN  # its executor may look for that
        run.error = ConnectionLost(GOAL_IS_TAKEN)
        self._step(run, Event.LOSE)

    def _part(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        execution, goal = run.execution, run.goal
        if execution.phase in (ExecutorPhase.PREPARED, ExecutorPhase.GONE):
            self._leave(goal.goal_id)
        elif execution.goal is goal:  # else it runs another goal
            self.on_lost(goal.goal_id)
            self.lost.add(execution)

    def _is_fenced(self, execution: Execution[GoalT, FeedbackT, ResultT]) -> bool:
        """Interrupt an executor, and return True, if its goal may be another server's by now."""
        if self._keeper.is_valid:
            return False
        goal = execution.goal
        if goal.phase.is_open and execution.phase is not ExecutorPhase.INTERRUPTED:
            goal.stop_reason = goal.stop_reason or LEASE_IS_OVER
            self.lost.interrupt(execution)
        return True

    def _kill_late(self, execution: Execution[GoalT, FeedbackT, ResultT]) -> None:
        goal = execution.goal
        if goal.phase.is_open:
            self.kill(goal.goal_id, for_good=False)
        else:
            execution.kill(for_good=False)

    def kill(self, goal_id: GoalID, reason: str = "", *, for_good: bool) -> None:
        """Kill the executor of a goal that was interrupted, and end the goal, for that reason if it
        has no other.

        An executor that survives this is given up if `for_good`; otherwise it runs on.
        """
        run = self._runs.get(goal_id)
        if run is not None and run.goal.phase.is_open:
            run.goal.stop_reason = run.goal.stop_reason or reason
            self._finish(run, Ending(EndKind.FAILED, reason=run.goal.stop_reason), killed=True)
            run.execution.kill(for_good=for_good)

    def active(self) -> tuple[GoalID, ...]:
        """Return the goals whose end is not fixed."""
        return tuple(goal_id for goal_id, run in self._runs.items() if run.goal.phase.is_open)

    def close(self) -> None:
        """End the tasks for executors, after the last goal."""
        self._pool.close()

    def keep_for(self, reason: str) -> None:
        """Keep the goals in the store that are interrupted for this reason, and not end them."""
        self._kept_for.add(reason)

    def abandon_ends(self) -> None:
        """Let go of goals whose begin or end is being written: the store has failed."""
        for run in tuple(self._runs.values()):
            if run.goal.phase is Phase.BEGIN_IN_WRITING or not run.goal.phase.is_open:
                self._let_go(run, GoalKept(STORE_FAILED))

    def let_go(self) -> None:
        """Let go of all goals: the server has stopped before its store has answered."""
        for run in tuple(self._runs.values()):
            self._let_go(run, GoalKept(STORE_IS_LATE))

    # Finish

    def _finish(
        self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending, *, killed: bool = False
    ) -> None:
        goal = run.goal
        if self._keeper.failure is not None:
            self._let_go(run, GoalKept(STORE_FAILED))
        elif goal.stop_reason and self._is_kept(goal, ending, killed=killed):
            self._step(run, Event.RELEASE)
        else:
            if goal.status is GoalStatus.ACCEPTED:  # its table has no edge from ACCEPTED to an end
                self._registry.execute(goal)  # which is told together with the end
            if ending.kind is EndKind.CANCELED and goal.status is GoalStatus.EXECUTING:
                reason = goal.stop_reason or ending.reason or CANCELED_UNASKED
                ending = Ending(EndKind.CANCELED, ending.result, reason)
            run.outcome = self._registry.outcome_for(goal, ending)  # it never changes again
            self._step(run, END)

    def _write_end(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Write the outcome; one that is too large is replaced by the reason."""
        assert run.outcome is not None
        if self._keeper.end(run.goal, run.outcome, self._step_later, self._shorten):
            self._step(run, END_KEPT)

    def _shorten(self, goal: GoalRecord, error: RecordTooLarge) -> None:
        run = self._runs[goal.goal_id]
        run.outcome = Outcome(GoalStatus.ABORTED, None, f"the result is not kept: {error}")
        self._step(run, Event.TOO_LARGE)

    def _is_kept(self, goal: GoalRecord, ending: Ending, *, killed: bool) -> bool:
        """Return whether a goal stays in the store: it has not ended by itself."""
        return (
            goal.stop_reason in self._kept_for
            and goal.status is not GoalStatus.CANCELING
            and (killed or ending.kind is EndKind.CANCELED)
        )

    def _write_release(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        # Also one that waits: in a store that servers share, it is free for the others from now on.
        run.error = GoalKept(GOAL_IS_KEPT)
        if run.goal.stop_reason == LEASE_IS_OVER:
            run.error = ConnectionLost(LEASE_IS_OVER)
        self._keeper.release(run.goal, self._step_later)

    def _let_go(self, run: Run[GoalT, FeedbackT, ResultT], error: ConnectionLost) -> None:
        run.error = error
        self._step(run, Event.LET_GO)

    def _tell_gone(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """End the streams of a goal that does not end here, and forget it."""
        error = run.error
        assert error is not None
        del self._runs[run.goal.goal_id]
        self._registry.release(run.goal)
        if isinstance(error, GoalKept):
            self._logs.keep(run.log, error)
        else:
            self._logs.lose(run.log, error)

    def _tell_end(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        """Make the outcome the goal's, for as long as results are kept, and tell it."""
        assert run.outcome is not None
        if run.goal.told_status is not run.goal.status:
            self._tell(run, run.goal.status)
        now = current_time()
        self._registry.finish(run.goal, run.outcome, now=now, stamp=time.time_ns())
        del self._runs[run.goal.goal_id]
        self._logs.end(run.log, now)
        self._logs.tell_outcome(run.log, now)
