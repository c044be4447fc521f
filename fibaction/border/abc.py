"""The interfaces between clients and servers, for authors of transports.

`Endpoint` is an action server as its clients see it. `ActionServer` is one; the client half of a
transport is one; the server half of a transport calls one. So any endpoint that can be reached can
be served again at another address. Payloads cross this border as bytes (msgpack), so that the parts
between a client and a server do not need the types, and a mutation on one side is not seen on the
other.

Errors: a method raises only the errors that its docstring names; a transport translates the errors
of the library that it is built on, with `raise ... from exc`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Coroutine
from contextlib import AbstractAsyncContextManager, nullcontext
from types import TracebackType
from typing import Any, ClassVar, Protocol, runtime_checkable

from fibaction._runtime.notify import Notifier
from fibaction.border.goal_store import GoalStore
from fibaction.border.streams import FeedbackItem, GoalStream, GoalUpdate, StatusStream
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import UnknownGoal
from fibaction.words.goals import (
    UNKNOWN_OUTCOME,
    UNKNOWN_SENDER,
    ActionPeers,
    CancelAnswer,
    GoalID,
    Outcome,
    Sender,
    WorkerInfo,
)
from fibaction.words.meta import Meta

__all__ = [
    "Connection",
    "Endpoint",
    "FeedbackItem",
    "ForwardingEndpoint",
    "GoalStream",
    "GoalUpdate",
    "Meta",
    "Notifier",
    "Startable",
    "StatusStream",
    "Transport",
]


class Endpoint(ABC):
    """An action server as its clients see it, in this process or behind a transport."""

    @property
    @abstractmethod
    def info(self) -> ActionInfo:
        """The action that is served here."""

    @abstractmethod
    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
        timeout: float | None = None,
        meta: Meta | None = None,
    ) -> GoalStream:
        """Send a goal, and follow it from its beginning.

        The same goal may be sent again with the same ID: it gets the same answer and runs once. If
        another client has sent it first, the stream is that of an observer: `stream.own` is False.
        `feedback=False` follows the outcome only. `sender` is the client that sends it, for the
        goal's record; a connection to another process does not pass it on, since the server there
        identifies its clients itself. `timeout` is the number of seconds, more than 0, after which
        the client gives the goal up; None if it does not. The executor gets it as
        `GoalHandle.deadline`, and the server does not enforce it. A goal that is sent again keeps
        its first deadline. `meta` is a small text map that goes with the goal, for traces: see
        `fibaction.otel`. It has at most 8 keys and 4096 bytes. Watchers of the server get it;
        ROS 2 does not carry it.

        Raises:
            GoalRejected: The server did not accept it; `reason` says why.
            ServerNotFound: This action is not served.
            ConnectionLost: The connection ended before the answer; the goal may have been accepted.
            AuthenticationFailed: This client lacks the permission.
            InvalidMessage: The goal or its `meta` is too large to be sent; nothing was sent.
            ProtocolError: The server sent an invalid message, which ended the connection.
            ServerFailed: The server has a bug.
        """

    def offer_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
        timeout: float | None = None,
        meta: Meta | None = None,
    ) -> GoalStream | Coroutine[Any, Any, GoalStream]:
        """Send a goal as `send_goal` does, without waiting if the goal can be decided at once.

        Return the stream if the goal is decided at once, or else a coroutine that waits for it. The
        coroutine must be awaited or closed; until then the goal counts as undecided, and a retry of
        it blocks. The server half of a transport calls this, so that it starts tasks only for goals
        whose decision takes time.

        Raises:
            ActionError: As for `send_goal`, if the goal is decided at once.
        """
        return self.send_goal(
            goal_id, goal, feedback=feedback, sender=sender, timeout=timeout, meta=meta
        )

    @abstractmethod
    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        """Follow a goal that was sent before.

        The stream begins with the next feedback; with `after`, it begins with the feedback that
        follows that number, as far back as the server remembers (the rest counts as dropped). A
        follower never slows the goal down, except with `own=True`, which is for the client that
        sent the goal, lost the stream that `send_goal` returned, and continues from there.
        `attempt` is the attempt that `after` is a number of. If the goal is in another one by now,
        the stream begins with the first feedback of that one.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed, ServerFailed: As for `send_goal`.
            ProtocolError: As for `send_goal`.
            LimitReached: The server takes no more requests of this client for now.
        """

    @abstractmethod
    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """Ask the server to cancel goals, by the rules of `action_msgs/srv/CancelGoal`.

        Without arguments, this means all goals; with a stamp, all goals accepted at or before it;
        with an ID, that goal; with both, that goal and all accepted at or before the stamp. A goal
        that is still being decided is canceled by its ID as soon as it is accepted.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """

    @abstractmethod
    async def status(self) -> StatusStream:
        """Follow the statuses of all goals.

        Raises:
            TransportError, ProtocolError: As for `feedback`.
        """

    @abstractmethod
    async def wait_for_server(self) -> None:
        """Wait until this action is served, without a timeout.

        Raises:
            TransportError, ProtocolError: The connection ended for good, or the server rejects the
                request.
        """

    def owner_of(self, goal_id: GoalID) -> bytes:
        """Return the owner of a goal, as in `Sender.owner`; empty if it is not known.

        A goal may come from the time before a restart. The server half of a transport recognises
        its client by this.
        """
        return b""

    async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
        """Wait for the end of a goal, and return its outcome; UNKNOWN if the server has no such
        goal.

        Raises:
            TransportError, ProtocolError: As for `feedback` and `GoalStream.outcome`.
        """
        try:
            stream = await self.feedback(goal_id)
        except UnknownGoal:
            return UNKNOWN_OUTCOME
        with stream:
            return await stream.outcome()


@runtime_checkable
class Startable(Protocol):
    """An endpoint that `serve` starts and stops: an `ActionServer`, or a wrapper of one."""

    @property
    def is_running(self) -> bool:
        """True if it accepts goals; then `serve` neither starts nor stops it."""
        ...

    async def __aenter__(self) -> object:
        """Start."""
        ...

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool | None:
        """Stop, and clean up."""
        ...

    async def stop(self) -> None:
        """Reject new goals, and end all active ones. Stopping twice is harmless."""
        ...


class ForwardingEndpoint(Endpoint):
    """An endpoint around another one; subclasses override the methods that are to be different.

        class Audited(ForwardingEndpoint):
            async def cancel_goals(self, goal_id=None, stamp=None):
                log.info("cancel of %s", goal_id)
                return await super().cancel_goals(goal_id, stamp)

        async with serve(Audited(ActionServer(ACTION, executor)), "tcp://127.0.0.1:7400"):
            ...

    Every call is forwarded to `inner`, with the sender, the timeout and the meta of the goal.
    `offer_goal` calls `send_goal`, so that one method sees every goal. It starts and stops `inner`,
    and runs while `inner` runs; around an endpoint that is not `Startable` it counts as running.
    """

    def __init__(self, inner: Endpoint) -> None:
        self.inner = inner
        """The wrapped endpoint."""

    @property
    def info(self) -> ActionInfo:
        return self.inner.info

    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
        timeout: float | None = None,
        meta: Meta | None = None,
    ) -> GoalStream:
        return await self.inner.send_goal(
            goal_id, goal, feedback=feedback, sender=sender, timeout=timeout, meta=meta
        )

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        return await self.inner.feedback(goal_id, after=after, own=own, attempt=attempt)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        return await self.inner.cancel_goals(goal_id, stamp)

    async def status(self) -> StatusStream:
        return await self.inner.status()

    async def wait_for_server(self) -> None:
        await self.inner.wait_for_server()

    def owner_of(self, goal_id: GoalID) -> bytes:
        return self.inner.owner_of(goal_id)

    @property
    def is_running(self) -> bool:
        """True if `inner` accepts goals."""
        return not isinstance(self.inner, Startable) or self.inner.is_running

    async def __aenter__(self) -> ForwardingEndpoint:
        """Start `inner`, if it can be started."""
        if isinstance(self.inner, Startable):
            await self.inner.__aenter__()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop `inner`, if it can be stopped."""
        if isinstance(self.inner, Startable):
            await self.inner.__aexit__(exc_type, exc, traceback)

    async def stop(self) -> None:
        """Stop `inner`, if it can be stopped."""
        if isinstance(self.inner, Startable):
            await self.inner.stop()


