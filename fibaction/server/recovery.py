"""`Recovery`: takes over the goals that a store has from earlier processes.

Theory of operation
-------------------

`claim` gets each of them, whether the store found it when it was opened, or hands it over later.
They wait in a queue, and one task, `run`, takes them over in order; a server starts when the queue
is empty (`recovered`).

A goal that has ended is remembered with its outcome. An active one is known to clients from then
on, and one of these happens:

- Its cancel was accepted: it ends as CANCELED, and is not run again.
- It is not running, because it waited for its turn, or was released by a server that has stopped:
  it runs, whatever else is set.
- It was running when its process was gone: the attempt is lost. By the rule of the server, the goal
  ends as ABORTED, or runs again, or a function decides. After too many lost attempts it ends in any
  case, because it may be the goal that kills the server.
- It is not of its type any more: it ends as ABORTED, with the reason.

A goal that runs again begins another attempt. `Runs` writes that before the executor starts.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, Literal, TypeAlias, cast

from anyio import current_time

from fibaction._log import clean_logger
from fibaction._notify import Notifier
from fibaction._slices import Slices
from fibaction.action import Action, FeedbackT, GoalT, ResultT
from fibaction.exceptions import GoalAborted, GoalRejected, ProtocolError, text_of
from fibaction.goal_store import StoredGoal
from fibaction.server.callbacks import awaited
from fibaction.server.checkpoints import Checkpoints
from fibaction.server.dispatcher import Dispatcher
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.goal_keeper import SECOND
from fibaction.server.goal_record import LEAST_TIME, Ending, EndKind, GoalRecord
from fibaction.server.registry import GoalRegistry
from fibaction.server.runs import Runs
from fibaction.states import GoalStatus

RecoveryFunction: TypeAlias = Callable[[GoalHandle[GoalT]], Awaitable[None] | None]
"""A sync or async function that returns None to run a goal again, and raises `GoalAborted` to end
it."""
RecoveryRule: TypeAlias = Literal["abort", "rerun"] | RecoveryFunction[GoalT]

RESTARTED = "the server was restarted"


logger = clean_logger("fibaction.server")


class Recovery(Generic[GoalT, FeedbackT, ResultT]):
    """The goals that a server takes over from its store."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        registry: GoalRegistry,
        runs: Runs[GoalT, FeedbackT, ResultT],
        dispatcher: Dispatcher[GoalT, FeedbackT, ResultT] | None,
        *,
        rule: RecoveryRule[GoalT],
        max_attempts: int,
        keep_for: float,
    ) -> None:
        """Remember outcomes for `keep_for` seconds after the end of their goals."""
        self._action = action
        self._registry = registry
        self._runs = runs
        self._dispatcher = dispatcher
        self._rule = rule
        self._max_attempts = max_attempts
        self._keep_for = keep_for
        self._checkpoints = Checkpoints(action.name, action.checkpoint)
        self._claimed: deque[StoredGoal] = deque()
        self._news = Notifier()
        self._done = Notifier()
        self._is_closed = False

    def close(self) -> None:
        """Take over no more goals: the server stops, and they stay in the store."""
        self._is_closed = True
        self._done.notify()

    def claim(self, stored: StoredGoal) -> None:
        """Take a goal over in the next turn of the event loop."""
        self._claimed.append(stored)
        if len(self._claimed) == 1:
            self._news.notify()

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
                await self._take(self._claimed[0])
                self._claimed.popleft()
                await slices.pause()

    async def _take(self, stored: StoredGoal) -> None:
        now, wall = current_time(), time.time_ns()
        if stored.status.is_terminal:
            self._registry.restore(stored, until=now + self._time_left(stored, wall))
            return
        deadline = math.inf
        if stored.deadline:
            deadline = now + (stored.deadline - wall) / SECOND
        goal = self._registry.restore(stored, deadline=deadline, until=now + LEAST_TIME)
        try:
            request = self._action.goal.decode(stored.goal)
            restored = self._checkpoints.restored(goal)
        except ProtocolError as exc:
            reason = f"the stored goal does not fit the action any more: {exc}"
            self._runs.add(goal, cast("GoalT", None), begin=False)  # nothing gets to see it
            is_canceling = goal.status is GoalStatus.CANCELING
            canceled = Ending(EndKind.CANCELED, reason=RESTARTED)
            self._end(goal, canceled if is_canceling else Ending(EndKind.FAILED, reason=reason))
            return
        self._runs.add(goal, request, begin=False, restored=restored)
        await self._decide(goal, request)

    def _time_left(self, stored: StoredGoal, wall: int) -> float:
        """Return the seconds for which an outcome is still remembered."""
        age = max(0.0, (wall - stored.ended_at) / SECOND)  # the clock may have been set back
        return max(self._keep_for - age, LEAST_TIME)

    async def _decide(self, goal: GoalRecord, request: GoalT) -> None:
        """Let a goal go on, or end it."""
        stored = goal.stored
        assert stored is not None
        if goal.status is GoalStatus.CANCELING:
            self._end(goal, Ending(EndKind.CANCELED, reason=RESTARTED))
            return
        if stored.is_running:
            stored.is_running = False
            stored.lost += 1
            ending = await self._ending_of(goal, stored)
            if goal.is_over:
                return  # it was canceled while the function decided
            if ending is not None:
                self._end(goal, ending)
                return
        logger.info(
            "goal %s of action %r: attempt %d", goal.goal_id, self._action.name, stored.attempt + 1
        )
        goal.attempt = stored.attempt + 1
        if self._dispatcher is None:
            self._runs.begin(goal.goal_id)
            return
        try:
            orders = self._dispatcher.offer_again(goal.goal_id, request, goal.sender)
        except GoalRejected as exc:
            self._end(goal, Ending(EndKind.FAILED, reason=exc.reason))
        else:
            self._dispatcher.carry_out(orders)

    async def _ending_of(self, goal: GoalRecord, stored: StoredGoal) -> Ending | None:
        """Return the end of a goal whose attempt is lost; None if it is to run again."""
        if self._rule == "abort":
            return Ending(EndKind.FAILED, reason=RESTARTED)
        if stored.lost >= self._max_attempts:
            attempts = "1 attempt" if stored.lost == 1 else f"{stored.lost} attempts"
            return Ending(EndKind.FAILED, reason=f"given up after {attempts}: {RESTARTED}")
        if isinstance(self._rule, str):
            return None
        try:
            asking: object = self._rule(self._runs.handle_of(goal.goal_id))
            if isinstance(asking, Awaitable):
                asking = await awaited(asking)
            if asking is not None:
                raise TypeError(f"it returned {asking!r}: return None, or raise GoalAborted")
        except GoalAborted as exc:
            return self._aborted(exc)
        except Exception as exc:
            return self._failed(exc)
        return None

    def _aborted(self, exc: GoalAborted) -> Ending:
        result = self._action.result
        if exc.result is None:
            return Ending(EndKind.FAILED, reason=exc.reason)
        try:
            if not result.holds(exc.result):
                raise TypeError(f"{exc.result!r} is not of the result's type")
            return Ending(EndKind.FAILED, result.encode(exc.result), exc.reason)
        except Exception as bad:  # encoding runs the user's own code, which may raise anything
            return self._failed(bad)

    def _failed(self, exc: Exception) -> Ending:
        reason = f"recovery failed: {text_of(exc)}"
        logger.error("action %r: %s", self._action.name, reason, exc_info=exc)
        return Ending(EndKind.FAILED, reason=reason)

    def _end(self, goal: GoalRecord, ending: Ending) -> None:
        logger.info(
            "goal %s of action %r is not run again: %s",
            goal.goal_id,
            self._action.name,
            ending.reason,
        )
        self._runs.end(goal.goal_id, ending)
