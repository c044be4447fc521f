"""Leaving the block of `connect`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    ConnectionLost,
    GoalCanceled,
    GoalStatus,
)
from fibaction.testing.contract.executors import FIBONACCI, Feedback, Goal, Result, Steps
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio

Client = ActionClient[Goal, Feedback, Result]


async def calls(client: Client) -> None:
    await client.call(Goal(1))


async def calls_with_feedback(client: Client) -> None:
    await client.call(Goal(1), on_feedback=print)


async def follows_in_a_block(client: Client) -> None:
    async with client.send_goal(Goal(1)) as goal:
        async for _ in goal.feedback:
            pass
        await goal.result()


@pytest.mark.promise("CANCEL-22")
@pytest.mark.parametrize("use", [calls, calls_with_feedback, follows_in_a_block])
async def test_leaving_a_connection_cancels_the_goals_of_its_blocks_in_other_tasks(
    reach: Reach, use: Callable[[Client], Awaitable[None]], caplog: pytest.LogCaptureFixture
) -> None:
    held = Steps()
    clients: list[Client] = []
    has_client = anyio.Event()

    async def use_it() -> None:
        await has_client.wait()
        with pytest.raises((ConnectionLost, GoalCanceled)):
            await use(clients[0])

    with anyio.fail_after(10):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(use_it)
            await anyio.wait_all_tasks_blocked()
            async with reach(ActionServer(FIBONACCI, held)) as client:
                clients.append(client)
                has_client.set()
                await held.began.wait()
    assert held.ended_as == [GoalStatus.CANCELING]
    assert "could not be canceled" not in caplog.text


@pytest.mark.promise("LOSS-2")
async def test_what_is_followed_over_a_connection_ends_with_it(reach: Reach) -> None:
    held = Steps()
    async with reach(ActionServer(FIBONACCI, held)) as client:
        goal = await client.send_goal(Goal(1))
        statuses = await client.endpoint.status()
        await statuses.listed()
        await held.began.wait()
    for wait in (goal.outcome, statuses.receive, client.goals):
        with anyio.fail_after(30), pytest.raises(ConnectionLost, match="was closed here"):
            for _ in range(10):  # after what had arrived
                await wait()
    assert held.ended_as == [GoalStatus.EXECUTING], "an awaited goal goes on until the server stops"
