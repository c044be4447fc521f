"""What becomes of goals when the block of `connect` is left, and of endpoints that are wrapped."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    ConnectionLost,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalStatus,
    connect,
    serve,
)
from fibaction.abc import ForwardingEndpoint, GoalStream
from fibaction.goals import UNKNOWN_SENDER, Sender
from tests.contract.conftest import Reach
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio

Client = ActionClient[Goal, Feedback, Result]


class Held:
    """An executor that runs until it is interrupted, and notes the goal's status then."""

    def __init__(self) -> None:
        self.runs = anyio.Event()
        self.ended_as: list[GoalStatus] = []

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        self.runs.set()
        try:
            await anyio.sleep_forever()
        finally:
            self.ended_as.append(goal.status)
        yield Result([])


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
    held = Held()
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
                await held.runs.wait()
    assert held.ended_as == [GoalStatus.CANCELING]
    assert "could not be canceled" not in caplog.text


async def test_what_is_followed_over_a_connection_ends_with_it(reach: Reach) -> None:
    held = Held()
    async with reach(ActionServer(FIBONACCI, held)) as client:
        goal = await client.send_goal(Goal(1))
        statuses = await client.endpoint.status()
        await statuses.listed()
        await held.runs.wait()
    for wait in (goal.outcome, statuses.receive, client.goals):
        with anyio.fail_after(5), pytest.raises(ConnectionLost, match="was closed here"):
            for _ in range(10):  # after what had arrived
                await wait()
    assert held.ended_as == [GoalStatus.EXECUTING], "an awaited goal goes on until the server stops"


class Audited(ForwardingEndpoint):
    """A wrapper that notes who sends goals."""

    def __init__(self, inner: ActionServer[Goal, Feedback, Result]) -> None:
        super().__init__(inner)
        self.senders: list[Sender] = []

    async def send_goal(
        self,
        goal_id: GoalID,
        goal: bytes,
        *,
        feedback: bool = True,
        sender: Sender = UNKNOWN_SENDER,
    ) -> GoalStream:
        self.senders.append(sender)
        return await super().send_goal(goal_id, goal, feedback=feedback, sender=sender)


async def test_a_server_that_is_wrapped_is_started_served_and_stopped() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    wrapper = Audited(server)
    async with serve(wrapper, "tcp://127.0.0.1:0") as (url,), connect(url, FIBONACCI) as client:
        assert server.is_running
        assert await client.call(Goal(2)) == Result([0, 1, 1])
        (info,) = await client.goals()
    (sender,) = wrapper.senders
    assert info.client == sender.name != ""
    assert sender.owner != b""
    assert not server.is_running
