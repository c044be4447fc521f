"""The active goals: `Runs` starts their executors, interrupts them, and ends their goals.

Theory of operation
-------------------

Each active goal has a `Run`: its record in the registry, its `FeedbackLog` and its `Execution`.
`add` makes the run. `begin` adds it to the task pool, in which `_run` awaits the executor. What
happens to a goal is a step of its `Life`. The effects on executors are carried out here, those that
tell by `GoalLogs`, and those that write by the keeper.

The end of a goal has two steps. `_finish`, and nothing else, decides the outcome, which never
changes afterwards. When it is kept, `GoalLogs` makes it the goal's, and notifies followers.

A goal that is not to end here (`release`) just leaves, and its streams fail. If the server stops
and keeps its goals, or its store has failed, clients are told nothing (`GoalKept`), and come back.
If another server has the goal (`lose`), or the lease of the store is over, they are told to look
elsewhere (`ConnectionLost`). The executor of a lost goal is in `lost` until it has ended: the same
goal may come back before that, as another run.

An executor may end by itself, or because of a cancel (`cancel`), or because the server ends the
goal for a reason of its own (`interrupt`). Each interrupts it once. They differ in the
reason, which `_finish` takes from the goal's record. An executor whose clean-up takes too long
is killed: its goal is finished first, so `_run` does not find it among the active ones any more.

An executor may continue as another goal (`take_over`), whose run gets it. The first one is
finished.

The dispatcher is told of each goal whose executor is gone (`_leave`), even after a killed one has
ended at last, and for goals that end without one. From then on, the goal takes no place.

A goal that has its turn begins at once, unless it or another one is a suspect: see `suspects`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextvars import Context
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, NamedTuple

from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction.border.event_loop import Slices
from fibaction.server.durability.keeper import GOAL_IS_KEPT, GOAL_IS_TAKEN, STORE_FAILED
from fibaction.server.execution.executor import Execution, ExecutorPhase, Fence, Run, Runner
from fibaction.server.execution.executor_ends import CANCELED_UNASKED, is_kept
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.lost_executors import LEASE_IS_OVER, LostExecutors
from fibaction.server.execution.suspects import Suspects, suspects_here
from fibaction.server.execution.task_pool import TaskPool
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.life import Acts, Effect, Event, Phase
from fibaction.server.registry.goal_record import NO_PLACE, Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import ConnectionLost, GoalKept
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.feeds.feedback_log import FeedbackLog
    from fibaction.server.durability.keeper import Keeper
    from fibaction.server.scheduling.dispatcher import Dispatcher
    from fibaction.server.settings import ActionServerSettings

# Looked up for each goal: a name of this module is found faster than a member of an enum.
BEGIN, EXECUTE, END = Event.BEGIN, Event.EXECUTE, Event.END
CALLED, GONE = ExecutorPhase.CALLED, ExecutorPhase.GONE
LOST, WAITING = Phase.LOST, Phase.WAITING

logger = clean_logger("fibaction.server")


class GoalThatLeft(NamedTuple):
    """A goal that is not here any more."""

    goal: GoalRecord


class Runs(Generic[GoalT, FeedbackT, ResultT]):
    """All active goals of one server."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        runner: Runner,
        registry: GoalRegistry,
        logs: GoalLogs,
        keeper: Keeper,
        dispatcher: Dispatcher[GoalT],
        watch: Watch,
        settings: ActionServerSettings[GoalT],
    ) -> None:
        self._action = action
        self._runner = runner
        self._held: dict[GoalID, None] = {}  # those that have their turn, and begin after a pause
        self._registry = registry
        self._logs = logs
        self.keeper = keeper
        """The writes about the goals."""
        self._dispatcher = dispatcher
        self.lost = LostExecutors(
            action.name, keeper, kill_after=settings.shutdown_timeout, kill=self.kill
        )
        """The executors of goals that belong to other servers by now."""
        self._kept_for = {LEASE_IS_OVER}  # the reasons for which goals stay in the store
        self._fence: Fence | None = None
        self._stall_timeout = settings.stall_timeout
        self._watch = watch
        self._runs: dict[GoalID, Run[GoalT, FeedbackT, ResultT]] = {}
        self._pool: TaskPool
        self._tasks: TaskGroup
        self.suspects: Suspects
        """The suspects of the event loop, once the server is open."""
        self._step = keeper.life.step
        keeper.life.carry_out(self._acts())

    def open(self, tasks: TaskGroup, *, held: bool) -> None:
        """Use these tasks for executors; the store is open. If `held`, none runs before `start`."""
        self._pool = TaskPool(tasks, f"goal of {self._action.name}")
        if held:
            self._pool.hold()
        else:
            self._dispatcher.start()
        self._tasks = tasks
        self.suspects = suspects_here()
        self.suspects.join(self)
        tasks.start_soon(self.lost.run, name=f"lost goals of {self._action.name}")
        if self.keeper.has_lease:
            self._fence = self.lost.fence

    # Start

    def start(self) -> None:
        """Run the executors that were held back."""
        self._dispatcher.start()
        self._pool.start()

    def add(
        self,
        goal: GoalRecord,
        request: GoalT,
        payload: bytes,
        *,
        context: Context | None = None,
        restored: Any = None,
    ) -> FeedbackLog[GoalRecord]:
        """Add an accepted goal, which waits for `begin`, and return its log.

        Its executor gets the `request`, which the client has sent as the `payload`, and the
        checkpoint `restored`; it runs with the context variables of `context`, or of the caller.
        """
        log = self._logs.open(goal, payload)
        handle = GoalHandle(goal, request, self.keeper, self._dispatcher, restored)
        execution = Execution(
            self._action, self._runner, handle, log, self._stall_timeout, self._watch, context
        )
        execution.fence = self._fence
        self._runs[goal.goal_id] = Run(goal, log, execution)
        return log

    def begin(self, goal_id: GoalID) -> None:
        """Run the executor of a goal that waits, beginning in the next turn of the event loop, or
        after suspects.
        """
        run = self._runs.get(goal_id)
        if run is None:
            return
        run.goal.place = NO_PLACE
        if self._registry.intake.holds:
            self._held[goal_id] = None
            self._dispatcher.hold(goal_id)
            return
        if run.goal.suspicion:
            self.suspects.add(run.goal, self)
        elif not self.suspects.goals or self.suspects.may_begin(run.goal):
            self._step(run, BEGIN)
            return
        self._dispatcher.hold(goal_id)
        self._tasks.start_soon(self._begin_later, run, name=f"goal of {self._action.name} waits")

    async def follow_intake(self) -> None:
        """Begin the goals that have had their turn during a pause, if it is over; let a drain look
        again at what it waits for.
        """
        self._logs.ended.notify()
        slices = Slices()
        while self._held and not self._registry.intake.holds:
            goal_id = next(iter(self._held))
            del self._held[goal_id]
            goal = self._runs[goal_id].goal
            self.begin(goal_id)
            if goal.phase is not WAITING:  # a suspect, or a goal that waits for one, goes on later
                self._dispatcher.go_on(goal_id)
            await slices.pause()

    async def _begin_later(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        goal = run.goal

        def begin() -> None:
            if goal.phase is WAITING:
                self._step(run, BEGIN)
                self._dispatcher.go_on(goal.goal_id)

        await self.suspects.begin(goal, begin, lambda: self._runs.get(goal.goal_id) is run)

    def has_begun_others(self, goal: GoalRecord) -> bool:
        """See `suspects.Server`."""
        parent = goal.origin.parent
        exempt = (goal.goal_id, None if parent is None else parent.goal_id)
        return any(
            run.goal.phase is not WAITING and goal_id not in exempt
            for goal_id, run in self._runs.items()
        )

    def note_suspects(self) -> None:
        """See `suspects.Server`."""
        self.keeper.look_at_capacity()

    def _call(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        assert run.execution.phase < CALLED  # an executor runs once, and not after an interruption
        run.execution.phase = CALLED
        self._pool.add(partial(self._run, run), run.goal.sender.owner)

    # The effects on executors

    def _acts(self) -> Acts:
        """Return the functions that carry out the effects on executors and places."""
        return {
            Effect.CALL: self._call,
            Effect.REMOVE: self._remove,
            Effect.INTERRUPT: lambda run: run.execution.interrupt(),
            Effect.END_UNBEGUN: lambda run: self._finish(run, Ending(EndKind.CANCELED)),
            Effect.END_AND_LEAVE: lambda run: self._end(run.execution, Ending(EndKind.CANCELED)),
            Effect.LEAVE: lambda run: self._leave(run.goal.goal_id),
            Effect.STOP_LOST: self._stop_lost,
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
            # KeyboardInterrupt, which ends the program.
            self._end(execution, Ending(EndKind.FAILED, reason=type(exc).__name__))
            raise
        self._end(execution, ending)

    def _end(self, execution: Execution[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        """Finish the goal that an executor has run last, unless it was killed."""
        goal_id = execution.goal.goal_id
        execution.phase = GONE
        run = self._runs.get(goal_id)
        # The ID of a goal that was killed, or lost, may be that of another one by now.
        if run is not None and run.execution is execution and run.goal.phase.is_open:
            self._finish(run, ending)
        was_lost = execution.goal.phase is LOST and self.lost.discard(execution)
        self._leave(goal_id)
        if was_lost:
            self._logs.ended.notify()

    def _remove(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        del self._runs[run.goal.goal_id]
        if self._held:
            self._held.pop(run.goal.goal_id, None)
        if self.suspects.goals:
            self.suspects.left.notify()

    def _leave(self, goal_id: GoalID) -> None:
        # A goal that has come back has no place before its old executor is gone.
        if goal_id not in self.lost.executions:
            self._dispatcher.left(goal_id)

    # The active goals

    def __len__(self) -> int:
        return len(self._runs)

    @property
    def are_left(self) -> bool:
        """True if there are active goals, or executors of lost ones."""
        return bool(self._runs or self.lost.executions)

    @property
    def are_going_on(self) -> bool:
        """As `are_left`, but without goals that cannot begin, since the action is paused."""
        if not self._registry.intake.holds:
            return self.are_left
        return bool(self.lost.executions) or any(
            run.goal.phase is not WAITING for run in self._runs.values()
        )

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
        """Let the executor of a goal continue as its successor, which waits, and end the goal.

        Raises:
            RuntimeError: The executor has yielded the result of the goal already.
        """
        old, new = self._runs[goal_id], self._runs[successor]
        old.execution.go_on_as(new.execution.handle, new.log)
        new.execution = old.execution
        self._finish(old, Ending(EndKind.CANCELED, reason=f"preempted by {successor}"))
        self._step(new, Event.TAKE_OVER)

    # Stop

    def cancel(self, goal: GoalRecord, *, interrupt: bool) -> None:
        """Write and tell that a goal is CANCELING, and interrupt its executor if `interrupt`.

        A goal that waits ends at once.
        """
        run = self._runs[goal.goal_id]
        self._step(run, Event.CANCEL if interrupt else Event.CANCEL_GENTLY)

    def interrupt(self, goal_id: GoalID, reason: str) -> None:
        """End a goal as ABORTED for that reason: interrupt its executor if it has begun."""
        run = self._runs.get(goal_id)
        if run is not None and run.goal.phase.is_open:  # else it has ended since it was chosen
            run.goal.stop_reason = run.goal.stop_reason or reason
            run.goal.goes_on = run.goal.stop_reason in self._kept_for
            self._step(run, Event.STOP)

    def end(self, goal_id: GoalID, ending: Ending) -> None:
        """End a goal that waits."""
        self._finish(self._runs[goal_id], ending)

    def lose(self, goal: GoalRecord) -> None:
        """Let go of a goal that another server has taken over, and interrupt its executor."""
        logger.info("goal %s of action %r: another server has it", goal.goal_id, self._action.name)
        run = self._runs.get(goal.goal_id)
        if run is None or run.goal is not goal:
            self._step(GoalThatLeft(goal), Event.LOSE)
            return
        goal.stop_reason = goal.stop_reason or GOAL_IS_TAKEN  # its executor may look for that
        run.error = ConnectionLost(GOAL_IS_TAKEN)
        self._step(run, Event.LOSE)

    def _stop_lost(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        execution, goal = run.execution, run.goal
        if execution.phase in (ExecutorPhase.PREPARED, ExecutorPhase.GONE):
            self._leave(goal.goal_id)
        elif execution.goal is goal:  # else it runs another goal
            self._dispatcher.lost(goal.goal_id)
            self.lost.add(execution)

    def kill(self, goal_id: GoalID, reason: str = "", *, for_good: bool) -> None:
        """Kill the executor of a goal that was interrupted, and end the goal, for that reason if it
        has no other.

        An executor that survives this is given up if `for_good`; otherwise it keeps running.
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
        self.suspects.quit(self)
        self._pool.close()

    def keep_for(self, reason: str) -> None:
        """Keep the goals in the store that are interrupted for this reason, and not end them."""
        self._kept_for.add(reason)

    def release_unwritten(self) -> None:
        """Let go of goals whose begin or end is being written: the store has failed."""
        for run in tuple(self._runs.values()):
            if run.goal.phase is Phase.BEGIN_IN_WRITING or not run.goal.phase.is_open:
                self._release(run, GoalKept(STORE_FAILED))

    def release(self, reason: str, goals: Iterable[GoalID] | None = None) -> None:
        """Let go of these goals, or of all, for that reason: they stay in the store."""
        for goal_id in tuple(self._runs if goals is None else goals):
            self._release(self._runs[goal_id], GoalKept(reason))

    # Finish

    def _finish(
        self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending, *, killed: bool = False
    ) -> None:
        goal = run.goal
        if self.keeper.failure is not None:
            self._release(run, GoalKept(STORE_FAILED))
        elif goal.stop_reason in self._kept_for and is_kept(goal, ending, killed=killed):
            # Also one that waits: where servers share a store, it is free for the others then.
            run.error = GoalKept(GOAL_IS_KEPT)
            if goal.stop_reason == LEASE_IS_OVER:
                run.error = ConnectionLost(LEASE_IS_OVER)
            self._step(run, Event.RELEASE)
        else:
            if goal.status is GoalStatus.ACCEPTED:  # its table has no edge from ACCEPTED to an end
                self._registry.execute(goal)  # which is told together with the end
            if ending.kind is EndKind.CANCELED and goal.status is GoalStatus.EXECUTING:
                reason = goal.stop_reason or ending.reason or CANCELED_UNASKED
                ending = Ending(EndKind.CANCELED, ending.result, reason)
            # It never changes again.
            stamp = time.monotonic_ns() + goal.clock
            run.outcome = self._registry.outcome_for(goal, ending, stamp=stamp)
            self._step(run, END)

    def _release(self, run: Run[GoalT, FeedbackT, ResultT], error: ConnectionLost) -> None:
        run.error = error
        self._step(run, Event.RELEASE_UNWRITTEN)
