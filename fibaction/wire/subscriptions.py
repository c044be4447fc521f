"""What one client has asked for and is being told: how much it wants, and what there is to tell.

It knows nothing of connections: whoever has one is told that there is something, and fetches it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from fibaction._notify import Notifier
from fibaction.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.exceptions import ActionError
from fibaction.goals import Outcome
from fibaction.states import GoalStatus
from fibaction.wire.errors import failed, failure_of, fitting, sendable
from fibaction.wire.messages import Ended, Feedback, Following, StatusChanged, encode

MOST_CREDIT = 2**31
"""Enough for every client, and small enough for every number."""
PIECE = 64
"""Feedback messages of one goal that are sent before the next goal has its turn."""

logger = logging.getLogger("fibaction.wire")


class Subscription:
    """One request, and how much more the client wants of it."""

    __slots__ = ("closed", "credit", "request")

    def __init__(self, request: int, credit: int | None = 0) -> None:
        self.request = request
        self.credit = credit or 0
        self.closed = credit is None
        """Whether nothing is wanted but the end."""

    def add(self, count: int) -> None:
        """The client wants so much more."""
        self.credit = min(self.credit + count, MOST_CREDIT)

    def close(self) -> None:
        """The client wants no more, but the end."""
        self.closed = True


class RequestSubscription(Subscription):
    """A request that a task works on."""

    __slots__ = ("_more", "_stop")

    def __init__(self, request: int, credit: int | None = 0) -> None:
        super().__init__(request, credit)
        self._stop: Callable[[], None] | None = None
        self._more = Notifier()

    def add(self, count: int) -> None:
        super().add(count)
        self._more.notify()

    def close(self) -> None:
        super().close()
        if self._stop is not None:
            self._stop()
        self._more.notify()

    def stop_with(self, stop: Callable[[], None]) -> None:
        """From now on, this is what to do when the client wants no more."""
        self._stop = stop
        if self.closed:
            stop()

    async def wait(self) -> None:
        """Wait until the client wants more, or no more at all."""
        while self.credit <= 0 and not self.closed:
            await self._more.wait()


class GoalSubscription(Subscription):
    """One goal that the client follows: no task, but `take` whenever `ready` was called."""

    __slots__ = (
        "_max_frame",
        "_opening",
        "_ready",
        "endpoint",
        "is_wanted",
        "own",
        "stream",
        "told",
    )

    def __init__(
        self,
        request: int,
        credit: int | None,
        ready: Callable[[GoalSubscription], None],
        max_frame: int,
    ) -> None:
        super().__init__(request, credit)
        self.stream: GoalStream | None = None
        self.endpoint: Endpoint | None = None
        self.own = False
        """Whether the client has sent this goal, and it is kept for it until it has the end."""
        self.told = False
        """Whether it has been told the end, or that there is none."""
        self.is_wanted = True
        """Whether the client has yet to say that it has heard, or does not wait for, the end."""
        self._ready = ready
        self._max_frame = max_frame
        self._opening = b""

    def begin(self, endpoint: Endpoint, stream: GoalStream, *, own: bool) -> None:
        """Follow the goal by this stream."""
        self.endpoint, self.stream, self.own = endpoint, stream, own
        # Now, because the statuses that the stream will give begin with this one.
        following = Following(
            self.request, stream.stamp, stream.status, stream.latest, stream.cursor
        )
        self._opening = encode(following)
        if self.closed:
            stream.close()
        self._tell()

    def add(self, count: int) -> None:
        super().add(count)
        self._tell()

    def close(self) -> None:
        super().close()
        if self.stream is not None:
            self.stream.close()
        self._tell()

    @property
    def is_observed(self) -> bool:
        """Whether it follows a goal of somebody else's."""
        return self.stream is not None and not self.own

    @property
    def has_end_to_tell(self) -> bool:
        """Whether the goal has ended, and the client has not been told."""
        return not self.told and self.stream is not None and self.stream.status.is_terminal

    def leave(self) -> None:
        """There is nothing more to tell."""
        self.told = True
        if self.stream is not None:
            self.stream.news.on_next = None

    def _tell(self) -> None:
        if self.stream is not None and not self.told:
            self._ready(self)

    def take(self) -> list[bytes]:
        """What there is to send, as far as the client wants it; nothing if there is nothing now."""
        try:
            return self._take()
        except Exception as exc:
            if not isinstance(exc, ActionError):
                # A bug of the endpoint. It concerns this client only.
                logger.error("the stream of a goal failed", exc_info=exc)
                exc = failure_of(exc)
            self._fail()
            return [failed(self.request, exc, self._max_frame)]

    def _fail(self) -> None:
        self.leave()
        self.own = False  # there is no end to keep

    def _take(self) -> list[bytes]:
        stream, request = self.stream, self.request
        assert stream is not None
        stream.news.on_next = self._tell
        if self._opening:
            opening, self._opening = self._opening, b""
            return [opening]
        frames: list[bytes] = []
        for update in stream.take(min(self.credit, PIECE)):
            if isinstance(update, FeedbackItem):
                frames.append(encode(Feedback(request, update.number, update.payload)))
            elif isinstance(update, GoalStatus):
                return [encode(StatusChanged(request, update))]
            else:
                return self._end(stream, update)
        if max(map(len, frames), default=0) > self._max_frame:
            frames = self._fitting(frames)
        self.credit -= len(frames)
        return frames

    def _fitting(self, frames: list[bytes]) -> list[bytes]:
        """Those that the client takes. It sees from the numbers that some are missing."""
        logger.warning(
            "feedback of a goal is left out: its client takes messages of %d bytes at most",
            self._max_frame,
        )
        self._tell()  # there may be more behind
        return [frame for frame in frames if len(frame) <= self._max_frame]

    def _end(self, stream: GoalStream, end: Outcome[bytes]) -> list[bytes]:
        self.leave()
        ended = Ended(self.request, end.status, end.result, sendable(end.reason), stream.cursor)
        frame = encode(ended)
        if len(frame) > self._max_frame:
            self._fail()
        return [fitting(self.request, frame, self._max_frame)]
