"""`RemoteEndpoint`: an action whose server is at the other end of a connection."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import Any

from fibaction._runtime.text import shortened
from fibaction.border.abc import Endpoint, GoalRequest
from fibaction.types.action import ActionInfo
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.client.reconnect import Reconnector
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.client.remote_statuses import RemoteStatuses
from fibaction.wire.messages import (
    LARGEST,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Done,
    Follow,
)
from fibaction.words.errors import ConnectionLost, LimitReached, ServerNotFound
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID, GoalInfo


class RemoteEndpoint(Endpoint):
    """An action whose server is at the other end of a connection."""

    def __init__(self, calls: OpenCalls, reconnector: Reconnector, info: ActionInfo) -> None:
        self._calls = calls
        self._reconnector = reconnector
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info

    def offer_goal(self, request: GoalRequest) -> Coroutine[Any, Any, RemoteGoal]:
        return self._calls.send(self._info.name, request)

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> RemoteGoal:
        if after is not None:
            after = min(max(after, 0), LARGEST)  # as the server would do
        return await self._calls.follow(
            goal_id,
            lambda call_id, credit: Follow(
                call_id, self._info.name, goal_id, after, own, credit, attempt
            ),
        )

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        if stamp:  # 0 is not a stamp; a number that cannot be sent keeps its meaning
            stamp = min(max(stamp, 1), LARGEST)
        answer: CancelAnswered = await self._calls.ask(
            lambda call_id: CancelGoals(call_id, self._info.name, goal_id, stamp), CancelAnswered
        )
        goals = tuple(
            GoalInfo(GoalID(goal), accepted, status) for goal, accepted, status in answer.goals
        )
        return CancelAnswer(CancelCode(answer.return_code), goals, shortened(answer.reason))

    async def status(self) -> RemoteStatuses:
        return await self._calls.follow_statuses(self._info.name)

    async def wait_for_server(self) -> None:
        while True:
            changes = self._reconnector.changes
            try:
                await self._calls.ask(lambda call_id: AwaitServer(call_id, self._info.name), Done)
                return
            except (ServerNotFound, ConnectionLost, LimitReached) as exc:
                if isinstance(exc, LimitReached) and self._reconnector.is_open:
                    raise  # too many requests are open on this connection
                await self._reconnector.changed(changes)
