"""Subscriptions: the credit of each request of a client, and the frames that it is sent for it.

Theory of operation
-------------------

A subscription does not know its connection. It calls `ready` when there is something to tell, and
the owner fetches `next_frames` when the line can take more: a slow line thus holds no frames that
were made too early, and its goals take turns by the piece. Each feedback message takes one credit;
statuses and the end take none, so a client that reads no feedback still hears of its goal.

A goal is told in this order: `Following` with the state from which its stream begins, then what the
stream gives, then the end or an error. Another attempt of the goal begins with a `Following` of its
own, since feedback is counted again. Feedback that does not fit the client's frames is left out,
and the client sees it from the numbers. Whatever an endpoint's stream raises ends this goal only.

When its connection is lost, a subscription stays in `HeldGoals` with what the client was told last;
the next connection takes the stream over, from which moment `news` calls the new subscription.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

from anyio import CancelScope
from msgspec.structs import astuple

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import sendable
from fibaction.border.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.wire.channel import CHUNK
from fibaction.wire.errors import failed, failure_of, fitting
from fibaction.wire.messages import (
    Ended,
    Feedback,
    FeedbackBatch,
    Follow,
    Following,
    SendGoal,
    StatusChanged,
    encode,
    parent_fields,
    told_labels,
)
from fibaction.words.errors import ActionError, GoalKept
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus

MOST_CREDIT = 2**31
"""The most credit that is counted: enough for every client."""
PIECE = 64
"""Feedback messages of one goal that are sent before the next goal has its turn, if they are small;
of large ones fewer are sent, so that they have about the size of a write."""

logger = clean_logger("fibaction.wire")


class WireSubscription:
    """One request, and its credit: the number of messages that the client still accepts."""

    __slots__ = ("closed", "credit", "request")

    def __init__(self, request: int, credit: int | None = 0) -> None:
        self.request = request
        self.credit: int = credit or 0
        self.closed = credit is None
        """True if the client wants the end only."""

    def add(self, count: int) -> None:
        """Add credit."""
        self.credit = min(self.credit + count, MOST_CREDIT)

    def close(self) -> None:
        """Send the end only, from now on."""
        self.closed = True


class RequestSubscription(WireSubscription):
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


class HeldGoals:
    """The calls by which one client follows goals over one connection, by their requests; those of
    its own goals are kept here for a while after the connection has ended.
    """

    __slots__ = ("calls", "is_lost", "wait")

    def __init__(self) -> None:
        self.calls: dict[int, GoalSubscription] = {}
        self.is_lost = False
        """True if the connection has ended."""
        self.wait = CancelScope()
        """The wait for the client after that, which ends if there is nothing left to wait for."""

    def has(self, call: GoalSubscription) -> bool:
        """Return whether the call is here, and has begun to follow its goal."""
        return call.stream is not None and self.calls.get(call.request) is call

    def forget(self, call: GoalSubscription) -> None:
        """Remove a call of a connection that has ended."""
        self.calls.pop(call.request, None)
        if not self.calls:
            self.wait.cancel()


class GoalSubscription(WireSubscription):
    """One goal that the client follows; calls `ready` when `next_frames` has something to send."""

    __slots__ = (
        "_attempt",
        "_has_omitted",
        "_is_follow",
        "_max_frame",
        "_opening",
        "_piece",
        "_place",
        "_reads_from_place",
        "_ready",
        "_takes_batches",
        "action",
        "endpoint",
        "goal_id",
        "held",
        "is_wanted",
        "own",
        "stream",
        "told",
    )

    def __init__(
        self,
        message: SendGoal | Follow,
        held: HeldGoals,
        ready: Callable[[GoalSubscription], None],
        max_frame: int,
        *,
        takes_batches: bool,
    ) -> None:
        super().__init__(message.id, message.credit)
        self.action = message.action
        self.goal_id = message.goal_id
        self.held = held
        """The calls of the same connection."""
        self.stream: GoalStream | None = None
        self.endpoint: Endpoint | None = None
        self.own = False
        """True if the client has sent this goal, which is kept for it until it has the end."""
        self.told = False
        """True if the client was told the end, or an error in place of it."""
        self.is_wanted = True
        """True if the client has not said yet that it has the end, or does not wait for it."""
        self._is_follow = isinstance(message, Follow)
        self._reads_from_place = isinstance(message, Follow) and message.after is not None
        self._ready = ready
        self._max_frame = max_frame
        self._takes_batches = takes_batches
        self._opening: Following | None = None
        self._attempt = 1
        self._piece = PIECE
        self._place = 0
        self._has_omitted = False

    def begin(self, endpoint: Endpoint, stream: GoalStream, *, own: bool) -> None:
        """Begin to follow the goal by a stream."""
        self.endpoint, self.stream, self.own = endpoint, stream, own
        # Made now, because the statuses of the stream begin with this one. It is encoded when it is
        # sent: the frames of many followers would each hold a copy of the goal.
        self._opening = self._following(stream, stream.cursor)
        if self._is_follow and not own:
            info = stream.info
            if self._reads_from_place or stream.status.is_active:  # else it wants the result only
                self._opening.goal = stream.goal
            self._opening.parent = parent_fields(info.parent)
            self._opening.labels = told_labels(info.labels)
            self._opening.checkpoint = stream.checkpoint
        if self.closed:
            self._close(stream)
        self._tell()

    def _following(self, stream: GoalStream, place: int) -> Following:
        """Return the message with the state of the goal, and the attempt that comes next."""
        attempt = self._attempt = stream.attempt
        return Following(self.request, stream.stamp, stream.status, stream.latest, place, attempt)

    def _opening_frame(self, opening: Following) -> bytes:
        """Return the frame of the first message, without what it is too large with."""
        frame = encode(opening)
        if len(frame) > self._max_frame and opening.checkpoint:
            opening.checkpoint = b""
            frame = encode(opening)
        if len(frame) > self._max_frame:
            opening.goal = None
            frame = encode(opening)
        return frame

    def add(self, count: int) -> None:
        super().add(count)
        self._tell()

    def close(self) -> None:
        if self.stream is not None and not self.closed:
            self._close(self.stream)
        super().close()
        self._tell()

    def _close(self, stream: GoalStream) -> None:
        self._place = stream.cursor  # what comes later is not wanted, so it is not counted as lost
        stream.close()

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
        if self.stream.news.on_next == self._tell:  # else another call has taken the stream over
            self.stream.news.on_next = None

    def _tell(self) -> None:
        if self.stream is not None and not self.told:
            self._ready(self)

    def next_frames(self) -> list[bytes]:
        """Return the frames to send next, as far as there is credit; empty if there are none."""
        stream = self.stream
        assert stream is not None
        try:
            stream.news.on_next = self._tell
            if self._opening is not None:
                opening, self._opening = self._opening, None
                is_large = opening.goal or opening.checkpoint
                return [self._opening_frame(opening) if is_large else encode(opening)]
            updates = stream.take(min(self.credit, self._piece))
            # The numbers of the feedback may begin again, at a gateway whose server was restarted.
            begins = self._begin_attempt(stream) if stream.attempt != self._attempt else []
            if not updates:
                return begins
            first = updates[0]
            if isinstance(first, GoalStatus):
                return [*begins, encode(StatusChanged(self.request, first))]
            if not isinstance(first, FeedbackItem):
                return [*begins, self._end(stream, first)]
            return begins + self._feedback(stream, cast("Sequence[FeedbackItem]", updates))
        except Exception as exc:
            return self._fail_with(exc)

    def _fail_with(self, exc: Exception) -> list[bytes]:
        """Return the frame that tells an error of the stream, if the client is to know it."""
        self._fail()
        if isinstance(exc, GoalKept):
            return []  # the client follows the goal again on its next connection
        if not isinstance(exc, ActionError):
            # A bug of the endpoint. It concerns this client only.
            logger.error("the stream of a goal failed", exc_info=exc)
            exc = failure_of(exc)
        return [failed(self.request, exc, self._max_frame)]

    def _fail(self) -> None:
        self.leave()
        self.own = False  # there is no end to keep

    def _feedback(self, stream: GoalStream, items: Sequence[FeedbackItem]) -> list[bytes]:
        """Return the frames of feedback that was taken, as far as it fills one write."""
        if self._takes_batches and len(items) > 1 and (batch := self._batch(items)) is not None:
            self.credit -= len(items)
            return [batch]
        frames: list[bytes] = []
        size = 0
        for item in items:
            frame = encode(Feedback(self.request, item.number, item.payload, item.at))
            frames.append(frame)
            size += len(frame)
            if size >= CHUNK and self._goes_back(stream, item.number):
                break
        # A stream that cannot go back gives large messages one at a time from now on.
        self._piece = 1 if size >= CHUNK else PIECE
        if max(map(len, frames)) > self._max_frame:
            frames = self._fitting(frames)
        self.credit -= len(frames)
        return frames

    def _batch(self, items: Sequence[FeedbackItem]) -> bytes | None:
        """Return one frame with all items; None if numbers are missing or it would be too large."""
        first = items[0].number
        if items[-1].number - first >= len(items):
            return None
        payloads = [item.payload for item in items]
        if sum(map(len, payloads)) > CHUNK:
            return None
        frame = encode(FeedbackBatch(self.request, first, payloads, [item.at for item in items]))
        return frame if len(frame) <= self._max_frame else None

    def _begin_attempt(self, stream: GoalStream) -> list[bytes]:
        """Return the frame that begins another attempt of the stream, from its first feedback."""
        self._place = 0
        return [encode(self._following(stream, 0))]

    def _goes_back(self, stream: GoalStream, number: int) -> bool:
        """Let the stream continue after that number, if it can; return whether it does."""
        stream.seek(number)
        return stream.cursor == number

    def _fitting(self, frames: list[bytes]) -> list[bytes]:
        """Return the frames that fit; the client sees from the numbers that some are missing."""
        if not self._has_omitted:
            self._has_omitted = True
            logger.warning(
                "feedback of goal %s is left out: its client takes messages of %d bytes at most",
                GoalID(self.goal_id),
                self._max_frame,
            )
        self._tell()  # there may be more after these
        return [frame for frame in frames if len(frame) <= self._max_frame]

    def _end(self, stream: GoalStream, end: Outcome[bytes]) -> bytes:
        self.leave()
        place = self._place if self.closed else stream.cursor
        status, result, reason, *more = astuple(end)
        reason = reason and sendable(reason)
        frame = encode(Ended(self.request, status, result, reason, place, *more))
        if len(frame) > self._max_frame:
            self._fail()
            frame = fitting(self.request, frame, self._max_frame)
        return frame
