"""The broadcast of the statuses of one server's goals to any number of followers.

Theory of operation
-------------------

A follower gets a list of all goals first, and then each change of a status. Neither is copied for
it, so that thousands of followers cost little, and one that does not read costs nothing more.

The list: `StatusBroadcast.follow` is given the records of all goals, as one list that followers may
share. A `StatusCursor` makes the `GoalInfo` of a goal only when it is read, with the newest status.

The changes: the broadcast numbers them, and remembers the last `limit` of them once for all. A
cursor has the number of the change that it read last. If changes have been pushed out that it has
yet to read, it counts them as dropped. Publishing adds to the log, and wakes the cursors that wait.

A goal may change after its follower has begun, and before it is read from the list. Then the list
tells the newest status already, and the changes before it must not be told any more: they would
lead back in time. So each record has the number of its last change (`ListedGoal.changed`), and the
cursor remembers that number until it has passed it (`_listed_at`).

`StatusSubscription` is another form of such a stream, for transports that receive statuses one by
one from a server elsewhere: it has a queue of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import StatusStream
from fibaction.words.errors import ActionError, copy_of
from fibaction.words.goals import GoalID, GoalInfo


class ListedGoal(Protocol):
    """A goal of a server, as far as a list of goals needs it."""

    goal_id: GoalID
    changed: int
    """Number of the last published change of its status; 0 if no one follows the statuses."""

    @property
    def info(self) -> GoalInfo:
        """The goal as an entry of the list, with its newest status."""
        ...


class _Changes:
    """The last changes, and the number of all changes so far."""

    __slots__ = ("count", "items", "news")

    def __init__(self, count: int, limit: int) -> None:
        self.count = count
        self.items: deque[GoalInfo] = deque(maxlen=limit)
        self.news = Notifier()

    @property
    def pushed_out(self) -> int:
        """The number of the newest change that is no longer remembered."""
        return self.count - len(self.items)


class StatusBroadcast:
    """The status changes of all goals, and their followers."""

    def __init__(self, limit: int = 10_000) -> None:
        """Make a broadcast that remembers the last `limit` changes, for all followers together."""
        self._limit = limit
        self._changes = _Changes(0, limit)
        self._cursors: set[StatusCursor] = set()
        self.is_followed = False
        """True if there are streams; an attribute, since it is read at each change of a goal."""

    def publish(self, info: GoalInfo) -> int:
        """Send a change to all followers, and return its number."""
        changes = self._changes
        changes.items.append(info)
        changes.count += 1
        changes.news.notify()
        return changes.count

    def follow(self, goals: Sequence[ListedGoal]) -> StatusCursor:
        """Return a new stream that begins with these goals. The sequence must not change."""
        cursor = StatusCursor(goals, self._changes, self.leave)
        self._cursors.add(cursor)
        self.is_followed = True
        return cursor

    def leave(self, cursor: StatusCursor) -> None:
        """Remove the stream. It can still read the changes until now, as far as remembered."""
        self._cursors.discard(cursor)
        self.is_followed = bool(self._cursors)
        if not self.is_followed:  # the changes are freed, unless the stream reads on
            self._changes = _Changes(self._changes.count, self._limit)

    def finish(self) -> None:
        """End every stream after its unread changes, since the server has stopped."""
        for cursor in tuple(self._cursors):
            cursor.close()


class StatusCursor(StatusStream):
    """One follower's position in the statuses of an `ActionServer`."""

    def __init__(
        self,
        goals: Sequence[ListedGoal],
        changes: _Changes,
        leave: Callable[[StatusCursor], None],
    ) -> None:
        self.known = len(goals)
        self._goals = goals
        self._listed = 0
        self._listed_at: dict[GoalID, int] = {}
        self._changes = changes
        self._start = self._cursor = changes.count
        self._end: int | None = None
        self._leave = leave
        self._error: ActionError | None = None
        self._dropped = 0

    @property
    def dropped(self) -> int:
        return self._dropped + self._missed

    @property
    def _missed(self) -> int:
        """The number of unread changes that are no longer remembered."""
        return max(0, min(self._changes.pushed_out, self._last) - self._cursor)

    @property
    def _last(self) -> int:
        """The number of the last change for this stream."""
        return self._changes.count if self._end is None else self._end

    async def receive(self) -> GoalInfo | None:
        while (info := self._next_known() or self._next_change()) is None:
            if self._error is not None:
                raise copy_of(self._error)
            if self._end is not None:
                return None
            await self._changes.news.wait()
        return info

    def _next_known(self) -> GoalInfo | None:
        if not self._goals:
            return None
        goal = self._goals[self._listed]
        self._listed += 1
        if self._listed == self.known:
            self._goals = ()  # it may be the last reference to goals that were forgotten
        if goal.changed > self._start:
            self._listed_at[goal.goal_id] = goal.changed
        return goal.info

    def _next_change(self) -> GoalInfo | None:
        if self._cursor == (self._changes.count if self._end is None else self._end):
            self._listed_at.clear()
            return None
        missed = self._missed
        self._cursor += missed
        self._dropped += missed
        items, pushed_out = self._changes.items, self._changes.pushed_out
        while self._cursor < self._last:
            info = items[self._cursor - pushed_out]
            self._cursor += 1
            if not self._was_listed(info):
                return info
        self._listed_at.clear()
        return None

    def _was_listed(self, info: GoalInfo) -> bool:
        """Return whether the goal was listed with this status already, or with a later one."""
        listed_at = self._listed_at.get(info.goal_id, 0)
        if self._cursor == listed_at:
            del self._listed_at[info.goal_id]
        return self._cursor <= listed_at

    def fail(self, error: ActionError) -> None:
        """End the stream here: after what has arrived, the error is raised."""
        if self._end is None:
            self._error = error
        self._finish()

    def close(self) -> None:
        self._error = None
        self._finish()

    def _finish(self) -> None:
        if self._end is None:
            self._end = self._changes.count
            self._leave(self)
            self._changes.news.notify()


class StatusSubscription(StatusStream):
    """One follower of all statuses of a server behind a transport."""

    def __init__(
        self,
        known: Iterable[GoalInfo],
        leave: Callable[[StatusSubscription], None],
        limit: int = 10_000,
    ) -> None:
        """Make a stream that begins with the `known` goals, and keeps at most `limit` unread
        changes after them. `leave` is called when the stream is closed.
        """
        self._items = deque(known)
        self.known = len(self._items)
        self._limit = limit + self.known
        self._leave = leave
        self._open = True
        self._error: ActionError | None = None
        self._passed = 0
        """The items that were taken or dropped."""
        self._dropped = 0
        self._news = Notifier()

    @property
    def dropped(self) -> int:
        return self._dropped

    def put(self, info: GoalInfo) -> None:
        """Add a change; in a full stream it pushes out the oldest."""
        if len(self._items) >= self._limit:
            self._take()
            self._dropped += 1
        self._items.append(info)
        self._news.notify()

    def fail(self, error: ActionError) -> None:
        """End the stream here: after what has arrived, the error is raised."""
        self._error = error
        self._leave(self)
        self._news.notify()

    async def receive(self) -> GoalInfo | None:
        while not self._items:
            if not await self._wait():
                return None
        return self._take()

    def _take(self) -> GoalInfo:
        self._passed += 1
        return self._items.popleft()

    async def _wait(self) -> bool:
        """Wait for news; return False if the stream has ended."""
        if self._open:
            if self._error is not None:
                raise copy_of(self._error)
            await self._news.wait()
            return True
        return False

    def close(self) -> None:
        self._open = False
        self._leave(self)
        self._news.notify()
