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
feedback 1.2 times as fast (`python -m tests.benchmarks.parts`). A cursor that has not been read for
the stall timeout is stalled: it does not hold until it has caught up.

A log references the cursors that read feedback, and has weak references to those that only wait for
the end. So a stream that was closed, and is otherwise unused, is freed before its goal ends.

This module does not depend on executors, nor on the rules for statuses.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING
from weakref import ref

import anyio

from fibaction._notify import Notifier
from fibaction.abc import FeedbackItem, GoalStream, GoalUpdate
from fibaction.exceptions import ActionError, copy_of
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from fibaction.goals import Outcome
    from fibaction.server.goal_record import GoalRecord


_NOTHING: deque[FeedbackItem] = deque(maxlen=0)


class FeedbackLog:
    """A goal's feedback so far, the last `window` messages of it, and its end."""

    __slots__ = (
        "__weakref__",
        "_full_at",
        "_items",
        "_others",
        "_readers",
        "_room",
        "_window",
        "goal",
        "latest",
        "statuses",
    )

    def __init__(self, goal: GoalRecord, *, window: int = 1, latest: bool = False) -> None:
        self.goal = goal
        self.latest = latest
        """True if a slow reader gets the newest feedback only."""
        # Tuples, because most have one item or none, and a list is twice as large.
        self.statuses: tuple[GoalStatus, ...] = ()
        """The statuses that the goal has had since its acceptance."""
        self._window = window
        self._items: deque[FeedbackItem] = _NOTHING
        self._readers: tuple[FeedbackCursor, ...] = ()
        self._others: tuple[ref[FeedbackCursor], ...] = ()  # they wait for the end only
        self._full_at: float = math.inf
        self._room: Notifier | None = None

    @property
    def count(self) -> int:
        """The number of feedback messages so far, which is the number of the last one."""
        return self.goal.feedback_count

    @property
    def is_followed(self) -> bool:
        """True if any cursor reads the feedback."""
        return bool(self._readers)

    def append(self, payload: bytes) -> None:
        """Add feedback. In a full log it pushes out the oldest."""
        number = self.goal.feedback_count = self.goal.feedback_count + 1
        if self._items is _NOTHING:  # a deque is a tenth of the memory of a goal without feedback
            self._items = deque(maxlen=self._window)
        self._items.append(FeedbackItem(number, payload))
        for cursor in self._readers:
            cursor.news.notify()

    def tell_status(self) -> None:
        """Record the goal's new status, and notify the followers."""
        self.statuses += (self.goal.status,)
        for cursor in self._readers:
            cursor.news.notify()

    @property
    def is_full(self) -> bool:
        """True if more feedback would push out some that the goal's own client has yet to read."""
        return self.goal.feedback_count >= self._full_at

    async def wait_for_room(self, seconds: float) -> None:
        """Wait until the log is no longer full, for at most that long.

        A cursor that was not read by then stops making the executor wait, until it has caught up.
        """
        if self._room is None:
            self._room = Notifier()
        with anyio.move_on_after(seconds):
            while self.is_full:
                await self._room.wait()
            return
        for cursor in self._readers:
            if self.count - cursor.cursor >= self._window:
                cursor.stall()

    def finish(self) -> None:
        """Notify all followers: the goal has its outcome."""
        for cursor in self._readers:
            cursor.news.notify()
        for other in self._others:
            if (left := other()) is not None:
                left.news.notify()

    def follow(
        self, *, feedback: bool = True, hold: bool = False, after: int | None = None
    ) -> FeedbackCursor:
        """Return a new cursor, at the end of the log or behind the feedback of number `after`."""
        start = self.count if after is None else min(max(after, 0), self.count)
        cursor = FeedbackCursor(self, start, feedback=feedback, hold=hold and not self.latest)
        if feedback:
            self._readers += (cursor,)
            self.make_room()
        else:
            self._remember(cursor)
        return cursor

    def leave(self, cursor: FeedbackCursor) -> None:
        """Deliver only the outcome to the cursor from now on."""
        if cursor in self._readers:
            self._readers = tuple(one for one in self._readers if one is not cursor)
            self._remember(cursor)
            self.make_room()

    def _remember(self, cursor: FeedbackCursor) -> None:
        if self.goal.outcome is None:
            alive = (other for other in self._others if other() is not None)
            self._others = (*alive, ref(cursor))

    def make_room(self) -> None:
        """Recompute the number at which the log is full, since a cursor has moved or left."""
        starts = [cursor.cursor for cursor in self._readers if cursor.holding]
        self._full_at = min(starts) + self._window if starts else math.inf
        if self._room is not None:
            self._room.notify()

    def has_after(self, cursor: int) -> bool:
        """Return whether any feedback behind that number is remembered."""
        return cursor < self.count and bool(self._items)

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


class FeedbackCursor(GoalStream):
    """One follower's position in a goal's log."""

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
        "cursor",
        "goal_id",
        "holding",
        "latest",
        "news",
        "reads",
        "stamp",
    )

    def __init__(self, log: FeedbackLog, start: int, *, feedback: bool, hold: bool) -> None:
        self.goal_id = log.goal.goal_id
        self.stamp = log.goal.stamp
        self.latest = log.latest
        self.cursor = start
        self.reads = feedback
        self.holding = hold
        """True if the executor waits for this cursor."""
        self.news = Notifier()
        self._log = log
        self._follows = feedback
        self._may_hold = hold
        self._wanted = True
        self._stalled = False
        self._dropped = 0
        self._statuses_told = len(log.statuses)
        self._error: ActionError | None = None

    @property
    def status(self) -> GoalStatus:
        return self._log.goal.status

    @property
    def dropped(self) -> int:
        return self._dropped

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        log, outcome = self._log, self._log.goal.outcome
        if self._error is not None:
            raise copy_of(self._error)
        if self.reads:
            while self._statuses_told < len(log.statuses):
                status = log.statuses[self._statuses_told]
                self._statuses_told += 1
                if status.is_active:
                    return (status,)
            items = log.after(self.cursor, limit)
            if items:
                self._took(items)
                return items
            if log.has_after(self.cursor):
                return ()
        if outcome is None:
            return ()
        self._skip_rest()
        return (outcome,)

    def _skip_rest(self) -> None:
        """Count unread feedback as dropped, unless the stream was opened without feedback."""
        if self._follows:
            self._dropped += self._log.count - self.cursor
            self.cursor = self._log.count

    def _took(self, items: list[FeedbackItem]) -> None:
        last = items[-1].number
        self._dropped += last - self.cursor - len(items)
        self.cursor = last
        if self._stalled and last == self._log.count:
            self._stalled = False
            self._update()
        self._log.make_room()

    def known_outcome(self) -> Outcome[bytes] | None:
        outcome = self._log.goal.outcome
        if self._error is not None:
            raise copy_of(self._error)
        return outcome

    def seek(self, cursor: int) -> None:
        self.cursor = min(max(cursor, 0), self._log.count)
        self._log.make_room()

    def hold(self, wanted: bool) -> None:
        self._wanted = wanted
        self._update()

    def stall(self) -> None:
        """Stop making the executor wait, until all feedback has been read."""
        self._stalled = True
        self._update()

    def close(self) -> None:
        self.reads = False
        self.news.notify()
        self._log.leave(self)

    def fail(self, error: ActionError) -> None:
        if self._log.goal.outcome is None:
            self._error = error
        self.news.notify()
        self._log.leave(self)

    def _update(self) -> None:
        self.holding = self._may_hold and self._wanted and not self._stalled
        self._log.make_room()
