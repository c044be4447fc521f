"""What a server is told beside a goal: the client that sent it, and its meta, for traces."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalID,
    GoalRejected,
    InvalidMessage,
    Sender,
    Watcher,
)
from fibaction.border.abc import Meta
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


GOAL = FIBONACCI.goal.encode(Goal(3))


class Metas(Watcher):
    """A watcher that notes the meta of each goal."""

    def __init__(self) -> None:
        self.noted: list[dict[str, str]] = []

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self.noted.append(dict(meta))


@pytest.mark.promise("ACCEPT-16")
async def test_the_meta_of_a_goal_reaches_the_watchers(reach: Reach) -> None:
    metas = Metas()
    meta = {"traceparent": "00-" + "0af7" * 8 + "-" + "b7ad" * 4 + "-01", "baggage": "käse=ja"}
    async with reach(ActionServer(FIBONACCI, fibonacci, watchers=[metas])) as client:
        for carried in (meta, None, {}):
            stream = await client.endpoint.send_goal(GoalID.random(), GOAL, meta=carried)
            await stream.outcome()
        await client.call(Goal(1))

    assert metas.noted == [meta, {}, {}, {}]


@pytest.mark.promise("ACCEPT-16")
async def test_a_meta_over_the_limits_is_an_error_and_nothing_is_sent(reach: Reach) -> None:
    metas = Metas()
    async with reach(ActionServer(FIBONACCI, fibonacci, watchers=[metas])) as client:
        for meta in ({"a": "x" * 4096}, {str(number): "" for number in range(9)}):
            with pytest.raises(InvalidMessage, match=r"^the goal's meta has .* the limit$"):
                await client.endpoint.send_goal(GoalID.random(), GOAL, meta=meta)
        await client.call(Goal(1))

    assert metas.noted == [{}]


@pytest.mark.promise("ACCEPT-19")
async def test_lists_have_the_labels_of_a_goal_also_after_its_end(reach: Reach) -> None:
    labels = {"order": "17", "site": "käse"}
    async with reach(ActionServer(FIBONACCI, fibonacci)) as client:
        async with client.send_goal(Goal(3), labels=labels) as goal:
            first = {info.goal_id: info.labels for info in await client.goals()}
            await goal.result()
        await client.call(Goal(1), labels={"order": "18"})
        await client.call(Goal(1))
        last = [info.labels for info in await client.goals()]
        with pytest.raises(ValueError, match="'parent' is not the key of a label"):
            await client.call(Goal(1), labels={"parent": "17"})

    assert first == {goal.goal_id: labels}
    assert last == [labels, {"order": "18"}, {}]
