"""`LinkKeeper`: the link of a client to a rosbridge server, opened whenever it is needed.

A client has at most one `ServerLink`. It is opened by the first request, and opened again by the
first request after it was lost; goals and calls of the lost one have ended with it.

rosbridge has no goal IDs. Those of the goals that were sent are remembered here: the stream of such
a goal can be asked for again as long as the goal or another stream of it is in use, and the same
goal is never sent twice, since that would run it twice.

rosapi of rosbridge_suite may end when it is asked for a type that it cannot import. So it is asked
first which types it knows (`DescribedTypes`). It is asked for each type once in a connection, as
long as there are not too many, and not again after a call without an answer.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from ssl import SSLContext
from typing import Any, ClassVar, NamedTuple, TypeVar
from weakref import WeakValueDictionary

import anyio
import msgspec
from anyio.abc import TaskGroup

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.wire.channel import Line
from fibaction.wire.settings import LineSettings
from fibaction.wire.transport import TlsFiles
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    copy_of,
)
from fibaction.words.goals import GoalID
from fibaction.words.plain_data import is_map
from fibaction_transports.web.rosbridge.client.goal import OutgoingGoal
from fibaction_transports.web.rosbridge.client.link import CallFailed, NoAnswer, ServerLink
from fibaction_transports.web.rosbridge.type_definitions import TypeDefinition, schema_of

MOST_TYPES = 1000
"""Types whose schemas are kept. Beyond, the oldest is dropped, since a server may name new types
without end."""

logger = clean_logger("fibaction.web")
HANDSHAKE = 5.0
"""Seconds for a server to accept a WebSocket."""
MOST_SENT = 10_000
"""Goals whose IDs are remembered."""


class ActionSchemas(NamedTuple):
    """The schemas of one action type; empty where they are not known."""

    goal: dict[str, Any]
    feedback: dict[str, Any]
    result: dict[str, Any]


AnswerT = TypeVar("AnswerT")

UNKNOWN = ActionSchemas({}, {}, {})


def field_of(values: object, name: str, kind: type[AnswerT]) -> AnswerT:
    """Return a field of an answer of rosapi.

    Raises:
        msgspec.ValidationError: It is not of that kind.
    """
    return msgspec.convert(values.get(name) if is_map(values) else None, kind)


class DescribedTypes:
    """The schemas of the action types of one connection."""

    def __init__(
        self, call: Callable[[str, dict[str, Any]], Awaitable[Any]], most: int = MOST_TYPES
    ) -> None:
        """Let `call` call a service."""
        self._call = call
        self._most = most
        self._names: frozenset[str] = frozenset()
        self._found: dict[str, ActionSchemas] = {"": UNKNOWN}
        self._has_answered = True
        self._asking = anyio.Lock()

    async def schemas_of(self, type_name: str) -> ActionSchemas:
        """Return the schemas of a type; empty ones if rosapi does not describe it.

        Raises:
            ActionError: The connection has ended.
        """
        async with self._asking:
            if type_name not in self._found:
                found = await self._asked(type_name)
                if len(self._found) >= self._most:
                    del self._found[next(iter(self._found))]
                self._found[type_name] = found
            return self._found[type_name]

    async def _asked(self, type_name: str) -> ActionSchemas:
        if not self._has_answered:
            return UNKNOWN
        try:
            if type_name not in self._names:
                self._names = await self._interfaces()
            return await self._details(type_name) if type_name in self._names else UNKNOWN
        except NoAnswer as exc:
            logger.info("types of actions are not described: %s", excerpt(str(exc)))
            self._has_answered = False
            return UNKNOWN

    async def _interfaces(self) -> frozenset[str]:
        try:
            values = await self._call("/rosapi/interfaces", {})
            return frozenset(field_of(values, "interfaces", list[str]))
        except (CallFailed, msgspec.ValidationError) as exc:
            logger.info("types of actions are not described: %s", excerpt(str(exc)))
            return frozenset()

    async def _details(self, type_name: str) -> ActionSchemas:
        schemas: list[dict[str, Any]] = []
        for part in ActionSchemas._fields:
            try:
                values = await self._call(f"/rosapi/action_{part}_details", {"type": type_name})
                schemas.append(schema_of(field_of(values, "typedefs", list[TypeDefinition])))
            except (CallFailed, msgspec.ValidationError) as exc:
                text = f"the {part} of {type_name} is not described: {exc}"
                logger.info("%s", excerpt(text))
                schemas.append({})
        return ActionSchemas(*schemas)


class RosbridgeSettings(LineSettings, frozen=True, kw_only=True):
    """The settings of a `RosbridgeTransport`."""

    for_servers: ClassVar[bool] = False

    heartbeat: float = 5.0
    """Seconds between signs of life of the server, which is pinged twice as often; after four times
    that without one the connection is lost. A robot that is busy answers late."""
    tls: TlsFiles | SSLContext | None = None
    """The files to make TLS from, or a context; in a URL the paths `ca`, `cert` and `key`."""
    accepted_after: float = 1.5
    """Seconds after which a goal counts as accepted if the server has said nothing: rosbridge
    answers rejections only. A server looks for the action for a second, and then rejects the
    goal."""
    answer_timeout: float = 10.0
    """Seconds for an answer of rosapi, for which a server itself waits up to 5 s."""
    schemas: bool = True
    """Ask rosapi for the types of the actions that are listed, so that goals are checked before
    they are sent. False is for older releases of rosapi, which end when they are asked for some
    types."""
    cancel_on_disconnect: bool = False
    """Ask the server to cancel goals whose connection is lost. Most servers do not know it yet."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or the token is not valid text.
        """
        super().__post_init__()
        for name in ("accepted_after", "answer_timeout"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} is at least 0 seconds and finite, not {value}")

    @property
    def fate(self) -> str:
        """The sentence about goals whose connection is lost."""
        if self.cancel_on_disconnect:
            return "the robot cancels the goal if its rosbridge knows cancel_on_disconnect"
        return "the goal may run on at the robot, and rosbridge cannot follow it again"


class LinkKeeper:
    """The link to one rosbridge server, and the goals that were sent there."""

    def __init__(
        self,
        url: str,
        open_line: Callable[[], Awaitable[Line]],
        tasks: TaskGroup,
        terms: RosbridgeSettings,
    ) -> None:
        self.url = url
        self.terms = terms
        self.goals: WeakValueDictionary[GoalID, OutgoingGoal] = WeakValueDictionary()
        """The goals that were sent, and that are in use."""
        self._sent: dict[GoalID, None] = {}
        self._open_line = open_line
        self._tasks = tasks
        self._dialing = anyio.Lock()
        self.opened: ServerLink | None = None
        """The link that is open; None if none is."""
        self._types = DescribedTypes(self.call)
        self._closed: ActionError | None = None

    async def action_names(self) -> list[str]:
        """Return the names of the actions that are served, as ROS writes them.

        Raises:
            CallFailed: rosapi does not run beside rosbridge.
            TransportError, ProtocolError: The server cannot be asked.
        """
        try:
            values = await self.call("/rosapi/action_servers", {})
        except CallFailed as exc:
            raise CallFailed(
                f"{self.url} cannot list its actions: start rosapi next to rosbridge ({exc})"
            ) from exc
        return _told(values, "action_servers", list[str])

    async def type_of(self, action: str) -> str:
        """Return the type of an action; empty if rosapi does not tell it.

        Raises:
            TransportError, ProtocolError: The server cannot be asked.
        """
        try:
            values = await self.call("/rosapi/action_type", {"action": action})
        except CallFailed:
            return ""
        return _told(values, "type", str)

    async def schemas_of(self, type_name: str) -> ActionSchemas:
        """Return the schemas of an action type; empty ones if rosapi does not describe it.

        Raises:
            TransportError, ProtocolError: The server cannot be asked.
        """
        return await self._types.schemas_of(type_name) if self.terms.schemas else UNKNOWN

    async def call(self, service: str, args: dict[str, Any]) -> Any:
        """Call a service of ROS, and return the values of its answer.

        Raises:
            CallFailed: The answer is an error.
            TransportError, ProtocolError: The server cannot be asked.
        """
        link = await self.link()
        return await link.call(service, args, self.terms.answer_timeout)

    @property
    def is_closed(self) -> bool:
        """True if the connection was closed here."""
        return self._closed is not None

    # Goals

    def was_sent(self, goal_id: GoalID) -> bool:
        """Return whether a goal of that ID may have been sent."""
        return goal_id in self._sent

    def note_sent(self, goal_id: GoalID, goal: OutgoingGoal) -> None:
        """Remember that a goal may have been sent."""
        self.goals[goal_id] = goal
        self._sent[goal_id] = None
        if len(self._sent) > MOST_SENT:
            del self._sent[next(iter(self._sent))]

    def forget(self, goal_id: GoalID) -> None:
        """Forget a goal that was not accepted."""
        self._sent.pop(goal_id, None)
        self.goals.pop(goal_id, None)

    async def link(self) -> ServerLink:
        """Return a link that is open, and open one if none is.

        Raises:
            ServerNotFound: The server is not there, or does not answer.
            ActionError: It does not let this client in, or does not speak rosbridge.
        """
        async with self._dialing:
            if self._closed is not None:
                raise copy_of(self._closed)
            if self.opened is None or self.opened.error is not None:
                self.opened = await self._dial()
                self._types = DescribedTypes(self.call)
            link = self.opened
        with anyio.move_on_after(HANDSHAKE):
            await link.opened()
            return link
        error = ServerNotFound(
            f"{self.url} has not accepted the WebSocket within {HANDSHAKE:g} s: check the port"
        )
        link.close(error)
        raise copy_of(error)

    async def _dial(self) -> ServerLink:
        terms = self.terms
        with anyio.move_on_after(HANDSHAKE):
            line = await self._open_line()
            link = ServerLink(line, terms.heartbeat, terms.max_frame, terms.fate)
            self._tasks.start_soon(link.run, name=f"connection to {self.url}")
            return link
        raise ServerNotFound(f"{self.url} cannot be reached within {HANDSHAKE:g} s")

    def close(self) -> None:
        """End everything that waits, and everything that is tried later."""
        self._closed = ConnectionLost(f"the connection to {self.url} was closed here")
        if self.opened is not None:
            self.opened.close(self._closed)


def _told(values: object, name: str, kind: type[AnswerT]) -> AnswerT:
    """Return a field of an answer of rosapi.

    Raises:
        ProtocolError: It is not of that kind.
    """
    try:
        return field_of(values, name, kind)
    except msgspec.ValidationError as exc:
        raise ProtocolError(f"invalid answer of rosapi: {exc}") from exc
