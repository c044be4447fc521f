"""`RosbridgeConnection`: the actions of a rosbridge server for clients, each an endpoint."""

from __future__ import annotations

from typing import Any

import anyio
import msgspec
from anyio import current_time

from fibaction.border.abc import Connection, Endpoint, GoalRequest, StatusStream
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.schema.payload import PayloadError
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import (
    ConnectionLost,
    GoalRejected,
    InvalidMessage,
    RejectionCode,
    ServerNotFound,
    TransportError,
)
from fibaction.words.goals import (
    ID_IN_USE,
    ActionPeers,
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    digest_of,
)
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.action_values import ActionValues, arguments_text
from fibaction_transports.web.rosbridge.client.goal import OutgoingGoal
from fibaction_transports.web.rosbridge.client.link import CallFailed
from fibaction_transports.web.rosbridge.client.link_opener import LinkKeeper
from fibaction_transports.web.rosbridge.server.rosapi import (
    CANCEL_SUFFIX,
    cancel_answer,
    cancel_arguments,
    ros_name,
)

LOOK_PAUSE = 0.5
"""Seconds between two looks for a server that is not there."""
LARGEST_GOAL = 10_000_000
"""Bytes of the largest message that rosbridge servers accept, if nothing else is set there."""

logger = clean_logger("fibaction.web")


class RosbridgeConnection(Connection):
    """The actions of one rosbridge server."""

    def __init__(self, keeper: LinkKeeper) -> None:
        self._keeper = keeper

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """See `Connection.endpoint`.

        Raises:
            TransportError: The schemas of the action cannot be used.
        """
        return RosbridgeEndpoint(
            self._keeper, action.info if isinstance(action, Action) else action
        )

    async def actions(self) -> list[ActionInfo]:
        """See `Connection.actions`. The schemas are those that rosapi tells, or empty."""
        return [await self._described(name) for name in await self._keeper.action_names()]

    async def peers(self, action: str) -> ActionPeers:
        """See `Connection.peers`. It is the rosbridge server; rosapi tells no clients."""
        names = [name.removeprefix("/") for name in await self._keeper.action_names()]
        return ActionPeers((self._keeper.url,) if action in names else ())

    async def _described(self, name: str) -> ActionInfo:
        type_name = await self._keeper.type_of(name)
        schemas = await self._keeper.schemas_of(type_name)
        return ActionInfo(name.removeprefix("/"), type_name, *schemas)


class RosbridgeEndpoint(Endpoint):
    """One action of a rosbridge server."""

    def __init__(self, keeper: LinkKeeper, info: ActionInfo) -> None:
        self._keeper = keeper
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

    async def offer_goal(self, request: GoalRequest) -> FeedbackCursor:
        """See `Endpoint.offer_goal`. rosbridge has no fields for the deadline and the meta, and no
        answer for an acceptance: see `accepted_after`. The server is asked for feedback in
        any case: it is the first sign that the goal runs.

        Raises:
            TransportError: The goal was sent before by this ID, and its stream is not in use.
        """
        keeper, goal_id = self._keeper, request.goal_id
        sent = keeper.goals.get(goal_id)
        if sent is not None and sent.digest != digest_of(request.goal):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id, code=RejectionCode.DUPLICATE)
        if sent is None:
            sent = await self._send(goal_id, request.goal)
        try:
            with anyio.move_on_after(keeper.terms.accepted_after):
                await sent.decided()
        except (GoalRejected, ServerNotFound):
            keeper.forget(goal_id)  # nothing was run, so it may be sent again
            raise
        sent.accept()
        return sent.stream(feedback=request.feedback)

    async def _send(self, goal_id: GoalID, goal: bytes) -> OutgoingGoal:
        keeper = self._keeper
        if keeper.was_sent(goal_id):
            raise TransportError(
                f"goal {goal_id} was sent before, and rosbridge would run it a second time: send it"
                f" with a new ID if that is right"
            )
        try:
            args = arguments_text(goal)
        except PayloadError as exc:
            raise GoalRejected(str(exc), goal_id=goal_id, code=RejectionCode.INVALID) from exc
        link = await keeper.link()
        if not self._type_name:
            self._type_name = await keeper.type_of(self._name)
        sent = OutgoingGoal(goal_id, goal, self._name, self._values, keeper.terms.window)
        members = {
            "op": "send_action_goal",
            "id": sent.request,
            "action": self._name,
            "action_type": self._type_name,
            "args": msgspec.Raw(args.encode()),
            "feedback": True,
        }
        if keeper.terms.cancel_on_disconnect:
            members["cancel_on_disconnect"] = True
        message = msgspec.json.encode(members)
        if len(message) > LARGEST_GOAL:
            raise InvalidMessage(
                f"the goal has {len(message)} bytes as JSON, and rosbridge takes {LARGEST_GOAL}"
            )
        keeper.note_sent(goal_id, sent)
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
        sent = self._keeper.goals.get(goal_id)
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
            arguments = cancel_arguments(stamp)
            return cancel_answer(await self._keeper.call(f"{self._name}{CANCEL_SUFFIX}", arguments))
        keeper = self._keeper
        if stamp is not None or not keeper.was_sent(goal_id):
            raise TransportError(
                f"rosbridge cannot cancel goal {goal_id}: it cancels one goal of this connection,"
                f" or goals of all clients by their time"
            )
        sent, link = keeper.goals.get(goal_id), keeper.opened
        if sent is None or link is None or not link.has(sent):
            return CancelAnswer(CancelCode.GOAL_TERMINATED)
        await link.cancel(sent)
        canceling = GoalInfo(goal_id, sent.goal.stamp, GoalStatus.CANCELING, sent.count)
        return CancelAnswer(CancelCode.NONE, (canceling,))

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
                if self._name in await self._keeper.action_names():
                    return
            except CallFailed as exc:
                if not has_warned:
                    logger.warning("%s", excerpt(str(exc)))
                has_warned = True
            except (ServerNotFound, ConnectionLost):
                if self._keeper.is_closed:
                    raise
            await anyio.sleep(max(0.0, began + LOOK_PAUSE - current_time()))
