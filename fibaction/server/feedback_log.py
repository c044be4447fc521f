"""The feedback and the end of one goal, for any number of followers.

A `FeedbackLog` numbers a goal's feedback and remembers the last of it, once for all its
followers; each follower is a `FeedbackCursor`, a position in the log. So a slow follower costs no
memory, and only the stream that sent the goal can make the executor wait. This module knows nothing
of executors or of the rules on statuses.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING
from weakref import ref

import anyio

from fibaction._notify import Notifier
from fibaction.abc import FeedbackItem, GoalStream
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from fibaction.goals import Outcome
    from fibaction.server.registry import Goal


_NOTHING: deque[FeedbackItem] = deque(maxlen=0)


class FeedbackLog:
    """A goal's feedback so far, the last `window` messages of it, and its end."""

    __slots__ = (
        "__weakref__",
        "_ended",
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

    def __init__(self, goal: Goal, *, window: int = 1, latest: bool = False) -> None:
        self.goal = goal
        self.latest = latest
        """Whether a reader who is late wants the newest only."""
        # Tuples, because most of them have one item or none, and a list is twice as large.
        self.statuses: tuple[GoalStatus, ...] = ()
        """The statuses that the goal has had since its acceptance."""
        self._window = window
        self._items: deque[FeedbackItem] = _NOTHING
        self._readers: tuple[FeedbackCursor, ...] = ()
        self._others: tuple[ref[FeedbackCursor], ...] = ()  # they want to know of the end only
        self._full_at: float = math.inf
        self._room: Notifier | None = None
        self._ended = Notifier()

    @property
    def count(self) -> int:
        """How many feedback messages there have been; the number of the last one."""
        return self.goal.feedback_count

    @property
    def is_followed(self) -> bool:
        """Whether anybody reads the feedback."""
        return bool(self._readers)

    def append(self, payload: bytes) -> None:
        """Add feedback. If the log is full, that pushes out the oldest."""
        number = self.goal.feedback_count = self.goal.feedback_count + 1
        if self._items is _NOTHING:  # a deque is a tenth of what a goal without feedback takes
            self._items = deque(maxlen=self._window)
        self._items.append(FeedbackItem(number, payload))
        for stream in self._readers:
            stream.news.notify()

    def tell_status(self) -> None:
        """The goal has another status."""
        self.statuses += (self.goal.status,)
        for stream in self._readers:
            stream.news.notify()

    @property
    def is_full(self) -> bool:
        """Whether more feedback would push out some that the goal's own client has yet to read."""
        return self.goal.feedback_count >= self._full_at

    async def wait_for_room(self, seconds: float) -> None:
        """Wait until the log is no longer full, for at most that long.

        A stream that was not read by then no longer holds the executor up, until it has caught up.
        """
        if self._room is None:
            self._room = Notifier()
        with anyio.move_on_after(seconds):
            while self.is_full:
                await self._room.wait()
            return
        for stream in self._readers:
            if self.count - stream.place >= self._window:
                stream.stall()

    def finish(self) -> None:
        """The goal has its outcome: wake all who wait for that, or for more feedback."""
        for stream in self._readers:
            stream.news.notify()
        for other in self._others:
            if (left := other()) is not None:
                left.news.notify()
        self._ended.notify()

    async def outcome(self) -> Outcome[bytes]:
        """Wait for the end of the goal."""
        while self.goal.outcome is None:
            await self._ended.wait()
        return self.goal.outcome

    def follow(
        self, *, feedback: bool = True, hold: bool = False, after: int | None = None
    ) -> FeedbackCursor:
        """A new stream: from now on, or from what follows the feedback of number `after`."""
        place = self.count if after is None else min(max(after, 0), self.count)
        stream = FeedbackCursor(self, place, feedback=feedback, hold=hold and not self.latest)
        if feedback:
            self._readers += (stream,)
            self.make_room()
        else:
            self._remember(stream)
        return stream

    def leave(self, stream: FeedbackCursor) -> None:
        """The stream reads no more."""
        if stream in self._readers:
            self._readers = tuple(one for one in self._readers if one is not stream)
            self._remember(stream)
            self.make_room()

    def _remember(self, stream: FeedbackCursor) -> None:
        if self.goal.outcome is None:
            alive = (other for other in self._others if other() is not None)
            self._others = (*alive, ref(stream))

    def make_room(self) -> None:
        """Something was read, or is to be waited for no longer: see how much more has room now."""
        # Here, because it is looked at after each feedback, and changes more rarely.
        places = [stream.place for stream in self._readers if stream.holding]
        self._full_at = min(places) + self._window if places else math.inf
        if self._room is not None:
            self._room.notify()

    def has_after(self, place: int) -> bool:
        """Whether there still is feedback to read from that place on."""
        return place < self.count and bool(self._items)

    def after(self, place: int, limit: int) -> list[FeedbackItem]:
        """What to read from that place on, at most so much: the feedback that there still is, or,
        if only the latest is wanted, the last.
        """
        if limit < 1 or not self.has_after(place):
            return []
        if self.latest:
            return [self._items[-1]]
        start = max(0, place - self._items[0].number + 1)
        if limit == 1:
            return [self._items[start]]
        return list(islice(self._items, start, start + limit))


class FeedbackCursor(GoalStream):
    """One follower's place in a goal's log."""

    __slots__ = (
        "__weakref__",
        "_dropped",
        "_follows",
        "_log",
        "_may_hold",
        "_reads",
        "_stalled",
        "_statuses_told",
        "_wanted",
        "goal_id",
        "holding",
        "latest",
        "news",
        "place",
        "stamp",
    )

    def __init__(self, log: FeedbackLog, place: int, *, feedback: bool, hold: bool) -> None:
        self.goal_id = log.goal.goal_id
        self.stamp = log.goal.stamp
        self.latest = log.latest
        self.place = place
        """The number of the feedback that was read last, or skipped."""
        self.holding = hold
        """Whether the executor waits for this stream."""
        self.news = Notifier()
        self._log = log
        self._follows = self._reads = feedback
        self._may_hold = hold
        self._wanted = True
        self._stalled = False
        self._dropped = 0
        self._statuses_told = len(log.statuses)

    @property
    def status(self) -> GoalStatus:
        return self._log.goal.status

    @property
    def dropped(self) -> int:
        return self._dropped

    def take(self, limit: int = 1) -> list[FeedbackItem] | GoalStatus | None:
        log = self._log
        if not self._reads:
            if log.goal.outcome is not None:
                self._skip_rest()
            return None
        while self._statuses_told < len(log.statuses):
            status = log.statuses[self._statuses_told]
            self._statuses_told += 1
            if status.is_active:
                return status
        items = log.after(self.place, limit)
        if items:
            self._took(items)
        elif log.goal.outcome is not None and not log.has_after(self.place):
            self._skip_rest()
            return None
        return items

    def _skip_rest(self) -> None:
        """What was not read is missed, if it was ever wanted."""
        if self._follows:
            self._dropped += self._log.count - self.place
            self.place = self._log.count

    def _took(self, items: list[FeedbackItem]) -> None:
        place = items[-1].number
        self._dropped += place - self.place - len(items)
        self.place = place
        if self._stalled and place == self._log.count:
            self._stalled = False
            self._update()
        self._log.make_room()

    def ended(self) -> Outcome[bytes] | None:
        return self._log.goal.outcome

    async def outcome(self) -> Outcome[bytes]:
        return await self._log.outcome()

    def rewind(self, after: int) -> None:
        self.place = min(max(after, 0), self.place)
        self._log.make_room()

    def hold(self, wanted: bool) -> None:
        self._wanted = wanted
        self._update()

    def stall(self) -> None:
        """It was not read for too long."""
        self._stalled = True
        self._update()

    def close(self) -> None:
        self._reads = False
        self.news.notify()
        self._log.leave(self)

    def _update(self) -> None:
        self.holding = self._may_hold and self._wanted and not self._stalled
        self._log.make_room()
