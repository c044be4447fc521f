"""`Recovery`: takes over the goals that a store has from earlier processes, or from other servers.

Theory of operation
-------------------

`claim` gets each of them, whether the store found it when it was opened, or hands it over later.
They wait in a queue, and one task, `run`, takes them over in order; a server starts when the queue
is empty (`recovered`). A goal that is lost while it waits is forgotten (`forget`).

A goal may come that is here in another way. If a client has sent it here as well, its acceptance
cannot be kept: if that is being written, it is given up, and if it is still being
decided, the goal is taken over after the decision. If its old executor has not ended yet, the goal
is known to clients, and continues when that is gone.

A goal that has ended is remembered with its outcome. An active one is known to clients from then
on, and one of these happens:

- Its cancel was accepted: it ends as CANCELED, and is not run again.
- It is not running, because it waited for its turn, or was released by a server that has stopped:
  it runs, whatever else is set.
- It was running when its process was gone: the attempt is lost. By the rule of the server
  (`recovery`), the goal ends as ABORTED, which is the default, or runs again, or a function
  decides. After `max_attempts` lost attempts (3) without a new checkpoint it ends in any case,
  because it may be the goal that kills the server.
- A function is asked in a task of its own, and the server starts meanwhile. Until it has answered,
  the goal is `undecided`: it waits without a place, clients can cancel it, and a server that stops
  and keeps its goals leaves it in the store as it was, so that the next one asks again.
- It is not of its type any more: it ends as ABORTED, with the reason. That is for goals that come
  later, and for a server that is told so: else the server does not start (see `stored_goals`). A
  store that several servers share asks for the `obstacle` first, and leaves such a goal to the
  others.

A goal that runs again begins another attempt. `Runs` writes that before the executor starts. A goal
that ends as ABORTED here is given up: the store keeps it whole (see `GoalKeeper`).
"""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Generic, cast

from anyio import CapacityLimiter, current_time
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import StoredGoal
from fibaction.server.admission.admission import Admission
from fibaction.server.durability.goal_keeper import SECOND
from fibaction.server.durability.keeper import GOAL_IS_KEPT
from fibaction.server.durability.stored_goals import LostAttempts, ReadableCheck, cause_of
from fibaction.server.execution.runs import Runs
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.registry.goal_record import LEAST_TIME, Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalKept, GoalRejected, ProtocolError
from fibaction.words.goals import GoalID
from fibaction.words.meta import NO_META
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.settings import ActionServerSettings

ASKED_AT_ONCE = 16
"""Goals for which the user's function is asked at the same time."""

SUSPECT = "a suspect, which runs alone: {} attempts have ended with their process"
"""The reason that is told of an active goal, and the warning of the log."""

