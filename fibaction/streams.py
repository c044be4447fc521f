"""What followers can see: the feedback and the end of one goal, and the statuses of all.

A `GoalLog` numbers a goal's feedback and remembers the last of it, once for all its followers; each
follower is a `LogStream`, a place in the log. So a slow follower costs no memory, and only the
stream that sent the goal can make the executor wait. This module knows nothing of executors or of
the rules on statuses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING

import anyio

from fibaction.abc import FeedbackItem, GoalStream, StatusStream

if TYPE_CHECKING:
    from fibaction.goals import GoalInfo, Outcome
    from fibaction.protocol import Goal
    from fibaction.states import GoalStatus


class Waking:
    """Lets any number of tasks wait for "something is new"."""

    __slots__ = ("_event",)

    def __init__(self) -> None:
        self._event: anyio.Event | None = None

    def wake(self) -> None:
        """Wake all who wait now."""
        if self._event is not None:
            self._event.set()
            self._event = None

    async def wait(self) -> None:
        """Wait for the next `wake()`."""
        if self._event is None:
            self._event = anyio.Event()
        await self._event.wait()


class GoalLog:
    """A goal's feedback so far, the last `window` messages of it, and its end."""

    __slots__ = (
        "__weakref__",
        "_ended",
        "_items",
        "_room",
        "_streams",
        "_window",
        "goal",
        "latest",
        "statuses",
    )

    def __init__(self, goal: Goal, *, window: int = 1, latest: bool = False) -> None:
        self.goal = goal
        self.latest = latest
        """Whether a reader who is late wants the newest only."""
        self.statuses: list[GoalStatus] = []
        """The statuses that the goal has had since its acceptance."""
        self._window = window
        self._items: deque[FeedbackItem] = deque(maxlen=window)
        self._streams: list[LogStream] = []
        self._room = Waking()
        self._ended = Waking()

    @property
    def count(self) -> int:
        """How many feedback messages there have been; the number of the last one."""
        return self.goal.feedback_count

    @property
    def is_followed(self) -> bool:
        """Whether anybody reads the feedback."""
        return bool(self._streams)

    def append(self, payload: bytes) -> None:
        """Add feedback. If the log is full, that pushes out the oldest."""
        number = self.goal.feedback_count = self.goal.feedback_count + 1
        self._items.append(FeedbackItem(number, payload))
        for stream in self._streams:
            stream.news.wake()

    def tell_status(self) -> None:
        """The goal has another status."""
        self.statuses.append(self.goal.status)
        for stream in self._streams:
            stream.news.wake()

    @property
    def is_full(self) -> bool:
        """Whether more feedback would push out some that the goal's own client has yet to read."""
        # A loop, because any() costs three times as much, and this is done for each feedback.
        for stream in self._streams:
            if stream.holding and self.count - stream.place >= self._window:
                return True
        return False

    async def wait_for_room(self, seconds: float) -> None:
        """Wait until the log is no longer full, for at most that long.

        A stream that was not read by then no longer holds the executor up, until it has caught up.
        """
        with anyio.move_on_after(seconds):
            while self.is_full:
                await self._room.wait()
            return
        for stream in self._streams:
            if self.count - stream.place >= self._window:
                stream.stall()

    def finish(self) -> None:
        """The goal has its outcome: wake all who wait for that, or for more feedback."""
        for stream in self._streams:
            stream.news.wake()
        self._ended.wake()

    async def outcome(self) -> Outcome[bytes]:
        """Wait for the end of the goal."""
        while self.goal.outcome is None:
            await self._ended.wait()
        return self.goal.outcome

    def follow(
        self, *, feedback: bool = True, hold: bool = False, after: int | None = None
    ) -> LogStream:
        """A new stream: from now on, or from what follows the feedback of number `after`."""
        place = self.count if after is None else min(max(after, 0), self.count)
        stream = LogStream(self, place, feedback=feedback, hold=hold and not self.latest)
        if feedback:
            self._streams.append(stream)
        return stream

    def leave(self, stream: LogStream) -> None:
        """The stream reads no more."""
        if stream in self._streams:
            self._streams.remove(stream)
            self.make_room()

    def make_room(self) -> None:
        """Something was read: whoever waits for room may look again."""
        self._room.wake()

    def all_after(self, place: int, limit: int) -> list[FeedbackItem]:
        """Like `after`, but as many as there are, up to a limit."""
        first = self.after(place)
        if first is None or limit < 1:
            return []
        start = first.number - self._items[0].number
        return list(islice(self._items, start, start + limit))

    def after(self, place: int) -> FeedbackItem | None:
        """What to read from that place on: the next feedback that there still is, or, if only the
        latest is wanted, the last.
        """
        if place >= self.count or not self._items:
            return None
        if self.latest:
            return self._items[-1]
        return self._items[max(0, place - self._items[0].number + 1)]


