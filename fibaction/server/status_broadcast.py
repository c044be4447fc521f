"""The statuses of all goals of one server, for any number of followers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from fibaction._notify import Notifier
from fibaction.abc import StatusStream
from fibaction.exceptions import ConnectionLost
from fibaction.goals import GoalInfo


class StatusBroadcast:
    """Tells every change of a goal's status to whoever follows them."""

    def __init__(self, limit: int = 10_000) -> None:
        """`limit` is how many changes are kept for a follower that does not read."""
        self._limit = limit
        self._streams: list[StatusSubscription] = []

    def publish(self, info: GoalInfo) -> None:
        """Tell a change."""
        for stream in self._streams:
            stream.put(info)

    def follow(self, known: Iterable[GoalInfo]) -> StatusSubscription:
        """A new stream, which begins with what is known by now."""
        stream = StatusSubscription(known, self.leave, self._limit)
        self._streams.append(stream)
        return stream

    def leave(self, stream: StatusSubscription) -> None:
        """The stream reads no more."""
        if stream in self._streams:
            self._streams.remove(stream)

    def finish(self) -> None:
        """No more changes are to come: every stream ends when it has been read."""
        for stream in tuple(self._streams):
            stream.close()

    def __bool__(self) -> bool:
        return bool(self._streams)


class StatusSubscription(StatusStream):
    """One follower of all statuses, wherever they come from."""

    def __init__(
        self,
        known: Iterable[GoalInfo],
        leave: Callable[[StatusSubscription], None],
        limit: int = 10_000,
    ) -> None:
        """`leave` is called when it reads no more; `limit` is how many changes are kept if they are
        not read, behind what is known by now.
        """
        self._items = deque(known)
        self.known = len(self._items)
        self._limit = limit + self.known
        self._leave = leave
        self._open = True
        self._error: ConnectionLost | None = None
        self._dropped = 0
        self._news = Notifier()

    @property
    def dropped(self) -> int:
        return self._dropped

    def put(self, info: GoalInfo) -> None:
        """Add a change; a stream that is not read loses the oldest."""
        if len(self._items) >= self._limit:
            self._items.popleft()
            self._dropped += 1
        self._items.append(info)
        self._news.notify()

    def fail(self, error: ConnectionLost) -> None:
        """Nothing more will arrive, for that reason."""
        self._error = error
        self._news.notify()

    async def receive(self) -> GoalInfo | None:
        while not self._items:
            if not self._open:
                return None
            if self._error is not None:
                raise ConnectionLost(str(self._error))
            await self._news.wait()
        return self._items.popleft()

    def close(self) -> None:
        self._open = False
        self._leave(self)
        self._news.notify()
