"""What happens at all actions of a server, those that come later included, for as long as somebody
looks: what `echo`, `goals --watch` and `top` have in common.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable
from signal import SIGINT, SIGTERM
from typing import Any

import anyio

from fibaction._api import ClientConnection
from fibaction._tasks import Background
from fibaction.action import Action, ActionInfo
from fibaction.cli.ending import sentence_of
from fibaction.cli.goal_list import AnyClient
from fibaction.events import GoalFeedback
from fibaction.exceptions import ActionError
from fibaction.goals import GoalInfo

LOOK = 1.0
"""Seconds between two looks for new actions, and that an answer may take before the server is taken
to be away."""


class Observer(ABC):
    """Hears of what happens."""

    @abstractmethod
    def found(self, info: ActionInfo, client: AnyClient) -> None:
        """There is an action, which is followed from now on; again, after it was gone."""

    @abstractmethod
    def told(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        """Something has happened to one of its goals. Right after the beginning, and after its
        server was away, that is told of every goal that the server knows.
        """

    @abstractmethod
    def gone(self, action: str, why: str) -> None:
        """It is not served any more, or cannot be used from here; as soon as it can, it is
        found again.
        """

    @abstractmethod
    def reached(self, actions: list[ActionInfo] | None, why: str) -> None:
        """What is served now; None while the server does not answer."""


async def observe(connection: ClientConnection, observer: Observer, *, feedback: bool) -> None:
    """Follow every action that there is or will be. It has no end of its own.

    Raises:
        ActionError: There is no server; or the connection is lost, and will not be opened again.
    """
    actions: list[ActionInfo] | None = await connection.actions()
    why = ""
    followed: set[str] = set()
    async with anyio.create_task_group() as tasks:
        while True:
            observer.reached(actions, why)
            for info in actions or ():
                if info.name not in followed:
                    followed.add(info.name)
                    tasks.start_soon(_follow_one, connection, info, observer, feedback)
            await anyio.sleep(LOOK)
            actions, why = None, "it does not answer"
            with anyio.move_on_after(LOOK):
                try:
                    actions, why = await connection.actions(), ""
                except ActionError as exc:
                    why = sentence_of(exc)


async def _follow_one(
    connection: ClientConnection, info: ActionInfo, observer: Observer, feedback: bool
) -> None:
    try:
        client = connection.client(Action.untyped(info))
    except ActionError as exc:  # its ROS type is not installed here
        observer.gone(info.name, sentence_of(exc))
        return
    await follow_action(client, info, observer, feedback=feedback)


async def follow_action(
    client: AnyClient, info: ActionInfo, observer: Observer, *, feedback: bool
) -> None:
    """Follow one action. It has no end of its own.

    Raises:
        ActionError: The connection is lost, and will not be opened again.
    """
    while True:
        why = "its server has stopped"
        try:
            async with client.events(feedback=feedback) as events:
                observer.found(info, client)
                async for event in events:
                    observer.told(info.name, event)
        except ActionError as exc:
            why = sentence_of(exc)
        observer.gone(info.name, why)
        await anyio.sleep(LOOK)  # whatever it is, it is not to happen all the time
        await client.wait_for_server()


async def still_possible(clients: Iterable[AnyClient]) -> None:
    """Wait for a moment, unless there is no use in that.

    Raises:
        ActionError: The connection is lost, and will not be opened again.
    """
    with anyio.move_on_after(LOOK):
        for client in clients:
            return await client.wait_for_server()  # each would say the same
        await anyio.sleep(LOOK)


async def until_interrupted(body: Callable[[], Awaitable[object]]) -> bool:
    """Run something until it ends, or until Ctrl-C or SIGTERM; says whether that was it."""
    scope = anyio.CancelScope()

    async def obey() -> None:
        await anext(signals)
        scope.cancel()

    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with Background() as tasks:
            tasks.start_soon(obey)
            with scope:
                await body()
    return scope.cancelled_caught
