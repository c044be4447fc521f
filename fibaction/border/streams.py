"""The streams by which goals are followed: one goal, or the statuses of all goals of a server.

They are implemented by the server (a cursor in the goal's log) and by the client half of each
transport. `fibaction.border.abc` exports them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Sequence
from time import time_ns
from types import TracebackType
from typing import Self, TypeAlias

import msgspec

from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Slices
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus


class FeedbackItem(msgspec.Struct, frozen=True, gc=False):
    """One feedback message of a goal."""

    number: int
    """Number of the message among the feedback of its attempt: 1, 2, 3 and so on, without gaps."""
    payload: bytes
    attempt: int = 1
    """The attempt at the goal that the feedback is of. A server that keeps its goals in a store may
    run a goal again after a restart."""
    at: int = msgspec.field(default_factory=time_ns)
    """The time at which the executor reported it: nanoseconds since 1970, by the server's clock.
    Where that is not told, as by a server of ROS, it is the time of the arrival."""


class Closing(ABC):
    """An end that is closed by `close()` or at the end of a `with` block, without waiting."""

    __slots__ = ()

    @abstractmethod
    def close(self) -> None:
        """Leave it: nothing is read or sent there any more. Closing twice does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


GoalUpdate: TypeAlias = FeedbackItem | GoalStatus | Outcome[bytes]
"""One event in the life of a goal: a feedback message, the active status that the goal has changed
to, or the end."""


class GoalStream(Closing):
    """The updates of one goal that is followed; the last of them is its outcome.

        async for update in stream:
            match update:
                case FeedbackItem(number, payload): ...
                case GoalStatus(): ...
                case Outcome(status, result, reason): ...

    Updates come in the order in which they happened. A stream that is not read in time misses
    feedback, and counts it in `dropped`; it never misses the outcome.
    """

    __slots__ = ()

    goal_id: GoalID
    stamp: int
    """Time at which the goal was accepted: nanoseconds since 1970."""
    latest: bool
    """True if a slow reader gets the newest feedback only: the server's policy."""
    own: bool = True
    """True if the goal belongs to the client that asked for this stream, as far as the server can
    tell clients apart. A stream of another client's goal never makes the executor wait."""
    cursor: int
    """The number of the last feedback that was taken or skipped; 0 before the first of an attempt.
    """
    reads: bool
    """True while feedback and status changes are delivered. After `close()`, or if the goal was
    sent with `feedback=False`, only the outcome is."""
    checkpoint: bytes | None = None
    """The last checkpoint of a goal that its server has given up and can run again: see
    `Endpoint.rerun`. Empty if it has none; None for any other goal, for the client that sent it,
    and if the transport does not carry it."""
    news: Notifier
    """The notifier of new updates, also notified when the goal has ended."""

    @property
    @abstractmethod
    def status(self) -> GoalStatus:
        """The newest status that this stream knows."""

    @property
    def attempt(self) -> int:
        """The attempt at the goal, from 1, in which `cursor` counts: that of the feedback that was
        taken last, or a newer one if its feedback comes next.
        """
        return 1

    @property
    def newest_attempt(self) -> int:
        """The newest attempt at the goal that this stream knows, whether or not it is read."""
        return self.attempt

    @property
    def goal(self) -> bytes | None:
        """The payload of the goal itself; None if it is not known. Servers keep it as long as the
        feedback of the goal, and ROS 2 does not tell it to observers.
        """
        return None

    @property
    def info(self) -> GoalInfo:
        """The goal as an entry of a list, as far as this stream knows it, without its place among
        those that wait. The client that sent it is not told its parent and its labels.
        """
        return GoalInfo(self.goal_id, self.stamp, self.status, attempt=self.newest_attempt)

    @property
    @abstractmethod
    def dropped(self) -> int:
        """The number of feedback messages that this stream has missed, in all attempts that it has
        followed. The rest of an attempt that ended with its server is not known, and not counted.
        """

    @abstractmethod
    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        """Return the next updates that have arrived: one status change, or at most `limit` feedback
        messages of one attempt; empty if none has arrived.

        When nothing else is left and the goal has ended, return its `Outcome`, each time.

        Raises:
            ConnectionLost: The connection ended before the goal did.
            TransportError: The rest cannot be received, for example because the result is larger
                than this client's limit.
            ProtocolError: The server's message is invalid.
        """

    @abstractmethod
    def known_outcome(self) -> Outcome[bytes] | None:
        """Return the outcome of the goal, whether or not its feedback was read; None if unknown.

        Raises:
            ConnectionLost: The connection ended before the goal did.
            TransportError, ProtocolError: As for `take`.
        """

    def __aiter__(self) -> AsyncIterator[GoalUpdate]:
        """Iterate over the updates, up to the outcome. No update is lost if the wait is canceled.

        Raises:
            ConnectionLost, TransportError, ProtocolError: As for `take`.
        """
        return _Updates(self)

    async def receive(self) -> FeedbackItem | None:
        """Wait for the next feedback, and return it; None when no more is delivered.

        Raises:
            ConnectionLost, TransportError, ProtocolError: As for `take`.
        """
        while self.reads:
            updates = self.take()
            if not updates:
                await self.news.wait()
            elif isinstance(updates[0], FeedbackItem):
                return updates[0]
            elif isinstance(updates[0], Outcome):
                break
        return None

    async def outcome(self) -> Outcome[bytes]:
        """Wait for the end of the goal, whether or not its feedback is read.

        A stream keeps its outcome after the server has forgotten the goal, and after `close()`.

        Raises:
            ConnectionLost, TransportError, ProtocolError: As for `known_outcome`.
        """
        while (outcome := self.known_outcome()) is None:
            await self.news.wait()
        return outcome

    def seek(self, cursor: int) -> None:
        """Continue after the feedback of that number, as far as it is still remembered.

        Does nothing for a stream that cannot be positioned.
        """

    @abstractmethod
    def hold(self, wanted: bool) -> None:
        """Set whether the executor waits for this stream when it is read slowly.

        Has an effect only for the client that sent the goal, and only if the server's policy is
        `feedback="every"`.
        """

    def hold_briefly(self) -> None:
        """Let the executor wait for this stream for moments only.

        So bursts arrive whole at a client that reads, and one that reads slowly misses feedback and
        holds nothing up. A stream that cannot limit the time does not make the executor wait.
        """
        self.hold(False)

    @abstractmethod
    def fail(self, error: ActionError) -> None:
        """End the stream here: from now on, reading and waiting raise an error like this one.

        An outcome that is known is still returned.
        """