logger = clean_logger("fibaction.server")


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
        self._lost_attempts = LostAttempts(action, settings)
        self.readable = ReadableCheck(
            action,
            runs.keeper,
            dispatcher,
            self._lost_attempts,
            refuses=settings.unreadable == "refuse",
        )
        self._keep_for = settings.result_timeout
        self._keeps_at_stop = settings.at_stop == "keep"
        self._undecided: set[GoalRecord] = set()
        self._claimed: deque[StoredGoal] = deque()
        self._news = Notifier()
        self._done = Notifier()
        self._is_closed = False
        self._tasks: TaskGroup
        self._asked: CapacityLimiter

    async def check(self) -> None:
        """Check that the goals which were claimed can be read, before any is taken over.

        Raises:
            StoreError: Some cannot be read, and the server is to refuse them.
        """
        await self.readable.check(tuple(self._claimed))

    def open(self, tasks: TaskGroup) -> None:
        """Take goals over in tasks of this group."""
        self._tasks = tasks
        self._asked = CapacityLimiter(ASKED_AT_ONCE)
        tasks.start_soon(self.run, name=f"recovery of {self._action.name}")

    def close(self) -> None:
        """Take over no more goals: the server stops, and they stay in the store."""
        self._is_closed = True
        if self._keeps_at_stop:
            undecided = [goal.goal_id for goal in self._undecided if goal.phase.is_open]
            self._runs.release(GOAL_IS_KEPT, undecided)
        self._done.notify()

    def claim(self, stored: StoredGoal) -> None:
        """Take a goal over in the next turn of the event loop."""
        if stored.is_suspect:
            self._claimed.appendleft(stored)  # before it has its trial, no other goal may begin
        else:
            self._claimed.append(stored)
        if len(self._claimed) == 1:
            self._news.notify()

    def lose(self, goal_id: GoalID) -> None:
        """Do not take over a goal that was claimed: another server has it by now."""
        if any(stored.goal_id == goal_id for stored in self._claimed):
            others = [stored for stored in self._claimed if stored.goal_id != goal_id]
            self._claimed = deque(others)

    async def recovered(self) -> None:
        """Wait until all goals that were claimed are taken over."""
        while self._claimed and not self._is_closed:
            await self._done.wait()

    async def run(self) -> None:
        """Take over the goals that are claimed, until canceled."""
        while True:
            while self._is_closed or not self._claimed:
                self._done.notify()
                await self._news.wait()
            slices = Slices()
            while self._claimed and not self._is_closed:
                self._take(self._claimed.popleft())
                await slices.pause()

    def _take(self, stored: StoredGoal) -> None:
        now, wall = current_time(), time.time_ns()
        if stored.status.is_terminal:
            until = now + self._time_left(stored, wall)
            self._logs.tell_found(self._registry.restore(stored, until=until))
            return
        goal_id = GoalID(stored.goal_id)
        if self._registry.is_active(goal_id):
            return  # the store has handed it over before
        self._admission.lose(self._admission.writing(goal_id))
        if self._registry.is_undecided(goal_id):
            self._tasks.start_soon(self._take_later, stored)
            return
        deadline = math.inf
        if stored.deadline:
            deadline = now + (stored.deadline - wall) / SECOND
        goal = self._registry.restore(stored, deadline=deadline, until=now + LEAST_TIME)
        goal.clock = wall - time.monotonic_ns()
        context = self._watchers.taken_over(
            stored.goal_id, stored.goal, stored.sender, stored.meta or NO_META
        )
        try:
            request = self._action.goal.decode(stored.goal)
            restored = self._runs.keeper.restored(stored)
        except ProtocolError as exc:
            reason = f"the stored goal does not fit the action any more: {exc}"
            nothing = cast("GoalT", None)  # no executor gets it
            self._runs.add(goal, nothing, stored.goal, context=context)
            is_canceling = goal.status is GoalStatus.CANCELING
            canceled = Ending(EndKind.CANCELED, reason=cause_of(stored))
            self._end(goal, canceled if is_canceling else Ending(EndKind.FAILED, reason=reason))
            return
        self._runs.add(goal, request, stored.goal, context=context, restored=restored)
        self._decide(goal, request)

    async def _take_later(self, stored: StoredGoal) -> None:
        """Take a goal over that was sent here as well, when that is decided."""
        with suppress(GoalKept):
            await self._admission.decided(GoalID(stored.goal_id))
            self.claim(stored)

    def _time_left(self, stored: StoredGoal, wall: int) -> float:
        """Return the seconds for which an outcome is still remembered."""
        age = max(0.0, (wall - stored.ended_at) / SECOND)  # the clock may have been set back
        return max(self._keep_for - age, LEAST_TIME)

    def _decide(self, goal: GoalRecord, request: GoalT) -> None:
        """Let a goal continue, end it, or ask the function which of these."""
        stored = goal.stored
        assert stored is not None
        if goal.status is GoalStatus.CANCELING:
            self._end(goal, Ending(EndKind.CANCELED, reason=cause_of(stored)))
        elif not stored.is_running:
            self._go_on(goal, stored, request)
        elif reason := self._lost_attempts.reason_to_end(stored):
            self._end(goal, Ending(EndKind.FAILED, reason=reason))
        elif self._lost_attempts.asks:
            self._undecided.add(goal)
            self._tasks.start_soon(self._ask, goal, stored, request)
        else:
            self._run_again(goal, stored, request)

    async def _ask(self, goal: GoalRecord, stored: StoredGoal, request: GoalT) -> None:
        """Ask the function what becomes of a goal, and do it, unless the goal was canceled."""
        try:
            async with self._asked:
                ending = await self._answer_about(goal)
        finally:
            self._undecided.remove(goal)
        if not goal.phase.is_open or self._is_closed:
            return
        if ending is None:
            self._run_again(goal, stored, request)
        else:
            self._end(goal, ending)

    async def _answer_about(self, goal: GoalRecord) -> Ending | None:
        """Return the end of a goal as the function says; None if it is to run again, or if it was
        canceled before the function was asked.
        """
        if not goal.phase.is_open:
            return None
        return await self._lost_attempts.answer(self._runs.handle_of(goal.goal_id))

    def _run_again(self, goal: GoalRecord, stored: StoredGoal, request: GoalT) -> None:
        """Let a goal continue whose attempt was lost."""
        stored.is_running = False
        stored.lost += 1
        self._go_on(goal, stored, request)

    def _go_on(self, goal: GoalRecord, stored: StoredGoal, request: GoalT) -> None:
        """Let a goal continue, with another attempt."""
        name, stored.reason = self._action.name, ""
        if stored.is_suspect:
            goal.suspicion = stored.reason = SUSPECT.format(stored.lost)
            logger.warning("goal %s of action %r: %s", goal.goal_id, name, stored.reason)
        logger.info("goal %s of action %r: attempt %d", goal.goal_id, name, stored.attempt + 1)
        goal.attempt = stored.attempt + 1
        if goal.goal_id in self._runs.lost.executions:
            self._tasks.start_soon(self._begin_later, goal, request)
        else:
            self._begin(goal, request)

    async def _begin_later(self, goal: GoalRecord, request: GoalT) -> None:
        """Let a goal continue when the executor that it had here before is gone."""
        await self._runs.lost.left(goal.goal_id)
        if goal.phase.is_open and not self._is_closed:
            self._begin(goal, request)

    def _begin(self, goal: GoalRecord, request: GoalT) -> None:
        stored = goal.stored
        assert stored is not None
        # What has run before has had its turn, and waits again.
        waited = 0.0 if stored.attempt else max(0.0, (time.time_ns() - stored.stamp) / SECOND)
        try:
            self._dispatcher.resume(goal.goal_id, request, goal.sender, goal.deadline, waited)
        except GoalRejected as exc:
            self._end(goal, Ending(EndKind.FAILED, reason=exc.reason))

    def _end(self, goal: GoalRecord, ending: Ending) -> None:
        logger.info(
            "goal %s of action %r is not run again: %s",
            goal.goal_id,
            self._action.name,
            ending.reason,
        )
        goal.is_given_up = ending.kind is EndKind.FAILED
        self._runs.end(goal.goal_id, ending)
