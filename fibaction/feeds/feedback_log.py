"""The feedback and the end of one goal, for any number of followers.

Theory of operation
-------------------

A goal has one `FeedbackLog`: the window of its feedback, its statuses, and its outcome. Each
follower has a `FeedbackCursor`: the numbers of the messages and statuses that it has taken. A
message that the log pushes out before a cursor has taken it counts there as dropped.

Nothing is copied to followers. `append`, `tell_status` and `finish` notify the cursors, and each
reader then calls `take`. It returns the statuses first, then feedback, and when no feedback is left
and the goal has ended, the outcome. Only the stream of the client that sent the goal may hold, and
so make the executor wait: see `feedback_window`.

Until the end, a log references the cursors that read feedback, and has weak references to those
that only wait for the end. So an unused stream is freed without the garbage collector.

The goal may be one of a server here or of another system: see `followed_goal`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import ref

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import GoalStream, GoalUpdate
from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.feeds.feedback_window import (
    NOTHING,
    UNLIMITED,
    UNLIMITED_TIME,
    BriefHold,
    FeedbackWindow,
    FollowedT,
    HoldTime,
    WindowReader,
    with_member,
    without_member,
)
from fibaction.feeds.followed_goal import FollowedGoal
from fibaction.words.errors import ActionError, UnknownGoal, copy_of
from fibaction.words.goals import GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus

KEPT_MESSAGE = 160
"""Bytes of memory that a message takes beside its payload. They count after the end of the goal:
there is a limit for the number of active goals, and feedback of ended ones is to stay within that
of bytes."""


class FeedbackLog(FeedbackWindow[FollowedT]):
    """A goal's feedback so far, the last `window` messages of it, and its end."""

    __slots__ = (
        "_held",
        "_others",
        "_prune_at",
        "_rest",
        "error",
        "outcome",
        "payload",
        "statuses",
    )

    def __init__(
        self,
        goal: FollowedT,
        window: int = 1,
        latest: bool = False,
        budget: ByteBudget = UNLIMITED,
        payload: bytes | None = None,
    ) -> None:
        super().__init__(goal, window, latest, budget)
        self.payload = payload
        """The payload of the goal; None if it is not kept any longer."""
        self.outcome = goal.outcome
        """The goal's outcome, which is kept here if the server forgets the goal."""
        # Tuples, because most have one item or none, and a list is twice as large.
        self.statuses: tuple[GoalStatus, ...] = ()
        """The statuses that the goal has had since its acceptance."""
        self._held = goal.held
        self._rest = 0  # the bytes that it has after the end, which `_held` counts with the outcome
        self._others: list[ref[WindowReader]] | None = None  # they wait for the end only
        self._prune_at = 0  # the number of others at which those that are gone are removed
        self.error: ActionError | None = None
        """The error with which all streams of the goal end; None if they end with its outcome."""

    def tell_status(self) -> None:
        """Record the goal's new status, and notify the followers."""
        self.statuses += (self.goal.told_status,)
        for cursor in tuple(self._readers):
            cursor.news.notify()

    def __del__(self) -> None:
        if self._rest and self._held is not None:
            self._held.resize(self._held.size - self._rest)
        elif self.outcome is None:
            self.clear()

    def discarding(self) -> FeedbackLog[FollowedT]:
        """Return a log that keeps nothing, for feedback that comes after the end of the goal."""
        return _DiscardingLog(self.goal)

    def finish(self) -> None:
        """Notify all followers: the goal has its outcome. The log references none from now on."""
        self.outcome = self.goal.outcome
        # Adding them up here costs less than counting them at each feedback.
        for item in self._items:
            self._rest += len(item.payload)
        self._budget.used -= self._rest
        self._rest += KEPT_MESSAGE * len(self._items)
        if self.payload is not None:  # until now it has counted among the bytes of active goals
            self._rest += len(self.payload)
        if self._rest and self._held is not None:
            self._held.resize(self._held.size + self._rest)
        for cursor in self._followers():
            cursor.news.notify()

    def fail(self, error: ActionError) -> None:
        """End all streams of the goal with an error, and those that are asked for later: its end is
        not told here.
        """
        self.error = error
        for cursor in self._followers():
            cursor.fail(error)

    def lose_payload(self) -> None:
        """Let go of the payload of a goal that has ended: followers have it by now, and the result
        and the feedback are for them.
        """
        if self.payload is not None and self._held is not None:
            size, self.payload = len(self.payload), None
            self._rest -= size
            self._held.resize(self._held.size - size)

    def lose_result(self) -> None:
        """Let go of the outcome and of the feedback of a goal that has ended: the server holds too
        many bytes. Streams that have not delivered the outcome raise `UnknownGoal`.
        """
        self.error = UnknownGoal(self.goal.goal_id)
        if self._held is not None:
            self._held.resize(self._held.size - self._rest)
        self.outcome = self._held = self.payload = None
        self._items = NOTHING

    def _followers(self) -> Sequence[WindowReader]:
        """Return all followers, which the log references no longer."""
        readers, self._readers = tuple(self._readers), ()
        others, self._others = self._others, None
        if self._holders:
            self._holders = ()
            self.make_room()
        if others is None:
            return readers
        return [*readers, *(left for other in others if (left := other()) is not None)]

    def follow(
        self,
        *,
        feedback: bool = True,
        own: bool = False,
        after: int | None = None,
        attempt: int | None = None,
    ) -> FeedbackCursor:
        """Return a new cursor, at the end of the log or after the feedback of number `after`, or
        at its beginning if that is a number of another attempt.

        Only an `own` cursor may make the executor wait.

        Raises:
            ActionError: The streams of the goal have ended with this error: see `fail`.
        """
        if self.error is not None:
            raise copy_of(self.error)
        if after is None:
            start = self.goal.feedback_count
        elif attempt is not None and attempt != self.goal.attempt:
            start = 0
        else:
            start = min(max(after, 0), self.goal.feedback_count)
        hold = own and feedback and not self.latest and self.outcome is None
        # Without names, which Python would first collect in a dict.
        cursor = FeedbackCursor(self, start, feedback, own, hold)
        if feedback and self.outcome is None:
            self._readers = with_member(self._readers, cursor)
            self.set_holding(cursor)
        else:
            self._remember(cursor)
        return cursor

    def leave(self, cursor: WindowReader) -> None:
        """Deliver only the outcome to the cursor from now on."""
        if cursor in self._readers:
            self._readers = without_member(self._readers, cursor)
            self._remember(cursor)
            self.set_holding(cursor)

    def _remember(self, cursor: WindowReader) -> None:
        """Notify the cursor of the end, as long as anything else references it."""
        if self.outcome is not None:
            return
        if self._others is None:
            self._others = []
        elif len(self._others) >= self._prune_at:
            self._others = [other for other in self._others if other() is not None]
            self._prune_at = 2 * len(self._others) + 1
        self._others.append(ref(cursor))


