"""Subscriptions: the credit of each request of a client, and the frames that it is sent for it.

They do not know connections: the owner is told that a subscription is ready, and fetches frames.
"""

from __future__ import annotations

from collections.abc import Callable

from fibaction._log import clean_logger
from fibaction._notify import Notifier
from fibaction.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.exceptions import ActionError
from fibaction.goals import Outcome
from fibaction.states import GoalStatus
from fibaction.wire.codec import encode
from fibaction.wire.errors import failed, failure_of, fitting, sendable
from fibaction.wire.messages import Ended, Feedback, Following, StatusChanged

MOST_CREDIT = 2**31
"""The most credit that is counted: enough for every client."""
PIECE = 64
"""Feedback messages of one goal that are sent before the next goal has its turn."""

logger = clean_logger("fibaction.wire")


class Subscription:
    """One request, and its credit: the number of messages that the client still accepts."""

    __slots__ = ("closed", "credit", "request")

    def __init__(self, request: int, credit: int | None = 0) -> None:
        self.request = request
        self.credit = credit or 0
        self.closed = credit is None
        """True if the client wants the end only."""

    def add(self, count: int) -> None:
        """Add credit."""
        self.credit = min(self.credit + count, MOST_CREDIT)

    def close(self) -> None:
        """Send the end only, from now on."""
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
        """Call `stop` when the client closes the request."""
        self._stop = stop
        if self.closed:
            stop()

    async def wait(self) -> None:
        """Wait until there is credit, or the client has closed the request."""
        while self.credit <= 0 and not self.closed:
            await self._more.wait()


class GoalSubscription(Subscription):
    """One goal that the client follows; calls `ready` when `next_frames` has something to send."""

    __slots__ = (
        "_max_frame",
        "_opening",
        "_ready",
        "endpoint",
        "goal_id",
        "is_wanted",
        "own",
        "stream",
        "told",
    )

    def __init__(
        self,
        request: int,
        goal_id: bytes,
        credit: int | None,
        ready: Callable[[GoalSubscription], None],
        max_frame: int,
    ) -> None:
        super().__init__(request, credit)
        self.goal_id = goal_id
        self.stream: GoalStream | None = None
        self.endpoint: Endpoint | None = None
        self.own = False
        """True if the client has sent this goal, which is kept for it until it has the end."""
        self.told = False
        """True if the client was told the end, or an error in place of it."""
        self.is_wanted = True
        """True if the client has not said yet that it has the end, or does not wait for it."""
        self._ready = ready
        self._max_frame = max_frame
        self._opening = b""

    def begin(self, endpoint: Endpoint, stream: GoalStream, *, own: bool) -> None:
        """Begin to follow the goal by a stream."""
        self.endpoint, self.stream, self.own = endpoint, stream, own
        # Encoded now, because the statuses of the stream begin with this one.
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
        """True if another client has sent the goal."""
        return self.stream is not None and not self.own

    @property
    def has_end_to_tell(self) -> bool:
        """True if the goal has ended, and the client was not told."""
        return not self.told and self.stream is not None and self.stream.status.is_terminal

    def leave(self) -> None:
        """Stop: there is nothing more to tell."""
        assert self.stream is not None
        self.told = True
        self.stream.news.on_next = None

    def _tell(self) -> None:
        if self.stream is not None and not self.told:
            self._ready(self)

    def next_frames(self) -> list[bytes]:
        """Return the frames to send next, as far as there is credit; empty if there are none."""
        try:
            return self._next_frames()
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

    def _next_frames(self) -> list[bytes]:
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
        """Return the frames that fit; the client sees from the numbers that some are missing."""
        logger.warning(
            "feedback of a goal is left out: its client takes messages of %d bytes at most",
            self._max_frame,
        )
        self._tell()  # there may be more after these
        return [frame for frame in frames if len(frame) <= self._max_frame]

    def _end(self, stream: GoalStream, end: Outcome[bytes]) -> list[bytes]:
        self.leave()
        ended = Ended(self.request, end.status, end.result, sendable(end.reason), stream.cursor)
        frame = encode(ended)
        if len(frame) > self._max_frame:
            self._fail()
        return [fitting(self.request, frame, self._max_frame)]
