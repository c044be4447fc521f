"""The active goals: `Runs` starts their executors, ends them, and has the streams to follow them.

Theory of operation
-------------------

Each active goal has a `Run`: its record in the registry, its `FeedbackLog` and its `Execution`.
`start` makes the run and adds it to the task pool, in which `_run` awaits the executor.

The end of a goal has three steps, in `_finish` and nowhere else. `_fix_outcome` decides the
outcome, which never changes afterwards. `_keep_outcome` makes it the goal's, and moves the goal
from the active to the ended ones. `_tell_outcome` notifies followers. All three run without a wait
between them, so no part of the program sees a goal that is half ended. A store that keeps goals
beyond the life of the process belongs into the second step: an outcome is kept before it is told.

An executor may end by itself, or because of a cancel (`cancel`), or because the server stops
(`stop`). A cancel and a stop interrupt it once. They differ in the reason, which `_fix_outcome`
takes from the goal's record. Executors that are not done within the timeout of `stop` are killed:
their goals are finished first, and the run's `outcome` then keeps `_run` from finishing them again.

A goal that has ended is followed from its log, as long as the log exists. A log is kept by its
followers (`_unread` has weak references), and, if the statuses are followed, for RECENT_TIME
(`_recent`): such a follower learns of a goal by its status, and then asks for its feedback. Without
a log, an ended goal is followed without its feedback.

One task, `_forget_expired`, frees what has expired. It sleeps until the next expiry, and while
nothing can expire, until a goal ends.
"""

from __future__ import annotations

import math
import time
from collections import deque
from functools import partial
from typing import Generic
from weakref import WeakValueDictionary

import anyio
from anyio import current_time
from anyio.abc import TaskGroup
from anyio.lowlevel import cancel_shielded_checkpoint

from fibaction._log import clean_logger
from fibaction._notify import Notifier
from fibaction._slices import Slices
from fibaction.action import Action, FeedbackT, GoalT, ResultT
from fibaction.exceptions import UnknownGoal
from fibaction.goals import GoalID, GoalInfo, Outcome, Sender
from fibaction.server._interruption import CancelOnce
from fibaction.server._task_pool import TaskPool
from fibaction.server._watchdog import Watch
from fibaction.server.executor import Execution, Executor
from fibaction.server.feedback_cursor import FeedbackCursor
from fibaction.server.feedback_log import FeedbackLog
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.goal_record import Ending, EndKind, GoalRecord
from fibaction.server.registry import GoalRegistry
from fibaction.server.status_broadcast import StatusBroadcast, StatusCursor
from fibaction.states import GoalStatus

EXPIRY_STEP = 0.1
"""The least seconds between two clean-ups of expired goals. It only limits how often memory is
freed, since the registry compares times exactly."""

RECENT_TIME, RECENT_GOALS = 1.0, 1000
"""Seconds that the feedback of a goal is kept after its end, and the number of such goals at most,
while the statuses are followed: a follower that learns of a goal asks for its feedback, and the
goal may have ended by then."""

MOST_NAMED = 10
"""Goals that are named in the log when they are killed at the end; the others are counted."""

MOST_AT_ONCE = 200
"""Goals that are forgotten in one turn of the event loop, which takes less than a millisecond."""

CANCELED_UNASKED = "the executor ended as canceled, but no cancel was requested"

logger = clean_logger("fibaction.server")


class Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: its record, its log with the followers, and its executor."""

    __slots__ = ("execution", "goal", "log", "outcome")

    def __init__(
        self, goal: GoalRecord, log: FeedbackLog, execution: Execution[GoalT, FeedbackT, ResultT]
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution
        self.outcome: Outcome[bytes] | None = None
        """The outcome once it is fixed; the goal's record has it once it is kept."""


