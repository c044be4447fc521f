"""Following all actions of a server, those that come later included."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeAlias

import anyio

from fibaction._api import ClientConnection
from fibaction.client.client import ActionClient
from fibaction.client.events import GoalFeedback
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import ActionError, TransportError
from fibaction.words.goals import GoalInfo

PERIOD = 1.0
"""Seconds between two looks for new actions, and the timeout of each look."""

MOST_ACTIONS = 200
"""Actions that are followed. Each needs a task and some requests."""

AnyClient: TypeAlias = ActionClient[Any, Any, Any]
"""A client of an action whose types are not known here; its messages are plain values."""


class ActionListener(ABC):
    """The receiver of all events of the actions that are followed."""

    @abstractmethod
    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        """Handle an action that is followed from now on, for the first time or again."""

    @abstractmethod
    def on_event(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        """Handle an event of a goal.

        Each time an action has been found, the first events are the statuses of all goals that its
        server knows.
        """

    @abstractmethod
    def on_action_lost(self, action: str, reason: str) -> None:
        """Handle an action that is no longer served, or that cannot be used from here.

        `on_action_found` is called again as soon as the action is back.
        """

    @abstractmethod
    def on_actions(self, actions: list[ActionInfo] | None, reason: str) -> None:
        """Handle the list of the actions that are served now.

        `actions` is None while the server does not answer, and `reason` then says why.
        """


async def follow_actions(
    connection: ClientConnection, listener: ActionListener, *, feedback: bool
) -> None:
    """Follow every action that is or will be served, until canceled.

    Actions after the first `MOST_ACTIONS` count as lost.

    Raises:
        ActionError: The server is not found; or the connection is lost and is not reopened.
    """
    actions: list[ActionInfo] | None = await connection.actions()
    reason = ""
    seen: set[str] = set()
    async with anyio.create_task_group() as tasks:
        while True:
            listener.on_actions(actions, reason)
            for info in actions or ():
                if info.name in seen:
                    continue
                seen.add(info.name)
                if len(seen) <= MOST_ACTIONS:
                    tasks.start_soon(_follow_if_usable, connection, info, listener, feedback)
                else:
                    text = f"it is not followed, because there are over {MOST_ACTIONS} actions"
                    listener.on_action_lost(info.name, text)
            actions, reason = await actions_after_pause(connection)


async def actions_after_pause(
    connection: ClientConnection,
) -> tuple[list[ActionInfo] | None, str]:
    """Wait for `PERIOD` seconds, and return the actions that are served then.

    Without an answer in time, return None and the reason.
    """
    await anyio.sleep(PERIOD)
    with anyio.move_on_after(PERIOD):
        try:
            return await connection.actions(), ""
        except ActionError as exc:
            return None, str(exc)
    return None, "it does not answer"


async def _follow_if_usable(
    connection: ClientConnection, info: ActionInfo, listener: ActionListener, feedback: bool
) -> None:
    try:
        client = connection.client(Action.untyped(info))
    except ActionError as exc:  # its ROS type is not installed here
        listener.on_action_lost(info.name, str(exc))
        return
    try:
        await follow_action(client, info, listener, feedback=feedback)
    except TransportError as exc:
        if type(exc) is not TransportError:  # the connection is lost
            raise
        listener.on_action_lost(info.name, str(exc))


async def follow_action(
    client: AnyClient, info: ActionInfo, listener: ActionListener, *, feedback: bool
) -> None:
    """Follow one action, even after restarts of its server, until canceled.

    Raises:
        TransportError: The transport cannot follow the goals of others, as that of rosbridge.
        ActionError: The connection is lost and is not reopened.
    """
    was_found = False
    while True:
        reason = "its server has stopped"
        try:
            async with client.events(feedback=feedback) as events:
                was_found = True
                listener.on_action_found(info, client)
                async for event in events:
                    listener.on_event(info.name, event)
        except ActionError as exc:
            if type(exc) is TransportError and not was_found:
                raise  # a later attempt would fail, too
            reason = str(exc)
        listener.on_action_lost(info.name, reason)
        await anyio.sleep(PERIOD)  # limits how often a permanent error is met
        await client.wait_for_server()