class LogStream(GoalStream):
    """One follower's place in a goal's log."""

    def __init__(self, log: GoalLog, place: int, *, feedback: bool, hold: bool) -> None:
        self.goal_id = log.goal.goal_id
        self.stamp = log.goal.stamp
        self.latest = log.latest
        self.place = place
        """The number of the feedback that was read last, or skipped."""
        self.holding = hold
        """Whether the executor waits for this stream."""
        self.news = Waking()
        self._log = log
        self._reads = feedback
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

    async def next_event(self, *, feedback: bool = True) -> FeedbackItem | GoalStatus | None:
        while self._reads:
            while self._statuses_told < len(self._log.statuses):
                status = self._log.statuses[self._statuses_told]
                self._statuses_told += 1
                if status.is_active:
                    return status
            if feedback and self._log.after(self.place) is not None:
                return await self.receive()
            if self._log.goal.outcome is not None:
                return await self.receive() if feedback else None
            await self.news.wait()
        return None

    def ready(self, limit: int) -> list[FeedbackItem]:
        if not self._reads or self._statuses_told < len(self._log.statuses):
            return []
        items = self._log.all_after(self.place, limit)
        if items:
            self._take(items)
        return items

    async def receive(self) -> FeedbackItem | None:
        while (item := self._log.after(self.place)) is None or not self._reads:
            if not self._reads:
                return None
            if self._log.goal.outcome is not None:
                self._dropped += self._log.count - self.place
                self.place = self._log.count
                return None
            await self.news.wait()
        self._take([item])
        return item

    def _take(self, items: list[FeedbackItem]) -> None:
        place = items[-1].number
        self._dropped += place - self.place - len(items)
        self.place = place
        if self._stalled and place == self._log.count:
            self._stalled = False
            self._update()
        self._log.make_room()

    async def outcome(self) -> Outcome[bytes]:
        return await self._log.outcome()

    def hold(self, wanted: bool) -> None:
        self._wanted = wanted
        self._update()

    def stall(self) -> None:
        """It was not read for too long."""
        self._stalled = True
        self._update()

    def close(self) -> None:
        self._reads = False
        self.news.wake()
        self._log.leave(self)

    def _update(self) -> None:
        self.holding = self._may_hold and self._wanted and not self._stalled
        if not self.holding:
            self._log.make_room()


class StatusFeed:
    """Tells every change of a goal's status to whoever follows them."""

    def __init__(self, limit: int = 10_000) -> None:
        """`limit` is how many changes are kept for a follower that does not read."""
        self._limit = limit
        self._streams: list[FeedStream] = []

    def publish(self, info: GoalInfo) -> None:
        """Tell a change."""
        for stream in self._streams:
            stream.put(info)

    def follow(self, known: Iterable[GoalInfo]) -> FeedStream:
        """A new stream, which begins with what is known by now."""
        stream = FeedStream(self, known, self._limit)
        self._streams.append(stream)
        return stream

    def leave(self, stream: FeedStream) -> None:
        """The stream reads no more."""
        if stream in self._streams:
            self._streams.remove(stream)

    def finish(self) -> None:
        """No more changes are to come: every stream ends when it has been read."""
        for stream in tuple(self._streams):
            stream.close()

    def __bool__(self) -> bool:
        return bool(self._streams)


class FeedStream(StatusStream):
    """One follower of all statuses."""

    def __init__(self, feed: StatusFeed, known: Iterable[GoalInfo], limit: int) -> None:
        self._feed = feed
        self._items = deque(known)
        self._limit = limit + len(self._items)
        self._open = True
        self._dropped = 0
        self._news = Waking()

    @property
    def dropped(self) -> int:
        return self._dropped

    def put(self, info: GoalInfo) -> None:
        """Add a change; a stream that is not read loses the oldest."""
        if len(self._items) >= self._limit:
            self._items.popleft()
            self._dropped += 1
        self._items.append(info)
        self._news.wake()

    async def receive(self) -> GoalInfo | None:
        while not self._items:
            if not self._open:
                return None
            await self._news.wait()
        return self._items.popleft()

    def close(self) -> None:
        self._open = False
        self._feed.leave(self)
        self._news.wake()