class _DiscardingLog(FeedbackLog[FollowedT]):
    """The log of an executor whose goal has ended: nothing of it is kept."""

    __slots__ = ()

    def __init__(self, goal: FollowedT) -> None:
        super().__init__(goal)
        self._held = None

    def append(self, payload: bytes) -> bool:
        return False  # nothing is kept


class FeedbackCursor(GoalStream):
    """One follower's position in a goal's log, and so the stream that it reads."""

    __slots__ = (
        "__weakref__",
        "_dropped",
        "_error",
        "_follows",
        "_log",
        "_may_hold",
        "_stalled",
        "_statuses_told",
        "_wanted",
        "checkpoint",
        "cursor",
        "goal_id",
        "hold_time",
        "holding",
        "latest",
        "news",
        "own",
        "past_goal",
        "past_held",
        "reads",
        "stamp",
    )

    def __init__(
        self, log: FeedbackLog[Any], start: int, feedback: bool, own: bool, hold: bool
    ) -> None:
        self.goal_id = log.goal.goal_id
        self.stamp = log.goal.stamp
        self.latest = log.latest
        self.own = own
        self.cursor = start
        self.reads = feedback
        self._stalled = False
        self.news = Notifier()
        self._log = log
        self._follows = feedback
        self._may_hold = hold
        self.holding = hold
        self.hold_time: HoldTime = UNLIMITED_TIME
        self._wanted = True
        self._dropped = 0
        self._statuses_told = len(log.statuses)
        self._error: ActionError | None = None
        self.checkpoint: bytes | None = None
        self.past_goal: bytes | None = None
        """The payload of the goal, where a history has it and the log does not."""
        self.past_held: CountedBytes | None = None
        """The bytes of what a store has told of the goal for this stream."""

    @property
    def status(self) -> GoalStatus:
        goal: FollowedGoal = self._log.goal
        return goal.told_status

    @property
    def attempt(self) -> int:
        goal: FollowedGoal = self._log.goal
        return goal.attempt

    @property
    def goal(self) -> bytes | None:
        return self.past_goal if self._log.payload is None else self._log.payload

    @property
    def info(self) -> GoalInfo:
        goal: FollowedGoal = self._log.goal
        return goal.info

    @property
    def dropped(self) -> int:
        return self._dropped

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        log, outcome = self._log, self._log.outcome
        error = self._error or log.error
        if error is not None:
            raise copy_of(error)
        if self.reads:
            while self._statuses_told < len(log.statuses):
                status = log.statuses[self._statuses_told]
                self._statuses_told += 1
                if status.is_active:
                    return (status,)
            items = log.after(self.cursor, limit)
            if items:
                before, self.cursor = self.cursor, items[-1].number
                if missed := self.cursor - before - len(items):
                    self._drop(missed)
                if self.holding:
                    log.note_move(before, self.cursor)
                elif self._stalled and self.cursor == log.count:
                    self._stalled = False
                    self._update()
                return items
            if limit < 1 and log.has_after(self.cursor):
                return ()
        if outcome is None:
            return ()
        if self._follows and self.cursor < log.goal.feedback_count:  # the rest is not read
            self._drop(log.count - self.cursor)
            self.seek(log.count)
        return (outcome,)

    def _drop(self, count: int) -> None:
        self._dropped += count
        self._log.note_dropped(count)

    def known_outcome(self) -> Outcome[bytes] | None:
        error = self._error or self._log.error
        if error is not None:
            raise copy_of(error)
        return self._log.outcome

    def seek(self, cursor: int) -> None:
        before, self.cursor = self.cursor, min(max(cursor, 0), self._log.count)
        if self.holding:
            self._log.note_move(before, self.cursor)

    def hold(self, wanted: bool) -> None:
        self._wanted = wanted
        self._update()

    def hold_briefly(self) -> None:
        self.hold_time = BriefHold()

    def stall(self) -> None:
        """Stop making the executor wait, until all feedback has been read."""
        self._stalled = True
        self.holding = False

    def _update(self) -> None:
        self.holding = self._may_hold and self._wanted and not self._stalled
        self._log.set_holding(self)

    def close(self) -> None:
        self.reads = False
        self._leave()

    def fail(self, error: ActionError) -> None:
        if self._log.outcome is None:
            self._error = error
        self._leave()

    def _leave(self) -> None:
        self._may_hold = self.holding = False
        self.news.notify()
        self._log.leave(self)  # also of a goal that had ended before it was followed
