"""The broadcast of the statuses of one server's goals to any number of followers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from fibaction._notify import Notifier
from fibaction.abc import StatusStream
from fibaction.exceptions import ActionError, copy_of
from fibaction.goals import GoalInfo


class StatusBroadcast:
    """The status changes of all goals, and their followers."""

    def __init__(self, limit: int = 10_000) -> None:
        """Make a broadcast that keeps at most `limit` unread changes for each follower."""
        self._limit = limit
        self._streams: list[StatusSubscription] = []

    def publish(self, info: GoalInfo) -> None:
        """Send a change to all followers."""
        for stream in self._streams:
            stream.put(info)

    def follow(self, known: Iterable[GoalInfo]) -> StatusSubscription:
        """Return a new stream that begins with the known goals."""
        stream = StatusSubscription(known, self.leave, self._limit)
        self._streams.append(stream)
        return stream

    def leave(self, stream: StatusSubscription) -> None:
        """Remove the stream."""
        if stream in self._streams:
            self._streams.remove(stream)

    def finish(self) -> None:
        """End every stream after its unread changes, since the server has stopped."""
        for stream in tuple(self._streams):
            stream.close()

    def __bool__(self) -> bool:
        return bool(self._streams)


class StatusSubscription(StatusStream):
    """One follower of all statuses, of an `ActionServer` or of a server behind a transport."""

    def __init__(
        self,
        known: Iterable[GoalInfo],
        leave: Callable[[StatusSubscription], None],
        limit: int = 10_000,
    ) -> None:
        """Make a stream that begins with the `known` goals, and keeps at most `limit` unread
        changes behind them. `leave` is called when the stream is closed.
        """
        self._items = deque(known)
        self.known = len(self._items)
        self._limit = limit + self.known
        self._leave = leave
        self._open = True
        self._error: ActionError | None = None
        self._dropped = 0
        self._news = Notifier()

    @property
    def dropped(self) -> int:
        return self._dropped

    def put(self, info: GoalInfo) -> None:
        """Add a change; in a full stream it pushes out the oldest."""
        if len(self._items) >= self._limit:
            self._items.popleft()
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
            if not self._open:
                return None
            if self._error is not None:
                raise copy_of(self._error)
            await self._news.wait()
        return self._items.popleft()

    def close(self) -> None:
        self._open = False
        self._leave(self)
        self._news.notify()
