"""`GoalLogs`: what followers of goals and statuses are told, and the end of what has expired.

Theory of operation
-------------------

A goal is followed from its `FeedbackLog`. The record of an active goal has it (`GoalRecord.log`).
After the end of the goal, its log, with its feedback and the payload of the goal, is kept as long
as its result (`_kept`), for a client that was away, or comes later. If the server holds too many
bytes, such logs give way before any result or anything of an active goal does, the oldest first. A
log is also kept by its followers (`HeldBytes` has a weak reference), without the payload: a client
that keeps a stream which it has read to the end is not to count as one that has not read. Without a
log, an ended goal is followed by a new one; so it has one log at a time, which loses the result if
results take too many bytes.

This carries out the effects `TELL_...`, by which clients learn of each step of a goal's life. With
the end, the record gets its outcome, and the registry remembers it.

One task, `forget_expired`, frees what has expired. It sleeps until the next expiry, and while
nothing can expire, until a goal ends.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING
from weakref import ref

import anyio
from anyio.lowlevel import cancel_shielded_checkpoint

from fibaction._runtime.notify import Notifier
from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.feeds.status_broadcast import StatusBroadcast, StatusCursor
from fibaction.server.durability.keeper import Keeper
from fibaction.server.life import Effect
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.watchers import Watchers
from fibaction.words.errors import GoalKept, UnknownGoal, copy_of
from fibaction.words.goals import GoalID, GoalInfo, Sender
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.execution.executor import AnyRun

EXPIRY_STEP = 0.1
"""The least seconds between two clean-ups of expired goals. It only limits how often memory is
freed, since the registry compares times exactly."""

FORGOTTEN_AT_ONCE = 200
"""Goals that are forgotten in one turn of the event loop, which takes less than a millisecond."""


class GoalLogs:
    """The logs of one server's goals, and the broadcast of their statuses."""

    def __init__(
        self,
        registry: GoalRegistry,
        watchers: Watchers,
        keeper: Keeper,
        now: Callable[[], float],
        *,
        window: int,
        latest: bool,
    ) -> None:
        """Remember `window` feedback messages of a goal, whose slow readers get the latest if
        `latest`. `now` is the clock of the event loop.
        """
        self._registry = registry
        registry.budget.make_room = self._make_room
        self._watchers = watchers
        self.now = now
        """The clock of the event loop."""
        self._window = window
        self._latest = latest
        self.kept: GoalKept | None = None
        """The error for goals that are not known here, once the server has let goals go that it
        keeps: a client that asks for one of them is to ask again after the next start."""
        self._kept: OrderedDict[GoalID, FeedbackLog[GoalRecord]] = OrderedDict()
        self._statuses = StatusBroadcast()
        self.ended = Notifier()
        """The notifier of the ends of goals."""
        keeper.life.carry_out(
            {
                Effect.RUN_AHEAD: self._run_ahead,
                Effect.TELL_EXECUTING: self._tell_executing,
                Effect.TELL_TAKE_OVER: self._tell_take_over,
                Effect.TELL_CANCELING: lambda run: self._tell(run, run.goal.status),
                Effect.TELL_END: self._tell_end,
                Effect.TELL_GONE: self._tell_gone,
            }
        )

    # The life of a log

    def open(self, goal: GoalRecord, payload: bytes) -> FeedbackLog[GoalRecord]:
        """Return the log of a goal that was accepted just now."""
        log = self._watchers.accepted(
            goal, self._window, self._latest, self._registry.budget, payload
        )
        goal.log = log
        log.tell_status()
        if self._statuses.is_followed:
            goal.changed = self._statuses.publish(goal.info)
        return log

    def _tell(self, run: AnyRun, status: GoalStatus) -> None:
        """Tell a status, which is kept by now, to the followers of the goal and of the statuses."""
        goal, log = run.goal, run.log
        goal.told_status = status
        log.tell_status()
        if self._statuses.is_followed:
            goal.changed = self._statuses.publish(goal.info)

    def _tell_executing(self, run: AnyRun) -> None:
        if run.goal.status is GoalStatus.ACCEPTED:  # else an earlier attempt has begun
            self._registry.execute(run.goal)
            run.goal.began_at = time.monotonic_ns() + run.goal.clock
            self._tell(run, run.goal.status)

    def _run_ahead(self, run: AnyRun) -> None:
        # The executor runs already. Nothing of this attempt may be told before it is kept: the next
        # attempt would have the same number.
        self._registry.execute(run.goal)
        run.goal.began_at = time.monotonic_ns() + run.goal.clock
        run.log.is_hidden = True

    def _tell_take_over(self, run: AnyRun) -> None:
        self._tell(run, GoalStatus.EXECUTING)  # a cancel of it may not be kept yet
        run.log.reveal()

    def _tell_end(self, run: AnyRun) -> None:
        """Make the outcome the goal's, for as long as results are kept, and tell it."""
        goal, log = run.goal, run.log
        assert run.outcome is not None
        if goal.told_status is not goal.status:
            self._tell(run, goal.status)
        now = self.now()
        self._registry.finish(goal, run.outcome, now=now)
        goal.log = None
        self._kept[goal.goal_id] = log
        assert goal.held is not None
        goal.held.log = ref(log)
        self._tell(run, goal.status)
        log.finish()
        self.expire(now)
        self.ended.notify()

    def _tell_gone(self, run: AnyRun) -> None:
        """End the streams of a goal that does not end here, and forget it: if it is kept, it is to
        be asked for again later; if it is elsewhere, it is unknown to followers of statuses.
        """
        goal, error = run.goal, run.error
        assert error is not None
        self._registry.release(goal)
        goal.log = None
        run.log.fail(error)
        if isinstance(error, GoalKept):
            self.kept = error
        else:
            self._tell_unknown(goal.goal_id)
        self._watchers.left(goal, str(error))
        self.ended.notify()

    def tell_found(self, goal: GoalRecord) -> None:
        """Notify the followers of the statuses of a goal that has ended elsewhere, and that expires
        here.
        """
        if self._statuses.is_followed:
            goal.changed = self._statuses.publish(goal.info)
        self.ended.notify()

    def _tell_unknown(self, goal_id: GoalID) -> None:
        if self._statuses.is_followed:
            self._statuses.publish(GoalInfo(goal_id, 0, GoalStatus.UNKNOWN))

    def close(self) -> None:
        """End the streams of statuses."""
        self._statuses.finish()

    # Follow

    def follow_again(self, goal_id: GoalID, *, feedback: bool, sender: Sender) -> FeedbackCursor:
        """Return a stream of a goal that was accepted before, from its beginning.

        It is the sender's own if that client has sent the goal the first time, too.

        Raises:
            UnknownGoal: The goal has been forgotten.
        """
        goal = self.find(goal_id)
        own = goal.sender.owner == sender.owner
        return self._log_of(goal).follow(feedback=feedback, own=own, after=0)

    def follow(
        self, goal_id: GoalID, *, own: bool, after: int | None, attempt: int
    ) -> FeedbackCursor:
        """Return a stream of a goal that is active or remembered: see `Endpoint.feedback`.

        Raises:
            UnknownGoal: The goal was never accepted, or has been forgotten.
        """
        return self._log_of(self.find(goal_id)).follow(own=own, after=after, attempt=attempt)

    def owner_of(self, goal_id: GoalID) -> bytes:
        """Return the owner of a goal; empty if it is unknown: see `Endpoint.owner_of`."""
        goal = self._registry.find(goal_id, now=self.now())
        return b"" if goal is None else goal.sender.owner

    def is_given_up(self, goal_id: GoalID) -> bool:
        """Return whether a goal that is remembered was given up."""
        goal = self._registry.find(goal_id, now=self.now())
        return goal is not None and goal.is_given_up and goal.outcome is not None

    def find(self, goal_id: GoalID) -> GoalRecord:
        """Return a goal that is active or remembered.

        Raises:
            UnknownGoal: The goal was never accepted, or has been forgotten.
            GoalKept: The goal is not here, and this server has let go of goals that it keeps.
        """
        goal = self._registry.find(goal_id, now=self.now())
        if goal is None:
            raise UnknownGoal(goal_id) if self.kept is None else copy_of(self.kept)
        return goal

    def _log_of(self, goal: GoalRecord) -> FeedbackLog[GoalRecord]:
        if goal.log is not None:
            return goal.log
        held = goal.held
        assert held is not None
        log = None if held.log is None else held.log()
        if log is None:  # it has given way, or the goal ended before a restart
            log = FeedbackLog(goal)
            held.log = ref(log)
        return log

    async def follow_statuses(self) -> StatusCursor:
        """Return a stream of the statuses of all goals: see `Endpoint.status`."""
        await self._expire_all()
        return self._statuses.follow(self._registry.goals())

    # Forget

    async def forget_expired(self) -> None:
        """Forget goals and feedback when they expire, until canceled."""
        while True:
            while (next_expiry := self._registry.next_expiry) == math.inf:
                await self.ended.wait()
            await anyio.sleep_until(max(next_expiry, self.now() + EXPIRY_STEP))
            await self._expire_all()

    async def _expire_all(self) -> None:
        while self.expire(self.now()):
            await cancel_shielded_checkpoint()

    def expire(self, now: float) -> bool:
        """Forget goals and feedback that have expired, and tell followers of the statuses.

        Return whether there may be more of them.
        """
        budget = self._registry.budget
        if budget.used > budget.limit:  # without a call for each goal
            self._make_room()
        gone = self._registry.expire(now, FORGOTTEN_AT_ONCE)
        for goal_id in gone:
            log = self._kept.pop(goal_id, None)
            if log is not None:
                log.lose_payload()
            self._tell_unknown(goal_id)
        return len(gone) == FORGOTTEN_AT_ONCE

    def _make_room(self) -> None:
        """Let go of the logs of ended goals, the oldest first, until the bytes are within the
        limit.
        """
        budget = self._registry.budget
        while budget.is_over and self._kept:
            self._kept.popitem(last=False)[1].lose_payload()  # and its feedback, if nobody follows