class Connection(ABC):
    """An open connection to one server, or to one network of servers."""

    @abstractmethod
    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """Return the endpoint of an action, which need not be served yet."""

    @abstractmethod
    async def actions(self) -> list[ActionInfo]:
        """Return the actions that can be reached now.

        Raises:
            TransportError: The server cannot be asked: mostly `ServerNotFound` or `ConnectionLost`.
            ProtocolError: The server sent an invalid message.
        """

    async def peers(self, action: str) -> ActionPeers:
        """Return the servers and the clients of an action, as far as this transport knows.

        Raises:
            AuthenticationFailed: This client lacks the permission.
            TransportError, ProtocolError: As for `actions`.
        """
        return ActionPeers()

    async def workers(self) -> list[WorkerInfo]:
        """Return the workers of the fleet; empty if this transport has no fleet.

        Raises:
            TransportError, ProtocolError: As for `actions`.
        """
        return []


class Transport(ABC):
    """A way to reach endpoints, configured by its constructor or its URL alone.

    To be found by URL, a package declares its class in the entry-point group
    `fibaction.transports`, with the URL's scheme as the name.
    """

    shares_event_loop: ClassVar[bool] = False
    """True if clients must be on the event loop of their server."""
    shares_address: ClassVar[bool] = False
    """True if several blocks of `serve` can be open at one address at once, with other actions."""

    @classmethod
    @abstractmethod
    def from_url(cls, url: str, **settings: Any) -> Transport:
        """Make a transport from a URL, and from settings of its constructor that are not in it.

        Raises:
            TransportError: The URL is invalid for this transport; the text says why.
            TypeError: A setting is unknown.
        """

    def goal_store(self) -> AbstractAsyncContextManager[GoalStore | None]:
        """Open the place where this transport keeps the goals of its servers, while the block
        lasts.

        Most have none, and the block gets None. `fibaction.serve` opens it before it starts the
        servers, gives it to each of them, and calls `serve` inside the block.

        Raises:
            TransportError: The address cannot be used.
        """
        return nullcontext()

    @abstractmethod
    def serve(self, *endpoints: Endpoint) -> AbstractAsyncContextManager[str]:
        """Serve these endpoints for as long as the block lasts; the block gets their URL.

        Raises:
            TransportError: The address cannot be used, or already serves such an action.
        """

    @abstractmethod
    def connect(self) -> AbstractAsyncContextManager[Connection]:
        """Open a connection for as long as the block lasts.

        Raises:
            ServerNotFound: The server is not found, and this transport can tell at once.
            AuthenticationFailed: The server rejects this client.
        """
