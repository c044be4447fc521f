"""Bursts of feedback between two processes of fibaction: nothing is lost."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction import ActionClient, ClientConnection, connect
from tests.ros2.stock import orders
from tests.ros2.stock.ours import action
from tests.ros2.stock.process import peer
from tests.support.fibonacci import Feedback, Goal, Result

pytestmark = pytest.mark.anyio

MANY = 10_000


@pytest.fixture(scope="module", params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(scope="module")
async def connection(anyio_backend: str) -> AsyncGenerator[ClientConnection, None]:
    async with peer("ours", "serve_it", "many", anyio_backend), connect("ros2://") as found:
        await found.client(action("many")).wait_for_server(20)
        yield found


@pytest.fixture(scope="module")
def client(connection: ClientConnection) -> ActionClient[Goal, Feedback, Result]:
    return connection.client(action("many"))


async def test_ten_thousand_feedback_messages_of_one_goal_all_arrive_in_order(
    client: ActionClient[Goal, Feedback, Result],
) -> None:
    async with client.send_goal(Goal(orders.BURST + MANY)) as goal:
        numbers = [one.partial_sequence[0] async for one in goal.feedback]
        assert await goal.result() == Result([orders.BURST + MANY])

    assert len(numbers) == MANY
    assert numbers == list(range(MANY))
    assert goal.feedback_dropped == 0


async def test_the_feedback_of_many_goals_at_once_all_arrives(
    client: ActionClient[Goal, Feedback, Result],
) -> None:
    counts: list[tuple[int, int]] = []

    async def call() -> None:
        async with client.send_goal(Goal(orders.BURST + 100)) as goal:
            arrived = len([one async for one in goal.feedback])
            counts.append((arrived, goal.feedback_dropped))

    async with anyio.create_task_group() as tasks:
        for _ in range(50):
            tasks.start_soon(call)

    assert counts == [(100, 0)] * 50
