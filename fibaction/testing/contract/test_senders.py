"""The client that sent a goal, as `on_goal` and the executor know it."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import ActionServer, GoalHandle, GoalRejected, Sender
from fibaction.testing.contract.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


class Noting:
    """An executor and an `on_goal` that note the sender of each goal, by its order."""

    def __init__(self) -> None:
        self.executed: dict[int, Sender] = {}
        self.asked: dict[int, Sender] = {}

    async def execute(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        self.executed[goal.request.order] = goal.sender
        async for item in fibonacci(goal):
            yield item

    def on_goal(self, goal: Goal, sender: Sender) -> None:
        self.asked[goal.order] = sender
        if goal.order > 10:
            raise GoalRejected("too much")

    async def on_goal_later(self, goal: Goal, sender: Sender) -> None:
        await anyio.lowlevel.checkpoint()
        self.on_goal(goal, sender)


@pytest.mark.promise("ACCEPT-15")
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
async def test_on_goal_and_the_executor_know_the_same_sender(
    reach: Reach, asynchronous: bool
) -> None:
    noting = Noting()
    on_goal = noting.on_goal_later if asynchronous else noting.on_goal
    async with reach(ActionServer(FIBONACCI, noting.execute, on_goal=on_goal)) as client:
        for order in (3, 4):
            await client.call(Goal(order))
        with pytest.raises(GoalRejected):
            await client.call(Goal(11))
        clients = {info.client for info in await client.goals()}
    assert noting.executed.keys() == {3, 4}
    assert noting.asked.keys() == {3, 4, 11}
    # With one client there is one sender, whatever is known of it.
    (sender,) = {*noting.executed.values(), *noting.asked.values()}
    assert clients == {str(sender)}


@pytest.mark.promise("EXECUTE-11")
async def test_two_clients_are_two_senders(reach: Reach) -> None:
    noting = Noting()
    server = ActionServer(FIBONACCI, noting.execute, on_goal=noting.on_goal)
    async with reach.two_clients(server) as (one, other):
        for order, client in enumerate((one, other, one, other)):
            await client.call(Goal(order))
    owners = [noting.executed[order].owner for order in range(4)]
    assert owners[:2] == owners[2:]
    assert len(set(owners)) == 2
    assert all(owners)


@pytest.mark.promise("EXECUTE-11")
async def test_the_sender_has_the_name_of_its_token_and_its_address(reach: Reach) -> None:
    noting = Noting()
    server = ActionServer(FIBONACCI, noting.execute, on_goal=noting.on_goal)
    async with reach.named_clients(server, "ann", "bob") as (ann, bob):
        await ann.call(Goal(1))
        await bob.call(Goal(2))
        clients = [info.client for info in await ann.goals()]
    senders = [noting.executed[order] for order in (1, 2)]
    assert [sender.name for sender in senders] == ["ann", "bob"]
    assert all(sender.address for sender in senders)
    assert clients == [f"{sender.name} at {sender.address}" for sender in senders]
