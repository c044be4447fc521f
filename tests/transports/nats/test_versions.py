"""New goals in a fleet whose workers are of several versions."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    RejectionCode,
    Schedule,
    connect,
    serve,
)
from fibaction.border.abc import Connection
from fibaction_transports.nats.worker import unreadable_goals
from tests.support.nats_server import NatsServer
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import NAMES, FakeFleet

MISSING = "goal.unit is missing"
UNREADABLE = "Object missing required field `unit`"


class First(msgspec.Struct):
    n: int


class Second(msgspec.Struct):
    n: int
    unit: str


class Third(msgspec.Struct):
    distance: float


def version(goal: type[Any]) -> Action[Any, int, str]:
    return Action("steps", goal=goal, feedback=int, result=str)


def steps(name: str, goal: type[Any], **settings: Any) -> ActionServer[Any, int, str]:
    """Return a server that ends its goals with a name, but those with a negative number."""

    async def execute(handle: GoalHandle[Any]) -> AsyncGenerator[str, None]:
        if getattr(handle.request, "n", 0) < 0:
            await anyio.sleep_forever()
        yield name

    return ActionServer(version(goal), execute, **settings)


class VersionedFleet:
    """Workers of several versions, and a client of one of them."""

    def __init__(self, stack: AsyncExitStack) -> None:
        self._stack = stack
        self.fleet = FakeFleet()

    async def add(self, name: str, goal: type[Any], **settings: Any) -> None:
        """Add a worker whose action has goals of this type."""
        worker = self.fleet.worker(name)
        await self._stack.enter_async_context(worker.serve(steps(name, goal, **settings)))

    async def client(self, goal: type[Any]) -> ActionClient[Any, int, str]:
        connection: Connection = await self._stack.enter_async_context(self.fleet.connect())
        return ActionClient(connection.endpoint(version(goal)), version(goal))


@pytest.fixture
async def mixed() -> AsyncGenerator[VersionedFleet, None]:
    async with AsyncExitStack() as stack:
        yield VersionedFleet(stack)


@pytest.mark.anyio
@in_virtual_time()
class TestNewGoals:
    async def test_one_that_no_worker_can_read_is_rejected_once_by_each_version(
        self, mixed: VersionedFleet
    ) -> None:
        for name in ("a", "b", "c"):
            await mixed.add(name, Second)
        await mixed.add("d", Third)
        client = await mixed.client(First)
        with pytest.raises(GoalRejected, match=MISSING) as caught:
            await client.call(First(1))
        assert caught.value.code is RejectionCode.UNREADABLE
        assert sorted(mixed.fleet.lines.dialed) == ["a", "d"]

    async def test_a_refusal_by_a_worker_that_can_read_it_is_the_answer(
        self, mixed: VersionedFleet
    ) -> None:
        def refuse(goal: First) -> None:
            raise GoalRejected("too far")

        await mixed.add("a", Second)
        await mixed.add("b", First, on_goal=refuse)
        client = await mixed.client(First)
        with pytest.raises(GoalRejected, match="too far"):
            await client.call(First(1))

    async def test_one_whose_readers_are_busy_is_rejected_as_busy(
        self, mixed: VersionedFleet
    ) -> None:
        await mixed.add("a", Second)
        for name in "bc":
            await mixed.add(name, First, schedule=Schedule(concurrency=1))
        client = await mixed.client(First)
        for _ in range(2):
            await client.send_goal(First(-1))
        for worker in "bc":  # as a worker without room does
            mixed.fleet.workers[worker].deafen()
        with pytest.raises(GoalRejected) as caught:
            await client.call(First(1))
        assert caught.value.is_busy

    async def test_an_answer_of_a_worker_whose_lease_has_ended_does_not_end_the_search(
        self, mixed: VersionedFleet
    ) -> None:
        def leave(goal: First) -> None:
            mixed.fleet.workers["a"].deafen()
            mixed.fleet.workers["a"].end_lease()
            mixed.fleet.workers["b"].listen(NAMES.offer("steps"))
            raise GoalRejected(MISSING, code=RejectionCode.UNREADABLE)

        await mixed.add("a", First, on_goal=leave)
        await mixed.add("b", First)
        mixed.fleet.workers["b"].deafen()
        client = await mixed.client(First)
        assert await client.call(First(1)) == "b"


@pytest.mark.asyncio
@pytest.mark.promise("FLEET-10")
async def test_a_new_goal_is_passed_on_to_a_worker_that_can_read_it(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    async with AsyncExitStack() as stack:
        for name, goal in (("new-1", Second), ("new-2", Second), ("old", First)):
            await stack.enter_async_context(serve(steps(name, goal), f"{url}?worker={name}"))
        client = await stack.enter_async_context(connect(url, version(First)))
        assert [await client.call(First(1)) for _ in range(20)] == ["old"] * 20
        newer = await stack.enter_async_context(connect(url, version(Second)))
        ended = {await newer.call(Second(1, "m")) for _ in range(40)}
        assert ended <= {"new-1", "new-2", "old"}, "an old worker ignores the field"
        third = await stack.enter_async_context(connect(url, version(Third)))
        with pytest.raises(GoalRejected, match='goal has no field "distance"') as caught:
            await third.call(Third(1.0))
        assert caught.value.code is RejectionCode.UNREADABLE


@pytest.mark.asyncio
@pytest.mark.promise("FLEET-11")
async def test_goals_that_no_living_worker_can_read_wait_until_a_worker_is_told_to_end_them(
    shared_broker: NatsServer, fleet: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unreadable_goals, "LEASES_UNTIL_END", 2)
    url = shared_broker.url(fleet, "?lease=2")
    async with AsyncExitStack() as stack:
        connection = await stack.enter_async_context(connect(url))
        client = connection.client(version(First))
        one = Schedule(concurrency=1, queue=9)
        async with serve(steps("old", First, schedule=one, at_stop="keep"), f"{url}&worker=old"):
            goals = [await client.send_goal(First(-1)) for _ in range(3)]
        for name in ("b", "c"):
            await stack.enter_async_context(serve(steps(name, Second), f"{url}&worker={name}"))
        await told(connection, {"steps": 3}, 2)
        waiting = await client.goals()
        assert [info.has_worker for info in waiting] == [False] * 3
        reader = steps("old", First, schedule=one, at_stop="keep")
        async with serve(reader, f"{url}&worker=old-again"):
            await told(connection, {}, 3)
        await told(connection, {"steps": 3}, 2)
        ending = steps("d", Second, unreadable="abort")
        await stack.enter_async_context(serve(ending, f"{url}&worker=d"))
        with anyio.fail_after(60):
            outcomes = [await goal.outcome() for goal in goals]
        assert {outcome.status for outcome in outcomes} == {GoalStatus.ABORTED}
        assert all(UNREADABLE in outcome.reason for outcome in outcomes)
        await told(connection, {}, 3)


async def told(connection: Connection, unreadable: dict[str, int], workers: int) -> None:
    """Wait until so many workers tell this in their leases."""
    with anyio.fail_after(60):
        while True:
            found = [worker.unreadable for worker in await connection.workers()]
            if found == [unreadable] * workers:
                return
            await anyio.sleep(0.1)
