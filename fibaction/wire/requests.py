"""`RequestHandlers`: the requests of a client beside goals. A task works on each.

They know neither connections nor permissions: `find` checks permissions, and `say` sends.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

from anyio import CancelScope

from fibaction.abc import Endpoint
from fibaction.goals import GoalID
from fibaction.states import GoalStatus
from fibaction.wire.auth import Permission
from fibaction.wire.errors import sendable
from fibaction.wire.messages import (
    Actions,
    AskPeers,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Done,
    Finished,
    GoalChanged,
    ListActions,
    Peers,
    Watching,
    WatchStatus,
)
from fibaction.wire.subscriptions import RequestSubscription

Request: TypeAlias = CancelGoals | WatchStatus | AwaitServer | ListActions | AskPeers
Answer: TypeAlias = CancelAnswered | Done | Watching | GoalChanged | Finished | Actions | Peers


class RequestHandlers:
    """Answers the requests of one client."""

    def __init__(
        self,
        endpoints: Mapping[str, Endpoint],
        find: Callable[[str, Permission], Awaitable[Endpoint]],
        clients_of: Callable[[str], list[str]],
        say: Callable[[Answer], Awaitable[None]],
    ) -> None:
        """Let `find` return the endpoint of an action, if the client has that permission for it,
        and `clients_of` the names of all clients that use an action.
        """
        self._endpoints = endpoints
        self._find = find
        self._clients_of = clients_of
        self._say = say
        self._handlers: dict[type, Callable[[Any, RequestSubscription], Awaitable[None]]] = {
            CancelGoals: self._cancel_goals,
            WatchStatus: self._watch_status,
            AwaitServer: self._await_server,
            ListActions: self._list_actions,
            AskPeers: self._ask_peers,
        }

    async def handle(self, request: Request, subscription: RequestSubscription) -> None:
        """Send all answers to a request; of statuses, as many as the client has credit for.

        Raises:
            ActionError: The request cannot be answered.
        """
        await self._handlers[type(request)](request, subscription)

    async def _cancel_goals(self, message: CancelGoals, _subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.CANCEL)
        goal_id = None if message.goal_id is None else GoalID(message.goal_id)
        answer = await endpoint.cancel_goals(goal_id, message.stamp)
        goals: list[tuple[bytes, int, GoalStatus]] = [
            (info.goal_id, info.stamp, info.status) for info in answer.goals_canceling
        ]
        await self._say(
            CancelAnswered(message.id, answer.return_code, goals, sendable(answer.reason))
        )

    async def _watch_status(self, message: WatchStatus, subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.OBSERVE)
        with await endpoint.status() as statuses:
            subscription.stop_with(statuses.close)
            await self._say(Watching(message.id, statuses.known))
            while (info := await statuses.receive()) is not None:
                await subscription.wait()
                if subscription.closed:
                    break
                subscription.credit -= 1
                changed = GoalChanged(
                    message.id,
                    info.goal_id,
                    info.stamp,
                    info.status,
                    statuses.dropped,
                    info.feedback_count,
                    info.client,
                )
                await self._say(changed)
            await self._say(Finished(message.id))

    async def _await_server(self, message: AwaitServer, subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.OBSERVE)
        with CancelScope() as scope:
            subscription.stop_with(scope.cancel)
            await endpoint.wait_for_server()
            await self._say(Done(message.id))

    async def _ask_peers(self, message: AskPeers, _subscription: RequestSubscription) -> None:
        await self._find(message.action, Permission.OBSERVE)
        await self._say(Peers(message.id, self._clients_of(message.action)))

    async def _list_actions(self, message: ListActions, _subscription: RequestSubscription) -> None:
        infos = [endpoint.info for endpoint in self._endpoints.values()]
        await self._say(Actions(message.id, infos))
