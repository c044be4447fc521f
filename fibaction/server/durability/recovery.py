"""`Recovery`: takes over the goals that a store has from earlier processes, or from other servers.

Theory of operation
-------------------

`claim` gets each of them, whether the store found it when it was opened, or hands it over later.
They wait in a queue, and one task, `run`, takes them over in order; a server starts when the queue
is empty (`recovered`). A goal that is lost while it waits is forgotten (`forget`).

A goal may come that is here in another way. If a client has sent it here as well, its acceptance
cannot be kept: if that is being written, it is given up, and if it is still being
decided, the goal is taken over after the decision. If its old executor has not ended yet, the goal
is known to clients, and goes on when that is gone.

A goal that has ended is remembered with its outcome. An active one is known to clients from then
on, and one of these happens:

- Its cancel was accepted: it ends as CANCELED, and is not run again.
- It is not running, because it waited for its turn, or was released by a server that has stopped:
  it runs, whatever else is set.
- It was running when its process was gone: the attempt is lost. By the rule of the server, the goal
  ends as ABORTED, or runs again, or a function decides. After too many lost attempts it ends in any
  case, because it may be the goal that kills the server.
- It is not of its type any more: it ends as ABORTED, with the reason. That is for goals that come
  later, and for a server that is told so: else the server does not start (see `readable`). A store
  that several servers share asks for the `obstacle` first, and leaves such a goal to the others.

A goal that runs again begins another attempt. `Runs` writes that before the executor starts.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Awaitable
from contextlib import suppress
from typing import TYPE_CHECKING, Generic, cast

from anyio import current_time
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.slices import Slices
from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.server.admission.admission import Admission
from fibaction.server.admission.callbacks import awaited, failures_as
from fibaction.server.durability.goal_keeper import SECOND
from fibaction.server.durability.readable import ReadableCheck
from fibaction.server.execution.runs import Runs
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.registry.goal_record import LEAST_TIME, Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalAborted, GoalKept, GoalRejected, ProtocolError
from fibaction.words.goals import GoalID
from fibaction.words.meta import NO_META
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.settings import ActionServerSettings, RecoveryFunction

RESTARTED = "the server was restarted"

logger = clean_logger("fibaction.server")


def _cause_of(stored: StoredGoal) -> str:
    """Return the reason for which an attempt was lost."""
    return f"the worker {excerpt(stored.worker)!r} was lost" if stored.worker else RESTARTED


class Recovery(Generic[GoalT, FeedbackT, ResultT]):
    """The goals that a server takes over from its store."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        registry: GoalRegistry,
        runs: Runs[GoalT, FeedbackT, ResultT],
        logs: GoalLogs,
        dispatcher: Dispatcher[GoalT],
        watchers: Watchers,
        admission: Admission[GoalT, FeedbackT, ResultT],
        settings: ActionServerSettings[GoalT],
    ) -> None:
        self._action = action
        self._registry = registry
        self._runs = runs
        self._logs = logs
        self._dispatcher = dispatcher
        self._watchers = watchers
        self._admission = admission
        self.readable = ReadableCheck(action, runs.checkpoints, dispatcher, settings)
        self._rule = settings.recovery
        self._max_attempts = settings.max_attempts
        self._keep_for = settings.result_timeout
        self._claimed: deque[StoredGoal] = deque()
        self._news = Notifier()
        self._done = Notifier()
        self._is_taking = False
        self._is_closed = False
        self._tasks: TaskGroup

    async def check(self) -> None:
        """Check that the goals which were claimed can be read, before any is taken over.

        Raises:
            StoreError: Some cannot be read, and the server is to refuse them.
        """
        await self.readable.check(tuple(self._claimed))

    def open(self, tasks: TaskGroup) -> None:
        """Take goals over in tasks of this group."""
        self._tasks = tasks
        tasks.start_soon(self.run, name=f"recovery of {self._action.name}")

    def close(self) -> None:
        """Take over no more goals: the server stops, and they stay in the store."""
        self._is_closed = True
        self._done.notify()

    def claim(self, stored: StoredGoal) -> None:
        """Take a goal over in the next turn of the event loop."""
        self._claimed.append(stored)
        if len(self._claimed) == 1:
            self._news.notify()

    def forget(self, goal_id: GoalID) -> None:
        """Do not take over a goal that was claimed: another server has it by now."""
        if any(stored.goal_id == goal_id for stored in self._claimed):
            others = [stored for stored in self._claimed if stored.goal_id != goal_id]
            self._claimed = deque(others)

    async def recovered(self) -> None:
        """Wait until all goals that were claimed are taken over."""
        while (self._claimed or self._is_taking) and not self._is_closed:
            await self._done.wait()

    async def run(self) -> None:
        """Take over the goals that are claimed, until canceled."""
        while True:
            while self._is_closed or not self._claimed:
                self._done.notify()
                await self._news.wait()
            slices = Slices()
            while self._claimed and not self._is_closed:
                self._is_taking = True
                try:
                    await self._take(self._claimed.popleft())
                finally:
                    self._is_taking = False
                await slices.pause()

    async def _take(self, stored: StoredGoal) -> None:
        now, wall = current_time(), time.time_ns()
        if stored.status.is_terminal:
            until = now + self._time_left(stored, wall)
            self._logs.tell_found(self._registry.restore(stored, until=until))
            return
        goal_id = GoalID(stored.goal_id)
        if self._registry.is_active(goal_id):
            return  # the store has handed it over before
        self._admission.give_up(goal_id)
        if self._registry.is_undecided(goal_id):
            self._tasks.start_soon(self._take_later, stored)
            return
        deadline = math.inf
        if stored.deadline:
            deadline = now + (stored.deadline - wall) / SECOND
        goal = self._registry.restore(stored, deadline=deadline, until=now + LEAST_TIME)
        context = self._watchers.taken_over(
            stored.goal_id, stored.goal, stored.sender, stored.meta or NO_META
        )
        try:
            request = self._action.goal.decode(stored.goal)
            restored = self._runs.checkpoints.restored(stored)
        except ProtocolError as exc:
            reason = f"the stored goal does not fit the action any more: {exc}"
            nothing = cast("GoalT", None)  # no executor gets it
            self._runs.add(goal, nothing, stored.goal, context=context)
            is_canceling = goal.status is GoalStatus.CANCELING
            canceled = Ending(EndKind.CANCELED, reason=_cause_of(stored))
            self._end(goal, canceled if is_canceling else Ending(EndKind.FAILED, reason=reason))
            return
        self._runs.add(goal, request, stored.goal, context=context, restored=restored)
        await self._decide(goal, request)

    async def _take_later(self, stored: StoredGoal) -> None:
        """Take a goal over that was sent here as well, when that is decided."""
        with suppress(GoalKept):
            await self._admission.decided(GoalID(stored.goal_id))
            self.claim(stored)

    def _time_left(self, stored: StoredGoal, wall: int) -> float:
        """Return the seconds for which an outcome is still remembered."""
        age = max(0.0, (wall - stored.ended_at) / SECOND)  # the clock may have been set back
        return max(self._keep_for - age, LEAST_TIME)

    async def _decide(self, goal: GoalRecord, request: GoalT) -> None:
        """Let a goal go on, or end it."""
        stored = goal.stored
        assert stored is not None
        if goal.status is GoalStatus.CANCELING:
            self._end(goal, Ending(EndKind.CANCELED, reason=_cause_of(stored)))
            return
        if stored.is_running:
            stored.is_running = False
            stored.lost += 1
            ending = await self._ending_of(goal, stored)
            if not goal.phase.is_open:
                return  # it was canceled while the function decided
            if ending is not None:
                self._end(goal, ending)
                return
        logger.info(
            "goal %s of action %r: attempt %d", goal.goal_id, self._action.name, stored.attempt + 1
        )
        goal.attempt = stored.attempt + 1
        if goal.goal_id in self._runs.lost.executions:
            self._tasks.start_soon(self._begin_later, goal, request)
        else:
            self._begin(goal, request)

    async def _begin_later(self, goal: GoalRecord, request: GoalT) -> None:
        """Let a goal go on when the executor that it had here before is gone."""
        await self._runs.lost.left(goal.goal_id)
        if goal.phase.is_open and not self._is_closed:
            self._begin(goal, request)

    def _begin(self, goal: GoalRecord, request: GoalT) -> None:
        stored = goal.stored
        assert stored is not None
        # What has run before has had its turn, and waits anew.
        waited = 0.0 if stored.attempt else max(0.0, (time.time_ns() - stored.stamp) / SECOND)
        try:
            self._dispatcher.resume(goal.goal_id, request, goal.sender, goal.deadline, waited)
        except GoalRejected as exc:
            self._end(goal, Ending(EndKind.FAILED, reason=exc.reason))

    async def _ending_of(self, goal: GoalRecord, stored: StoredGoal) -> Ending | None:
        """Return the end of a goal whose attempt is lost; None if it is to run again."""
        if self._rule == "abort":
            return Ending(EndKind.FAILED, reason=_cause_of(stored))
        if stored.lost >= self._max_attempts:
            attempts = "1 attempt" if stored.lost == 1 else f"{stored.lost} attempts"
            reason = f"given up after {attempts}: {_cause_of(stored)}"
            return Ending(EndKind.FAILED, reason=reason)
        if isinstance(self._rule, str):
            return None
        try:
            with failures_as(GoalAborted, "recovery", self._action.name):
                return await self._ask(self._rule, goal)
        except GoalAborted as failure:
            return Ending(EndKind.FAILED, reason=failure.reason)

    async def _ask(self, rule: RecoveryFunction[GoalT], goal: GoalRecord) -> Ending | None:
        try:
            asking: object = rule(self._runs.handle_of(goal.goal_id))
            if isinstance(asking, Awaitable):
                asking = await awaited(asking)
        except GoalAborted as exc:
            return self._aborted(exc)
        if asking is not None:
            raise TypeError(f"it returned {asking!r}: return None, or raise GoalAborted")
        return None

    def _aborted(self, exc: GoalAborted) -> Ending:
        result = self._action.result
        if exc.result is None:
            return Ending(EndKind.FAILED, reason=exc.reason)
        if not result.holds(exc.result):
            raise TypeError(f"{exc.result!r} is not of the result's type")
        return Ending(EndKind.FAILED, result.encode(exc.result), exc.reason)

    def _end(self, goal: GoalRecord, ending: Ending) -> None:
        logger.info(
            "goal %s of action %r is not run again: %s",
            goal.goal_id,
            self._action.name,
            ending.reason,
        )
        self._runs.end(goal.goal_id, ending)
