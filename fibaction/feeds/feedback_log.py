"""The feedback and the end of one goal, for any number of followers.

Theory of operation
-------------------

A goal has one `FeedbackLog`. It numbers the feedback (1, 2, 3 and so on), remembers the last
`window` messages once for all followers, and knows the statuses that the goal has had and its
outcome. Each follower has a `FeedbackCursor`: the number of the message that it took last, and the
number of statuses that it has taken. So a follower that does not read costs no memory. If the log
has pushed out a message that a cursor has yet to take, the cursor counts it as dropped.

Nothing is copied to followers. `append`, `tell_status` and `finish` notify the cursors, and each
reader then calls `take`. It returns the statuses first, then feedback, and when no feedback is left
and the goal has ended, the outcome.

Back-pressure: only a cursor that *holds* makes the executor wait, and only the stream of the client
that sent the goal may hold. The log is full when the slowest holding cursor is a window behind.
That position is computed when a cursor moves (`make_room`) and not at each feedback, which makes
feedback 1.2 times as fast (`python -m tests.tools.benchmarks.parts`). A cursor that has not been
read for the stall timeout is stalled: it does not hold until it has caught up.

Costs: anyone who may observe a goal may follow it thousands of times. So to follow, to take and to
leave each cost the same however many cursors there are; only a feedback costs a notification for
each. The log counts the holding cursors at the slowest position (`_standing`), and looks at all
holding ones only when the last of them has left it.

The remembered feedback counts in the server's budget of bytes. While the server is over its budget,
a log pushes out what its holding cursors have read, up to the newest message, and it is full as
soon as one of them has anything to read.

Until the end, a log references the cursors that read feedback, and has weak references to those
that only wait for the end. So a stream that was closed, and is otherwise unused, is freed before
its goal ends; afterwards, every stream is freed when nothing else references it, without the
garbage collector.

This module does not depend on executors, nor on the rules for statuses.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import TYPE_CHECKING
from weakref import ref

import anyio

from fibaction._runtime.budget import ByteBudget
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import FeedbackItem
from fibaction.feeds._members import Members, with_member, without_member
from fibaction.feeds.feedback_cursor import FeedbackCursor
from fibaction.words.errors import ActionError, copy_of
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.registry.goal_record import GoalRecord

BUDGET_STEP = 0.1
"""Seconds after which a log looks again whether the server is within its budget of bytes."""

UNLIMITED = ByteBudget(sys.maxsize)

_NOTHING: deque[FeedbackItem] = deque(maxlen=0)


class FeedbackLog:
    """A goal's feedback so far, the last `window` messages of it, and its end."""

    __slots__ = (
        "__weakref__",
        "_budget",
        "_error",
        "_held",
        "_holders",
        "_items",
        "_others",
        "_payload",
        "_prune_at",
        "_readers",
        "_room",
        "_slowest",
        "_standing",
        "_window",
        "goal",
        "is_hidden",
        "latest",
        "outcome",
        "statuses",
    )

    def __init__(
        self,
        goal: GoalRecord,
        window: int = 1,
        latest: bool = False,
        budget: ByteBudget = UNLIMITED,
        payload: bytes | None = None,
    ) -> None:
        self.goal = goal
        self._payload = payload
        self.outcome = goal.outcome
        """The goal's outcome, which is kept here if the server forgets the goal."""
        self.latest = latest
        """True if a slow reader gets the newest feedback only."""
        self.is_hidden = False
        """True if followers may not read the feedback yet: its attempt is still being written."""
        # Tuples, because most have one item or none, and a list is twice as large.
        self.statuses: tuple[GoalStatus, ...] = ()
        """The statuses that the goal has had since its acceptance."""
        self._window = window
        self._budget = budget
        self._held = goal.held
        self._items: deque[FeedbackItem] = _NOTHING
        self._readers: Members[FeedbackCursor] = ()
        self._holders: Members[FeedbackCursor] = ()
        self._slowest: float = math.inf  # the slowest position of a holding cursor
        self._standing = 0  # the number of holding cursors there
        self._others: list[ref[FeedbackCursor]] | None = None  # they wait for the end only
        self._prune_at = 0  # the number of others at which those that are gone are removed
        self._room: Notifier | None = None
        self._error: ActionError | None = None

    @property
    def count(self) -> int:
        """The number of feedback messages so far, which is the number of the last one."""
        return self.goal.feedback_count

    @property
    def payload(self) -> bytes | None:
        """The payload of the goal; None if it is not kept any longer."""
        return self._payload

    def forget_payload(self) -> None:
        """Keep the payload of the goal no longer."""
        self._payload = None

    @property
    def is_followed(self) -> bool:
        """True if any cursor reads the feedback."""
        return bool(self._readers)

    def append(self, payload: bytes) -> None:
        """Add feedback. In a full log it pushes out the oldest."""
        number = self.goal.feedback_count = self.goal.feedback_count + 1
        items: deque[FeedbackItem] = self._items
        budget = self._budget
        if items is _NOTHING:  # a deque is a tenth of the memory of a goal without feedback
            self._items = items = deque(maxlen=self._window)
        elif len(items) == self._window:
            budget.used -= len(items[0].payload)
        items.append(FeedbackItem(number, payload, self.goal.attempt))
        budget.used += len(payload)
        if budget.used > budget.limit:
            self._push_out()
        readers = self._readers
        for cursor in readers if type(readers) is tuple else tuple(readers):
            cursor.news.notify()

    def tell_status(self) -> None:
        """Record the goal's new status, and notify the followers."""
        self.statuses += (self.goal.told_status,)
        for cursor in tuple(self._readers):
            cursor.news.notify()

    @property
    def is_full(self) -> bool:
        """True if more feedback would push out some that the goal's own client has yet to read, or
        if the client has any to read while the server is over its budget.
        """
        unread = self.goal.feedback_count - self._slowest
        if unread >= self._window:
            return True
        budget = self._budget
        return budget.used > budget.limit and unread > 0

    def _push_out(self) -> None:
        """Push out old feedback that no holding cursor has to read: the budget is used up."""
        items, budget = self._items, self._budget
        while budget.is_over and len(items) > 1 and items[0].number <= self._slowest:
            budget.give_back(len(items.popleft().payload))

    def __del__(self) -> None:
        # Adding them up here costs less than counting them at each feedback.
        if self._payload is not None and self.outcome is not None:
            self._budget.used -= len(self._payload)
        for item in self._items:
            self._budget.used -= len(item.payload)

    def discarding(self) -> FeedbackLog:
        """Return a log without followers, for feedback that comes after the end of the goal."""
        from fibaction.server.registry.goal_record import GoalRecord

        goal = self.goal
        return FeedbackLog(GoalRecord(goal.goal_id, goal.digest, goal.stamp, goal.sender))

    async def wait_for_room(self, seconds: float) -> None:
        """Wait until the log is no longer full, for at most that long, and as long as its cursors
        have patience.

        A cursor that was not read by then stops making the executor wait, until it has caught up.
        """
        while True:
            slow = self._slow()
            patient = [cursor.patience for cursor in slow if cursor.patience is not None]
            began = anyio.current_time()
            if await self._has_room_within(min([seconds, *(one.left() for one in patient)])):
                for one in patient:
                    one.spend(anyio.current_time() - began)
                return
            waited = anyio.current_time() - began
            for cursor in self._slow():
                is_patient = cursor.patience is None or cursor.patience.spend(waited)
                if waited >= seconds or not is_patient:
                    cursor.stall()
                    self._holders = without_member(self._holders, cursor)
            self.make_room()
            if not self.is_full:
                return
            seconds -= waited

    def _slow(self) -> list[FeedbackCursor]:
        """Return the cursors for which the executor waits now, if the log is full."""
        least = 1 if self._budget.is_over else self._window
        return [cursor for cursor in self._holders if self.count - cursor.cursor >= least]

    async def _has_room_within(self, seconds: float) -> bool:
        if self._room is None:
            self._room = Notifier()
        with anyio.move_on_after(seconds):
            while self.is_full:
                # The budget does not tell when it has room again.
                limit = math.inf if self.count - self._slowest >= self._window else BUDGET_STEP
                with anyio.move_on_after(limit):
                    await self._room.wait()
            return True
        return False

    def finish(self) -> None:
        """Notify all followers: the goal has its outcome. The log references none from now on."""
        self.outcome = self.goal.outcome
        if self._payload is not None:  # until now it has counted among the bytes of active goals
            self._budget.used += len(self._payload)
        for cursor in self._followers():
            cursor.news.notify()

    def fail(self, error: ActionError) -> None:
        """End all streams of the goal with an error, and those that are asked for later: its end is
        not told here.
        """
        self._error = error
        for cursor in self._followers():
            cursor.fail(error)

    def _followers(self) -> Iterator[FeedbackCursor]:
        """Yield all followers, which the log references no longer."""
        readers, self._readers = tuple(self._readers), ()
        others, self._others = self._others or (), None
        if self._holders:
            self._holders = ()
            self.make_room()
        yield from readers
        for other in others:
            if (left := other()) is not None:
                yield left

    def follow(
        self,
        *,
        feedback: bool = True,
        own: bool = False,
        after: int | None = None,
        attempt: int | None = None,
    ) -> FeedbackCursor:
        """Return a new cursor, at the end of the log or behind the feedback of number `after`, or
        at its beginning if that is a number of another attempt.

        Only an `own` cursor may make the executor wait.

        Raises:
            ActionError: The streams of the goal have ended with this error: see `fail`.
        """
        if self._error is not None:
            raise copy_of(self._error)
        if after is None:
            start = self.count
        elif attempt is not None and attempt != self.goal.attempt:
            start = 0
        else:
            start = min(max(after, 0), self.count)
        hold = own and feedback and not self.latest
        # Without names, which Python would first collect in a dict.
        cursor = FeedbackCursor(self, start, feedback, own, hold)
        if feedback:
            self._readers = with_member(self._readers, cursor)
            self.set_holding(cursor)
        else:
            self._remember(cursor)
        return cursor

    def leave(self, cursor: FeedbackCursor) -> None:
        """Deliver only the outcome to the cursor from now on."""
        if cursor in self._readers:
            self._readers = without_member(self._readers, cursor)
            self._remember(cursor)
            self.set_holding(cursor)

    def _remember(self, cursor: FeedbackCursor) -> None:
        """Notify the cursor of the end, as long as anything else references it."""
        if self.outcome is not None:
            return
        if self._others is None:
            self._others = []
        elif len(self._others) >= self._prune_at:
            self._others = [other for other in self._others if other() is not None]
            self._prune_at = 2 * len(self._others) + 1
        self._others.append(ref(cursor))

    def set_holding(self, cursor: FeedbackCursor) -> None:
        """Make the executor wait for the cursor, or no longer, as the cursor now says."""
        is_holding = cursor in self._holders
        if cursor.holding is is_holding:
            return
        if is_holding:
            self._holders = without_member(self._holders, cursor)
            self._count(cursor.cursor, math.inf)
        else:
            self._holders = with_member(self._holders, cursor)
            self._count(math.inf, cursor.cursor)

    def note_move(self, before: int, after: int) -> None:
        """Note that a holding cursor has moved."""
        holders = len(self._holders)
        if holders == 1:
            self._slowest = after
            if self._room is not None:
                self._room.notify()
        elif holders:  # else the goal has ended
            self._count(before, after)

    def note_dropped(self, count: int) -> None:
        """Note that a cursor has missed feedback. Only logs with watchers tell it."""

    def _count(self, before: float, after: float) -> None:
        """Count a holding cursor at its new position; infinity is that of one without effect."""
        if after < self._slowest:
            self._slowest = after
            self._standing = 1
            return
        self._standing += (after == self._slowest) - (before == self._slowest)
        if self._standing < 1:
            self.make_room()

    def make_room(self) -> None:
        """Recompute the slowest position, since the slowest cursors have moved."""
        positions: list[float] = [cursor.cursor for cursor in self._holders]
        self._slowest = min(positions, default=math.inf)
        self._standing = positions.count(self._slowest)
        if self._room is not None:
            self._room.notify()

    def has_after(self, cursor: int) -> bool:
        """Return whether any feedback behind that number is remembered."""
        return cursor < self.count and bool(self._items) and not self.is_hidden

    def reveal(self) -> None:
        """Let followers read feedback that was hidden until now."""
        self.is_hidden = False
        for cursor in tuple(self._readers):
            cursor.news.notify()

    def after(self, cursor: int, limit: int) -> list[FeedbackItem]:
        """Return the remembered feedback behind that number, at most `limit` messages; with the
        policy `latest`, only the last message.
        """
        if limit < 1 or not self.has_after(cursor):
            return []
        if self.latest:
            return [self._items[-1]]
        start = max(0, cursor - self._items[0].number + 1)
        if limit == 1:
            return [self._items[start]]
        return list(islice(self._items, start, start + limit))
