"""The streams by which goals are followed: one goal, or the statuses of all goals of a server.

They are implemented by the server (a cursor in the goal's log) and by the client half of each
transport. `fibaction.abc` exports them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Sequence
from types import TracebackType
from typing import Self, TypeAlias

import msgspec

from fibaction._notify import Notifier
from fibaction.exceptions import ActionError
from fibaction.goals import GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus


class FeedbackItem(msgspec.Struct, frozen=True, gc=False):
    """One feedback message of a goal."""

    number: int
    """Number of the message among all feedback of the goal: 1, 2, 3 and so on, without gaps."""
    payload: bytes


class _Closing(ABC):
    """A stream to close: by hand, or at the end of a `with` block. Closing never waits."""

    __slots__ = ()

    @abstractmethod
    def close(self) -> None:
        """Stop reading. Closing twice does nothing."""

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


class GoalStream(_Closing):
    """One goal, followed: a sequence of updates, of which the last is the outcome.

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
    cursor: int
    """The number of the feedback that was taken last, or skipped; 0 before the first."""
    reads: bool
    """True while feedback and status changes are delivered. After `close()`, or if no feedback was
    asked for, only the outcome is."""
    news: Notifier
    """Notified whenever there may be something to take, and when the goal has ended."""

    @property
    @abstractmethod
    def status(self) -> GoalStatus:
        """The status that was last heard of."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """The number of feedback messages that this stream has missed."""

    @abstractmethod
    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        """Return what comes next, as far as it is there: one status change, or at most `limit`
        feedback messages. Empty if there is nothing now.

        When nothing else is left and the goal has ended, return its `Outcome`, each time.

        Raises:
            ConnectionLost: The connection ended, and more was to come.
            TransportError: The server cannot tell the rest, or may not: for instance, a result is
                larger than this client takes.
            ProtocolError: The message of the server cannot be read.
        """

    @abstractmethod
    def known_outcome(self) -> Outcome[bytes] | None:
        """Return the outcome of the goal, if it is known, whether or not its feedback was read.

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
        """Return the next feedback; None when no more is delivered.

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

        It is answered also after the server has forgotten the result, or the stream was closed.

        Raises:
            ConnectionLost, TransportError, ProtocolError: As for `known_outcome`.
        """
        while (outcome := self.known_outcome()) is None:
            await self.news.wait()
        return outcome

    def seek(self, cursor: int) -> None:
        """Continue behind the feedback of that number, as far as it is still there.

        A stream that cannot be positioned stays where it is.
        """

    @abstractmethod
    def hold(self, wanted: bool) -> None:
        """Make the executor wait for this stream when it is read slowly, or no longer.

        Has an effect only for the goal's own client, and only where the server's policy is to lose
        no feedback.
        """

    @abstractmethod
    def fail(self, error: ActionError) -> None:
        """End the stream here: from now on, reading and waiting raise an error like this one.

        A goal whose outcome is known keeps it.
        """


class _Updates(AsyncIterator[GoalUpdate]):
    """An iteration over a stream. No generator: one that is left early has to be closed."""

    def __init__(self, stream: GoalStream) -> None:
        self._stream = stream
        self._has_ended = False

    async def __anext__(self) -> GoalUpdate:
        if self._has_ended:
            raise StopAsyncIteration
        while not (updates := self._stream.take()):
            await self._stream.news.wait()
        self._has_ended = isinstance(updates[0], Outcome)
        return updates[0]


class StatusStream(_Closing):
    """The statuses of all goals of a server: first every goal it knows, then each change."""

    known: int = 0
    """The number of goals that the server knew when the stream began: so many come first."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """The number of changes that this stream has missed, because it was read too slowly."""

    @abstractmethod
    async def receive(self) -> GoalInfo | None:
        """Return the next goal or change, UNKNOWN for a goal forgotten; None when the server stops.

        Raises:
            ConnectionLost: The connection ended.
            TransportError: The server does not tell the rest, or this client may not know it.
        """

    @abstractmethod
    def fail(self, error: ActionError) -> None:
        """End the stream here: what has arrived can be read, and then an error like this one is
        raised.
        """

    async def listed(self) -> list[GoalInfo]:
        """Return the goals that there were when the stream began: its first items.

        Raises:
            ConnectionLost, TransportError: As for `receive`.
        """
        goals: list[GoalInfo] = []
        while len(goals) < self.known and (info := await self.receive()) is not None:
            goals.append(info)
        return goals
