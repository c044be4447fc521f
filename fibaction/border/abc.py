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
from contextlib import AbstractAsyncContextManager, nullcontext
from typing import Any, ClassVar

import msgspec

from fibaction._runtime.notify import Notifier
from fibaction.border.endpoints import (
    Absence,
    Endpoint,
    ForwardingEndpoint,
    GoalRequest,
    LogLine,
    Startable,
    cancel_each,
)
from fibaction.border.goal_store import GoalStore, StoredGoal
from fibaction.border.streams import FeedbackItem, GoalStream, GoalUpdate, StatusStream
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import StoreError, TransportError
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import ActionPeers, GoalID, WorkerInfo
from fibaction.words.intake import Intake, IntakeChange, IntakeMode
from fibaction.words.meta import Meta

__all__ = [
    "Absence",
    "Connection",
    "Diagnosis",
    "Endpoint",
    "FeedbackItem",
    "ForwardingEndpoint",
    "GoalQuery",
    "GoalRequest",
    "GoalStream",
    "GoalUpdate",
    "Intake",
    "IntakeChange",
    "IntakeMode",
    "LogLine",
    "Meta",
    "Notifier",
    "PastPage",
    "Startable",
    "StatusStream",
    "Transport",
    "cancel_each",
]


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

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        """Return the texts of the `.action` file of an action, and of the `.msg` files that it
        nests, by the types that they define, as `define_action` takes them.

        Raises:
            TransportError: They are not known, or not all of them; the text says how to get them.
        """
        raise TransportError(
            f"the types of {action.name!r} are known here as JSON Schemas only: connect to the"
            " robot itself, at dds:// or ros2://"
        )

    async def nodes(self) -> set[str]:
        """Return the full names of the other nodes of a network of servers, such as
        `/robot1/camera`, whether they serve an action or not; empty if this transport has no nodes.

        Raises:
            TransportError, ProtocolError: As for `actions`.
        """
        return set()

    @property
    def release(self) -> str:
        """The version of fibaction at the server; empty if it is not known, as of a server of ROS,
        or of a fleet, whose `workers` tell theirs.
        """
        return ""

    async def workers(self) -> list[WorkerInfo]:
        """Return the workers of the fleet; empty if this transport has no fleet.

        Raises:
            TransportError, ProtocolError: As for `actions`.
        """
        return []

    async def given_up(self) -> dict[str, list[StoredGoal]]:
        """Return the goals that the fleet keeps after they were given up, by the names of their
        actions, in the order of their ends; empty if this transport has no fleet.

        Raises:
            TransportError, ProtocolError: As for `actions`.
        """
        return {}

    async def rerun(self, action: str, goal_id: GoalID) -> GoalID:
        """Run a goal of `given_up` again, as a new goal from its last checkpoint; return its ID.

        Raises:
            StoreError: The goal was not given up, or cannot be stored.
            TransportError, ProtocolError: As for `actions`.
        """
        raise StoreError(f"goal {goal_id} was not given up: only fleets keep such goals here")


class Diagnosis(msgspec.Struct, frozen=True):
    """The findings of a transport about the way to its servers."""

    is_found: bool
    """True if what was looked for can be reached."""
    facts: dict[str, Any]
    """Values of JSON by their names, in the order in which they are shown."""
    advice: tuple[str, ...] = ()
    """Sentences that say what to do."""


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

    def served_as(self, name: str) -> str:
        """Return the full name under which the last block of `serve` serves an action, if a setting
        of the transport gives it another name; else its own.
        """
        return name

    async def diagnose(self, seconds: float, action: str = "") -> Diagnosis:
        """Find out what can be reached, or whether this action can be, and why not.

        A transport whose servers are discovered listens for that many seconds. By default, a
        connection is opened, and its actions are listed.

        Raises:
            TransportError, ProtocolError: As for `connect` and `Connection.actions`.
        """
        async with self.connect() as connection:
            actions = await connection.actions()
        names = [info.name for info in actions]
        is_found = action.removeprefix("/") in [name.removeprefix("/") for name in names]
        if is_found or not action:
            advice = "" if names else "the server answers, and serves no action"
        else:
            advice = f"the server answers, and does not serve {action!r}"
        return Diagnosis(
            is_found or bool(names and not action),
            {"actions": [{"name": info.name, "type": info.type_name} for info in actions]},
            (advice,) if advice else (),
        )
