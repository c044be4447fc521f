"""What is done with any endpoint: canceling several goals one by one."""

from __future__ import annotations

import anyio
import anyio.lowlevel
import pytest

from fibaction import ActionClient, ActionServer, CancelCode, ConnectionLost, GoalID, GoalStatus
from fibaction.border import endpoints
from fibaction.border.abc import Endpoint, ForwardingEndpoint, cancel_each
from fibaction.words.goals import CancelAnswer
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci

pytestmark = pytest.mark.anyio
GONE = GoalID(bytes(16))


class _OneIsGone(ForwardingEndpoint):
    """An endpoint with a goal that is lost when the others are canceled."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.asked = anyio.Event()

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        if goal_id == GONE:
            await self.asked.wait()
            raise ConnectionLost("it has no worker")
        self.asked.set()
        return await super().cancel_goals(goal_id, stamp)


async def test_a_goal_that_has_no_worker_delays_no_other_cancel_and_is_an_error() -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        client, endpoint = ActionClient(server, FIBONACCI), _OneIsGone(server)
        goals = [await client.send_goal(Goal(order=1000)) for _ in range(2)]
        with pytest.raises(ConnectionLost, match="it has no worker"):
            await cancel_each(endpoint, [GONE, *(goal.goal_id for goal in goals)])
        assert {(await goal.outcome()).status for goal in goals} == {GoalStatus.CANCELED}
        assert (await cancel_each(endpoint, [])).return_code is CancelCode.NONE


class _Counting(ForwardingEndpoint):
    """An endpoint that notes the goals it was asked about, and how many at the same time."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.asked: list[GoalID | None] = []
        self.most = self._now = 0

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        self.asked.append(goal_id)
        self._now += 1
        self.most = max(self.most, self._now)
        await anyio.lowlevel.checkpoint()
        self._now -= 1
        return CancelAnswer(CancelCode.NONE)


async def test_many_goals_are_canceled_in_their_order_a_bounded_number_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(endpoints, "CANCELS_AT_ONCE", 3)
    endpoint = _Counting(ActionServer(FIBONACCI, fibonacci))
    goals = [GoalID(bytes(15) + bytes([number])) for number in range(1, 11)]
    await cancel_each(endpoint, iter(goals))
    assert endpoint.asked == goals
    assert endpoint.most == 3