class _Updates(AsyncIterator[GoalUpdate]):
    """An iteration over a stream. It is not a generator, which would have to be closed."""

    def __init__(self, stream: GoalStream) -> None:
        self._stream = stream
        self._has_ended = False

    async def __anext__(self) -> GoalUpdate:
        if self._has_ended:
            raise StopAsyncIteration
        while not (updates := self._stream.take()):
            await self._stream.news.wait()
        self._has_ended = type(updates[0]) is Outcome  # faster than `isinstance`, and exact
        return updates[0]


class StatusStream(Closing):
    """The statuses of all goals of a server: first every goal it knows, then each change."""

    known: int = 0
    """The number of goals that the server knew when the stream began, which come first."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """The number of changes that this stream has missed, because it was read too slowly."""

    @abstractmethod
    async def receive(self) -> GoalInfo | None:
        """Wait for the next goal or change, and return it; None when the server has stopped.

        The status UNKNOWN says that the server has forgotten the goal.

        Raises:
            ConnectionLost: The connection ended.
            TransportError: The rest cannot be received, or this client lacks the permission.
        """

    @abstractmethod
    def fail(self, error: ActionError) -> None:
        """End the stream here: after what has arrived, an error like this one is raised."""

    async def listed(self) -> list[GoalInfo]:
        """Return the goals that the server knew when the stream began: its first items.

        Raises:
            ConnectionLost, TransportError: As for `receive`.
        """
        goals: list[GoalInfo] = []
        slices = Slices()  # a server may have very many goals, and all of them be here already
        while len(goals) < self.known and (info := await self.receive()) is not None:
            goals.append(info)
            await slices.pause()
        return goals
