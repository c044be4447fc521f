"""`RosbridgeConnection` and `RosbridgeEndpoint`: the actions of a rosbridge server, for clients.

Theory of operation
-------------------

A connection has at most one `ServerLink`. It is opened by the first request, and opened anew by the
first request after it was lost; goals and calls of the lost one have ended with it.

rosbridge has no goal IDs. The connection remembers those of the goals that it has sent: the stream
of such a goal can be asked for again as long as the goal or another stream of it is in use, and the
same goal is never sent twice, since that would run it twice.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import anyio
import msgspec
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction._log import clean_logger
from fibaction._text import excerpt
from fibaction.abc import Connection, Endpoint, Meta, StatusStream
from fibaction.action import Action, ActionInfo
from fibaction.exceptions import (
    ActionError,
    ConnectionLost,
    GoalRejected,
    InvalidMessage,
    ProtocolError,
    ServerNotFound,
    TransportError,
    copy_of,
)
from fibaction.goals import UNKNOWN_SENDER, CancelAnswer, CancelCode, GoalID, GoalInfo, Sender
from fibaction.json_payload import PayloadError
from fibaction.server.feedback_cursor import FeedbackCursor
from fibaction.server.goal_record import digest_of
from fibaction.states import GoalStatus
from fibaction.wire.channel import Line
from fibaction_transports.web.rosbridge._action_values import ActionValues, arguments_text
from fibaction_transports.web.rosbridge._outgoing_goal import OutgoingGoal
from fibaction_transports.web.rosbridge._rosapi import (
    CANCEL_SUFFIX,
    cancel_answer,
    cancel_arguments,
    ros_name,
)
from fibaction_transports.web.rosbridge._server_link import CallFailed, ServerLink
from fibaction_transports.web.rosbridge._server_operations import send_goal_message

HANDSHAKE = 5.0
"""Seconds for a server to accept a WebSocket."""
PAUSE = 0.5
"""Seconds between two looks for a server that is not there."""
LARGEST_GOAL = 10_000_000
"""Bytes of the largest message that rosbridge servers accept, if nothing else is set there."""
MOST_SENT = 10_000
"""Goals whose IDs a connection remembers."""

AnswerT = TypeVar("AnswerT")

logger = clean_logger("fibaction.web")


class ClientTerms(msgspec.Struct, frozen=True):
    """The settings of a client of rosbridge."""

    heartbeat: float
    """Seconds between signs of life of the server, which is pinged twice as often."""
    window: int
    """Feedback messages of a goal that wait to be read."""
    max_frame: int
    """Bytes of the largest message of the server."""
    accepted_after: float
    """Seconds without an answer after which a goal counts as accepted."""
    answer_timeout: float
    """Seconds for the answer to a call of a service."""
    cancel_on_disconnect: bool
    """True if the server is asked to cancel goals whose connection is lost."""

    @property
    def fate(self) -> str:
        """The sentence about goals whose connection is lost."""
        if self.cancel_on_disconnect:
            return "the robot cancels the goal if its rosbridge knows cancel_on_disconnect"
        return "the goal may run on at the robot, and rosbridge cannot follow it again"


class RosbridgeConnection(Connection):
    """The actions of one rosbridge server."""

    def __init__(
        self,
        url: str,
        open_line: Callable[[], Awaitable[Line]],
        tasks: TaskGroup,
        terms: ClientTerms,
    ) -> None:
        self.url = url
        self.terms = terms
        self.goals: WeakValueDictionary[GoalID, OutgoingGoal] = WeakValueDictionary()
        """The goals that were sent, and that are in use."""
        self._sent: dict[GoalID, None] = {}
        self._open_line = open_line
        self._tasks = tasks
        self._dialing = anyio.Lock()
        self._link: ServerLink | None = None
        self._closed: ActionError | None = None

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """See `Connection.endpoint`.

        Raises:
            TransportError: The schemas of the action cannot be used.
        """
        return RosbridgeEndpoint(self, action.info if isinstance(action, Action) else action)

    async def actions(self) -> list[ActionInfo]:
        """See `Connection.actions`. rosapi tells names and types; the schemas are empty."""
        return [
            ActionInfo(name.removeprefix("/"), await self.type_of(name))
            for name in await self.action_names()
        ]

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
                f"{self.url} cannot list its actions: start rosapi beside rosbridge ({exc})"
            ) from exc
        return _converted(values, _ActionServers).action_servers

    async def type_of(self, action: str) -> str:
        """Return the type of an action; empty if rosapi does not tell it.

        Raises:
            TransportError, ProtocolError: The server cannot be asked.
        """
        try:
            values = await self.call("/rosapi/action_type", {"action": action})
        except CallFailed:
            return ""
        return _converted(values, _ActionType).type

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

    def note_sent(self, goal_id: GoalID) -> None:
        """Remember that a goal may have been sent."""
        self._sent[goal_id] = None
        if len(self._sent) > MOST_SENT:
            del self._sent[next(iter(self._sent))]

    def forget(self, goal_id: GoalID) -> None:
        """Forget a goal that was not accepted."""
        self._sent.pop(goal_id, None)
        self.goals.pop(goal_id, None)

    def opened_link(self) -> ServerLink | None:
        """Return the link that is open; None if none is."""
        return self._link

    async def link(self) -> ServerLink:
        """Return a link that is open, and open one if none is.

        Raises:
            ServerNotFound: The server is not there, or does not answer.
            ActionError: It does not let this client in, or does not speak rosbridge.
        """
        async with self._dialing:
            if self._closed is not None:
                raise copy_of(self._closed)
            if self._link is None or self._link.error is not None:
                self._link = await self._dial()
            link = self._link
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
        if self._link is not None:
            self._link.close(self._closed)


class _ActionServers(msgspec.Struct):
    """The answer of `rosapi/action_servers`."""

    action_servers: list[str]


class _ActionType(msgspec.Struct):
    """The answer of `rosapi/action_type`."""

    type: str


def _converted(values: object, kind: type[AnswerT]) -> AnswerT:
    """Return an answer of rosapi.

    Raises:
        ProtocolError: It is not of that kind.
    """
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as exc:
        raise ProtocolError(f"invalid answer of rosapi: {exc}") from exc


class RosbridgeEndpoint(Endpoint):
    """One action of a rosbridge server."""

    def __init__(self, connection: RosbridgeConnection, info: ActionInfo) -> None:
        self._connection = connection
        self._info = info
        self._name = ros_name(info.name)
        self._type_name = info.type_name
        try:
            self._values = ActionValues(info)
        except PayloadError as exc:
            raise TransportError(f"the action {info.name!r} cannot be used: {exc}") from exc

    @property
    def info(self) -> ActionInfo:
        return self._info

    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
        timeout: float | None = None,
        meta: Meta | None = None,
    ) -> FeedbackCursor:
        """See `Endpoint.send_goal`. rosbridge has no fields for the timeout and the meta, and no
        answer for an acceptance: see `accepted_after`. The server is asked for feedback in any case,
        which is the first sign that the goal runs.

        Raises:
            TransportError: The goal was sent before by this ID, and its stream is not in use.
        """
        connection = self._connection
        sent = connection.goals.get(goal_id)
        if sent is not None and sent.goal.digest != digest_of(goal):
            raise GoalRejected("its ID is in use by another goal", goal_id=goal_id)
        if sent is None:
            sent = await self._send(goal_id, goal)
        try:
            with anyio.move_on_after(connection.terms.accepted_after):
                await sent.decided()
        except (GoalRejected, ServerNotFound):
            connection.forget(goal_id)  # nothing was run, so it may be sent again
            raise
        sent.accept()
        return sent.stream(feedback=feedback)

    async def _send(self, goal_id: GoalID, goal: bytes) -> OutgoingGoal:
        connection = self._connection
        if connection.was_sent(goal_id):
            raise TransportError(
                f"goal {goal_id} was sent before, and rosbridge would run it a second time: send it"
                f" with a new ID if that is right"
            )
        try:
            args = arguments_text(goal)
        except PayloadError as exc:
            raise GoalRejected(str(exc), goal_id=goal_id) from exc
        link = await connection.link()
        if not self._type_name:
            self._type_name = await connection.type_of(self._name)
        sent = OutgoingGoal(goal_id, goal, self._name, self._values, connection.terms.window)
        message = send_goal_message(
            sent.request,
            self._name,
            self._type_name,
            args,
            cancel_on_disconnect=connection.terms.cancel_on_disconnect,
        )
        if len(message) > LARGEST_GOAL:
            raise InvalidMessage(
                f"the goal has {len(message)} bytes as JSON, and rosbridge takes {LARGEST_GOAL}"
            )
        connection.note_sent(goal_id)
        connection.goals[goal_id] = sent
        await link.send_goal(sent, message)
        return sent

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> FeedbackCursor:
        """See `Endpoint.feedback`.

        Raises:
            TransportError: The goal is not one that this connection has sent, or is not in use.
        """
        sent = self._connection.goals.get(goal_id)
        if sent is None:
            raise TransportError(
                f"rosbridge cannot follow goal {goal_id}: it is not a goal of this connection, and"
                f" rosbridge tells nothing about others"
            )
        return sent.stream(feedback=True, after=after, own=own)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """See `Endpoint.cancel_goals`. rosbridge does not answer the cancel of one goal, which
        counts as accepted when it was sent.

        Raises:
            TransportError: The goal is not one that this connection has sent, or a stamp is given
                as well.
        """
        if goal_id is None:
            return await self._cancel_all(stamp)
        connection = self._connection
        if stamp is not None or not connection.was_sent(goal_id):
            raise TransportError(
                f"rosbridge cannot cancel goal {goal_id}: it cancels one goal of this connection,"
                f" or goals of all clients by their time"
            )
        sent, link = connection.goals.get(goal_id), connection.opened_link()
        if sent is None or link is None or not link.has(sent):
            return CancelAnswer(CancelCode.GOAL_TERMINATED)
        await link.cancel(sent)
        canceling = GoalInfo(goal_id, sent.goal.stamp, GoalStatus.CANCELING, sent.count)
        return CancelAnswer(CancelCode.NONE, (canceling,))

    async def _cancel_all(self, stamp: int | None) -> CancelAnswer:
        values = await self._connection.call(
            f"{self._name}{CANCEL_SUFFIX}", cancel_arguments(stamp)
        )
        return cancel_answer(values)

    async def status(self) -> StatusStream:
        """Raise an error: rosbridge does not tell the goals of an action.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"rosbridge cannot list the goals of {self._info.name!r}: it knows those of a"
            f" connection only, and does not tell their statuses"
        )

    async def wait_for_server(self) -> None:
        """See `Endpoint.wait_for_server`. The server is looked for twice a second."""
        has_warned = False
        while True:
            began = current_time()
            try:
                if self._name in await self._connection.action_names():
                    return
            except CallFailed as exc:
                if not has_warned:
                    logger.warning("%s", excerpt(str(exc)))
                has_warned = True
            except (ServerNotFound, ConnectionLost):
                if self._connection.is_closed:
                    raise
            await anyio.sleep(max(0.0, began + PAUSE - current_time()))
