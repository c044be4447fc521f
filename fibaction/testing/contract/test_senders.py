"""Senders of goals: what a server is told of each, and executors that send steps of their own."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path
from typing import TypeAlias

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
    InvalidMessage,
    Parent,
    Sender,
    SqliteStore,
    Watcher,
)
from fibaction.border.abc import Meta
from fibaction.testing.contract.executors import FIBONACCI, Feedback, Goal, Result, Steps, fibonacci
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach
from fibaction.words.goals import child_id

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


MISSION = Action("mission", goal=int, feedback=int, result=list[int])
Items: TypeAlias = AsyncGenerator[int | list[int], None]
Arm: TypeAlias = ActionClient[Goal, Feedback, Result]


class Mission:
    """The executor of a parent with one step."""

    def __init__(self, arm: Arm, *, wait_for_end: bool = False) -> None:
        self._arm, self._wait_for_end = arm, wait_for_end
        self.kept: list[bool] = []
        """Whether the goal was kept, for each interruption."""

    async def __call__(self, goal: GoalHandle[int]) -> Items:
        step = goal.step("pick", wait_for_end=self._wait_for_end)
        try:
            async with self._arm.send_goal(Goal(goal.request), step=step) as picking:
                async for _ in picking.feedback:
                    yield goal.attempt
                result = await picking.result()
        except anyio.get_cancelled_exc_class():
            self.kept.append(goal.is_kept)
            raise
        yield result.sequence


@pytest.mark.promise("CHILD-1", "CHILD-2")
async def test_a_cancel_of_a_parent_reaches_its_child_and_waits_for_its_end(reach: Reach) -> None:
    child = Steps()
    child.clean = anyio.Event()
    async with reach(ActionServer(FIBONACCI, child)) as arm:
        mission = Mission(arm, wait_for_end=True)
        async with ActionServer(MISSION, mission) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await child.began.wait()
            expected = child_id(goal.goal_id, "fibonacci", "pick")
            follower = await arm.attach(expected)
            assert (await goal.cancel()).accepted
            while follower.status is not GoalStatus.CANCELING:
                await follower.feedback.stream.news.wait()
                follower.feedback.stream.take()
            assert goal.status is not GoalStatus.CANCELED
            child.clean.set()
            assert (await goal.outcome()).status is GoalStatus.CANCELED
            assert (await follower.outcome()).status is GoalStatus.CANCELED

    assert child.runs == {expected: 1}
    assert mission.kept == [False]


@pytest.mark.promise("CHILD-1", "CHILD-3")
async def test_a_planned_stop_leaves_a_child_and_the_next_attempt_follows_it(
    reach: Reach, tmp_path: Path
) -> None:
    child, store = Steps(), SqliteStore(tmp_path / "goals.db", sync="normal")
    async with reach(ActionServer(FIBONACCI, child)) as arm:
        mission = Mission(arm)
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await child.began.wait()
            await anext(goal.feedback)  # the child is accepted
        assert mission.kept == [True]
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            again = await ActionClient(server, MISSION).attach(goal.goal_id)
            child.go.set()
            assert await again.outcome() == End(GoalStatus.SUCCEEDED, [7])
            assert again.attempt == 2

    assert child.runs == {child_id(goal.goal_id, "fibonacci", "pick"): 1}


@pytest.mark.promise("CHILD-1")
async def test_a_child_that_ended_before_the_next_attempt_is_not_sent_again(
    reach: Reach, tmp_path: Path
) -> None:
    child, store = Steps(), SqliteStore(tmp_path / "goals.db", sync="normal")
    child.go.set()
    between = anyio.Event()

    async def mission(goal: GoalHandle[int]) -> Items:
        result = await arm.call(Goal(goal.request), step=goal.step("pick"))
        yield goal.attempt
        await between.wait()
        yield result.sequence

    async with reach(ActionServer(FIBONACCI, child)) as arm:
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            await anext(goal.feedback)
        between.set()
        async with ActionServer(MISSION, mission, store=store, at_stop="keep") as server:
            again = await ActionClient(server, MISSION).attach(goal.goal_id)
            assert await again.result() == [7]

    assert child.runs.total() == 1


@pytest.mark.promise("ACCEPT-16")
async def test_the_meta_of_a_child_names_its_parent(reach: Reach) -> None:
    child, metas = Steps(go=True), Metas()
    async with reach(ActionServer(FIBONACCI, child, watchers=[metas])) as arm:
        async with ActionServer(MISSION, Mission(arm)) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            assert await goal.result() == [7]

    assert [meta["parent"] for meta in metas.noted] == [str(goal.goal_id)]


@pytest.mark.promise("CHILD-4")
async def test_lists_and_followers_are_told_the_parent_of_a_child_also_after_its_end(
    reach: Reach,
) -> None:
    child = Steps()
    async with reach(ActionServer(FIBONACCI, child)) as arm, arm.events() as events:
        own = await arm.send_goal(Goal(1))
        async with ActionServer(MISSION, Mission(arm)) as server:
            goal = await ActionClient(server, MISSION).send_goal(7)
            told = Parent(goal.goal_id, "pick")
            expected = child_id(goal.goal_id, "fibonacci", "pick")
            event = await anext(events)
            while event.goal_id != expected or not isinstance(event, GoalInfo):
                event = await anext(events)
            assert event.parent == told
            follower = await arm.attach(expected)
            assert follower.feedback.stream.info.parent == told
            await goal.cancel()
            await follower.outcome()
        parents = {info.goal_id: info.parent for info in await arm.goals()}
        assert parents == {own.goal_id: None, expected: told}
        again = await arm.attach(expected)
        assert again.feedback.stream.info.parent == told
