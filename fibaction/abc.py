"""What lies between clients and servers: all that the author of a transport reads.

`Endpoint` is an action server as its clients see it. `ActionServer` is one; the client half of a
transport is one; the server half of a transport calls one. So anything that can be reached can be
served again somewhere else. Payloads cross this border as bytes (msgpack), so that nothing between
a client and a server needs the types, and no mutation on one side is seen on the other.

Errors: a method raises only what its docstring names; a transport translates the errors of
whatever it is built on, `raise ... from exc`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Coroutine, Sequence
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Any, Self, TypeAlias

import msgspec

from fibaction._notify import Notifier as Notifier  # an author of streams needs it, too
from fibaction.action import Action, ActionInfo
from fibaction.exceptions import ActionError, UnknownGoal
from fibaction.goals import UNKNOWN_OUTCOME, ActionPeers, CancelAnswer, GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus


class FeedbackItem(msgspec.Struct, frozen=True, gc=False):
    """One feedback message of a goal."""

    number: int
    """Its place among all feedback of the goal: 1, 2, 3 and so on, with none left out."""
    payload: bytes


class _Closing(ABC):
    """Something to close: by hand, or at the end of a `with` block. Closing never waits."""

    __slots__ = ()

    @abstractmethod
    def close(self) -> None:
        """Stop listening. Closing twice does nothing."""

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
    """What happens to all goals of a server: first every goal it knows, then each change."""

    known: int = 0
    """How many goals the server knew when the stream began: so many come first."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """How many changes this stream has missed, because it was read too slowly."""

    @abstractmethod
    async def receive(self) -> GoalInfo | None:
        """The next goal or change, UNKNOWN for a goal forgotten; None when the server stops.

        Raises:
            ConnectionLost: The connection ended.
            TransportError: The server does not tell the rest, or this client may not know it.
        """

    async def listed(self) -> list[GoalInfo]:
        """The goals that there were when the stream began: its first items.

        Raises:
            ConnectionLost, TransportError: As for `receive`.
        """
        goals: list[GoalInfo] = []
        while len(goals) < self.known and (info := await self.receive()) is not None:
            goals.append(info)
        return goals


class Endpoint(ABC):
    """An action server as its clients see it, whatever lies between."""

    @property
    @abstractmethod
    def info(self) -> ActionInfo:
        """The action that is served here."""

    @abstractmethod
    async def send_goal(self, goal_id: GoalID, goal: bytes, *, feedback: bool = True) -> GoalStream:
        """Send a goal, and follow it from its very beginning.

        The same ID with the same goal may be sent again: it gets the same answer and runs once.
        `feedback=False` follows the status and the outcome only.

        Raises:
            GoalRejected: The server did not accept it; `reason` says why.
            ServerNotFound: Nobody serves this action.
            ConnectionLost: The connection ended before the answer; the goal may have been accepted.
            AuthenticationFailed: This client may not do that.
            ProtocolError: The goal is too large to be sent.
        """

    def offer_goal(
        self, goal_id: GoalID, goal: bytes, *, feedback: bool = True, client: str = ""
    ) -> GoalStream | Coroutine[Any, Any, GoalStream]:
        """`send_goal` for the server half of a transport: gives the stream itself if there is
        nothing to wait for, else a coroutine that waits for it. Begin it in any case, be it only
        to be canceled: until then the goal is being decided upon, and whoever sends the same one
        waits. `client` says who has sent the goal, for people to read; what is behind another
        transport is not told.

        Raises:
            ActionError: What `send_goal` raises, if that is known at once.
        """
        return self.send_goal(goal_id, goal, feedback=feedback)

    @abstractmethod
    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False
    ) -> GoalStream:
        """Follow a goal that was sent before.

        The stream begins with what comes from now on; with `after`, with the feedback that follows
        that number, as far back as the server remembers (the rest counts as dropped). An observer
        never slows the goal down; `own` says that this is the goal's own client, who has lost the
        stream that `send_goal` gave it and goes on from there.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: The server takes no more requests of this client for now.
        """

    @abstractmethod
    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """Ask to cancel: by the rules of `action_msgs/srv/CancelGoal`.

        Neither argument: all goals. A stamp: all accepted at or before it. An ID: that goal. Both:
        that goal and all accepted at or before the stamp. A goal that is still being decided upon
        is canceled by its ID as soon as it is accepted.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `feedback`.
        """

    @abstractmethod
    async def status(self) -> StatusStream:
        """Follow the statuses of all goals.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `feedback`.
        """

    @abstractmethod
    async def wait_for_server(self) -> None:
        """Return as soon as somebody serves this action. Has no time limit of its own.

        Raises:
            TransportError: The connection ended for good, or the server does not say.
        """

    async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
        """Wait for the end of a goal; UNKNOWN at once if the server has no such goal.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `feedback` and `GoalStream.ended`.
            ProtocolError: As for `GoalStream.ended`.
        """
        try:
            stream = await self.feedback(goal_id)
        except UnknownGoal:
            return UNKNOWN_OUTCOME
        with stream:
            return await stream.outcome()


class Connection(ABC):
    """An open way to whatever one server, or one network of servers, has to offer."""

    @abstractmethod
    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """The endpoint of an action. It need not be served yet: see `Endpoint.wait_for_server`."""

    @abstractmethod
    async def actions(self) -> list[ActionInfo]:
        """What can be reached now.

        Raises:
            TransportError: The server cannot be asked: mostly `ServerNotFound` or `ConnectionLost`.
        """

    async def peers(self, action: str) -> ActionPeers:
        """Who serves that action and who uses it, as far as this transport knows.

        Raises:
            AuthenticationFailed: This client may not know that.
            TransportError: As for `actions`.
        """
        return ActionPeers()


class Transport(ABC):
    """A way to reach endpoints. It is configured by its constructor or its URL alone.

    To be found by URL, a package announces its class under the entry-point group
    `fibaction.transports`, with the URL's scheme as the name.
    """

    @classmethod
    @abstractmethod
    def from_url(cls, url: str, **settings: Any) -> Transport:
        """Make a transport from a URL, and from settings of its constructor that are not in it.

        Raises:
            TransportError: The URL does not say what this transport needs; the text says what.
            TypeError: There is no such setting.
        """

    @abstractmethod
    def serve(self, *endpoints: Endpoint) -> AbstractAsyncContextManager[str]:
        """Let clients reach these endpoints for as long as the block lasts; gives their URL.

        Raises:
            TransportError: The address cannot be used, or already serves such an action.
        """

    @abstractmethod
    def connect(self) -> AbstractAsyncContextManager[Connection]:
        """Open a connection for as long as the block lasts.

        Raises:
            ServerNotFound: There is nobody, and this transport can tell at once.
            AuthenticationFailed: There is, but it does not let this client in.
        """
