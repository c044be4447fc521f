"""What a client asks for beside goals, and what it is told: a task works on each question.

It knows neither connections nor permissions: `find` asks for those, and `say` sends.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

from anyio import CancelScope

from fibaction.abc import Endpoint
from fibaction.goals import GoalID
from fibaction.messages import (
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
from fibaction.states import GoalStatus
from fibaction.wire.access import Verb
from fibaction.wire.flows import WaitingFlow, sendable

Question: TypeAlias = CancelGoals | WatchStatus | AwaitServer | ListActions | AskPeers
Answer: TypeAlias = CancelAnswered | Done | Watching | GoalChanged | Finished | Actions | Peers


class Answers:
    """Answers one client's questions."""

    def __init__(
        self,
        endpoints: Mapping[str, Endpoint],
        find: Callable[[str, Verb], Awaitable[Endpoint]],
        clients_of: Callable[[str], list[str]],
        say: Callable[[Answer], Awaitable[None]],
    ) -> None:
        """`find` gives the endpoint of an action, if the client may do that there; `clients_of`
        says who uses an action.
        """
        self._endpoints = endpoints
        self._find = find
        self._clients_of = clients_of
        self._say = say
        self._parts: dict[type, Callable[[Any, WaitingFlow], Awaitable[None]]] = {
            CancelGoals: self._cancel_goals,
            WatchStatus: self._watch_status,
            AwaitServer: self._await_server,
            ListActions: self._list_actions,
            AskPeers: self._ask_peers,
        }

    async def give(self, question: Question, flow: WaitingFlow) -> None:
        """Say all that there is to say to a question; of statuses, as much as its flow wants.

        Raises:
            ActionError: There is no answer, for that reason.
        """
        await self._parts[type(question)](question, flow)

    async def _cancel_goals(self, message: CancelGoals, _flow: WaitingFlow) -> None:
        endpoint = await self._find(message.action, Verb.CANCEL)
        goal_id = None if message.goal_id is None else GoalID(message.goal_id)
        answer = await endpoint.cancel_goals(goal_id, message.stamp)
        goals: list[tuple[bytes, int, GoalStatus]] = [
            (info.goal_id, info.stamp, info.status) for info in answer.goals_canceling
        ]
        await self._say(
            CancelAnswered(message.id, answer.return_code, goals, sendable(answer.reason))
        )

    async def _watch_status(self, message: WatchStatus, flow: WaitingFlow) -> None:
        endpoint = await self._find(message.action, Verb.OBSERVE)
        with await endpoint.status() as statuses:
            flow.stop_with(statuses.close)
            await self._say(Watching(message.id, statuses.known))
            while (info := await statuses.receive()) is not None:
                await flow.wait()
                if flow.closed:
                    break
                flow.credit -= 1
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

    async def _await_server(self, message: AwaitServer, flow: WaitingFlow) -> None:
        endpoint = await self._find(message.action, Verb.OBSERVE)
        with CancelScope() as scope:
            flow.stop_with(scope.cancel)
            await endpoint.wait_for_server()
            await self._say(Done(message.id))

    async def _ask_peers(self, message: AskPeers, _flow: WaitingFlow) -> None:
        await self._find(message.action, Verb.OBSERVE)
        await self._say(Peers(message.id, self._clients_of(message.action)))

    async def _list_actions(self, message: ListActions, _flow: WaitingFlow) -> None:
        infos = [endpoint.info for endpoint in self._endpoints.values()]
        await self._say(Actions(message.id, infos))