class Runs(Generic[GoalT, FeedbackT, ResultT]):
    """All active goals of one server, and the logs of those that have ended recently."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        registry: GoalRegistry,
        *,
        window: int,
        latest: bool,
        stall_timeout: float,
        watch: Watch,
    ) -> None:
        self._action = action
        self._executor = executor
        self._registry = registry
        self._window = window
        self._latest = latest
        self._stall_timeout = stall_timeout
        self._watch = watch
        self._runs: dict[GoalID, Run[GoalT, FeedbackT, ResultT]] = {}
        self._unread: WeakValueDictionary[GoalID, FeedbackLog] = WeakValueDictionary()
        self._recent: deque[tuple[float, FeedbackLog]] = deque(maxlen=RECENT_GOALS)
        self._statuses = StatusBroadcast()
        self._ended = Notifier()
        self._pool: TaskPool

    def __len__(self) -> int:
        return len(self._runs)

    def open(self, tasks: TaskGroup) -> None:
        """Use these tasks for executors, and to forget expired goals."""
        tasks.start_soon(self._forget_expired, name=f"expiry of {self._action.name}")
        self._pool = TaskPool(tasks, f"goal of {self._action.name}")

    # Start

    def start(self, goal: GoalRecord, request: GoalT) -> FeedbackLog:
        """Run the executor of an accepted goal, and return the goal's log."""
        log = FeedbackLog(
            goal, window=self._window, latest=self._latest, budget=self._registry.budget
        )
        handle = GoalHandle(goal, request)
        execution = Execution(
            self._action, self._executor, handle, log, self._stall_timeout, self._watch
        )
        run = self._runs[goal.goal_id] = Run(goal, log, execution)
        self._tell_status(run)
        self._pool.add(partial(self._run, run), goal.sender.owner)
        return log

    async def _run(self, run: Run[GoalT, FeedbackT, ResultT], scopes: CancelOnce) -> None:
        try:
            if run.execution.handle.cancel_requested:
                ending = Ending(EndKind.CANCELED)
            else:
                self._execute(run)
                ending = await run.execution.run(scopes)
        except BaseException as exc:
            # KeyboardInterrupt or SystemExit, which end the program.
            self._finish(run, Ending(EndKind.FAILED, reason=type(exc).__name__))
            raise
        if run.outcome is None:  # else it was killed
            self._finish(run, ending)

    def _execute(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        self._registry.execute(run.goal)
        self._tell_status(run)

    # Stop

    def handle_of(self, goal: GoalRecord) -> GoalHandle[GoalT]:
        """Return the handle of an active goal."""
        return self._runs[goal.goal_id].execution.handle

    def cancel(self, goal: GoalRecord, *, interrupt: bool) -> None:
        """Tell followers that a goal is CANCELING, and interrupt its executor if `interrupt`."""
        run = self._runs[goal.goal_id]
        self._tell_status(run)
        if interrupt:
            run.execution.interrupt()

    async def stop(self, reason: str, timeout: float) -> None:
        """Interrupt all executors for that reason, and wait until they have ended; kill those whose
        clean-up has not ended within `timeout` seconds.
        """
        try:
            slices = Slices()
            for run in tuple(self._runs.values()):
                run.goal.stop_reason = reason
                run.execution.interrupt()
                await slices.pause()
            with anyio.move_on_after(timeout, shield=True):
                while self._runs:
                    await self._ended.wait()
        finally:
            try:
                await self._kill_all(reason, timeout)
            finally:
                self._pool.close()
                self._statuses.finish()

    async def _kill_all(self, reason: str, timeout: float) -> None:
        runs = tuple(self._runs.values())
        for run in runs[:MOST_NAMED]:
            logger.warning(
                "goal %s of action %r did not stop in time (%g s), and is killed",
                run.goal.goal_id,
                self._action.name,
                timeout,
            )
        if len(runs) > MOST_NAMED:
            more = len(runs) - MOST_NAMED
            logger.warning(
                "%d more goals of action %r did not stop in time either", more, self._action.name
            )
        slices = Slices()
        try:
            for run in runs:
                self._kill(run, reason)
                await slices.pause()
        finally:
            for run in tuple(self._runs.values()):  # asyncio itself canceled the task in a pause
                self._kill(run, reason)

    def _kill(self, run: Run[GoalT, FeedbackT, ResultT], reason: str) -> None:
        if run.outcome is None:
            self._finish(run, Ending(EndKind.FAILED, reason=reason))
            run.execution.kill()

    # Finish

    def _finish(self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        now = current_time()
        self._fix_outcome(run, ending)
        self._keep_outcome(run, now)
        self._tell_outcome(run, now)

    def _fix_outcome(self, run: Run[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        """Decide the outcome, which never changes afterwards."""
        goal = run.goal
        if goal.status is GoalStatus.ACCEPTED:
            self._execute(run)  # the table has no edge from ACCEPTED to an end
        if ending.kind is EndKind.CANCELED and goal.status is GoalStatus.EXECUTING:
            reason = goal.stop_reason or ending.reason or CANCELED_UNASKED
            ending = Ending(EndKind.CANCELED, ending.result, reason)
        run.outcome = self._registry.outcome_for(goal, ending)

    def _keep_outcome(self, run: Run[GoalT, FeedbackT, ResultT], now: float) -> None:
        """Make the outcome the goal's, for as long as results are kept."""
        assert run.outcome is not None
        self._registry.finish(run.goal, run.outcome, now=now, stamp=time.time_ns())
        del self._runs[run.goal.goal_id]
        if self._statuses:
            self._recent.append((now + RECENT_TIME, run.log))
        if self._statuses or run.log.is_followed:
            self._unread[run.goal.goal_id] = run.log

    def _tell_outcome(self, run: Run[GoalT, FeedbackT, ResultT], now: float) -> None:
        """Notify the followers of the goal, and of the statuses."""
        self._tell_status(run)
        run.log.finish()
        self.expire(now)
        self._ended.notify()

    # Follow

    def follow_again(self, goal_id: GoalID, *, feedback: bool, sender: Sender) -> FeedbackCursor:
        """Return a stream of a goal that was accepted before, from its beginning.

        It is the sender's own if that client has sent the goal the first time, too.

        Raises:
            UnknownGoal: The goal has been forgotten.
        """
        goal = self._find(goal_id)
        own = goal.sender.owner == sender.owner
        return self._log_of(goal).follow(feedback=feedback, own=own, after=0)

    def follow(self, goal_id: GoalID, *, own: bool, after: int | None) -> FeedbackCursor:
        """Return a stream of a goal that is active or remembered: see `Endpoint.feedback`.

        Raises:
            UnknownGoal: The goal was never accepted, or has been forgotten.
        """
        return self._log_of(self._find(goal_id)).follow(own=own, after=after)

    def _find(self, goal_id: GoalID) -> GoalRecord:
        goal = self._registry.find(goal_id, now=current_time())
        if goal is None:
            raise UnknownGoal(goal_id)
        return goal

    def _log_of(self, goal: GoalRecord) -> FeedbackLog:
        goal_id = goal.goal_id
        run = self._runs.get(goal_id)
        log = self._unread.get(goal_id) if run is None else run.log
        return FeedbackLog(goal) if log is None else log  # its feedback may not be kept any longer

    async def follow_statuses(self) -> StatusCursor:
        """Return a stream of the statuses of all goals: see `Endpoint.status`."""
        await self._expire_all()
        return self._statuses.follow(self._registry.goals())

    def _tell_status(self, run: Run[GoalT, FeedbackT, ResultT]) -> None:
        run.log.tell_status()
        if self._statuses:
            run.goal.changed = self._statuses.publish(run.goal.info)

    # Forget

    async def _forget_expired(self) -> None:
        while True:
            while (next_expiry := self._next_expiry()) == math.inf:
                await self._ended.wait()
            now = current_time()
            # The feedback of a goal that ends from now on may expire before older results do.
            sooner = min(next_expiry, now + RECENT_TIME)
            await anyio.sleep_until(max(sooner, now + EXPIRY_STEP))
            await self._expire_all()

    async def _expire_all(self) -> None:
        while self.expire(current_time()):
            await cancel_shielded_checkpoint()

    def _next_expiry(self) -> float:
        recent = self._recent[0][0] if self._recent else math.inf
        return min(recent, self._registry.next_expiry)

    def expire(self, now: float) -> bool:
        """Forget goals and feedback that have expired, and tell followers of the statuses.

        Return whether there may be more of them.
        """
        is_over = self._registry.budget.is_over
        while self._recent and (is_over or self._recent[0][0] <= now):
            self._recent.popleft()
        gone = self._registry.expire(now, MOST_AT_ONCE)
        for goal_id in gone:
            if self._statuses:
                self._statuses.publish(GoalInfo(goal_id, 0, GoalStatus.UNKNOWN))
        return len(gone) == MOST_AT_ONCE
