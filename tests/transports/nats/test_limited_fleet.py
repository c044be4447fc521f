"""Workers of a fleet that have a limit together, with a broker of NATS."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Schedule, connect, serve
from fibaction_transports.nats.names import FleetNames
from tests.support.nats_server import NatsServer
from tests.transports.hearing import Hearing
from tests.transports.nats.test_lost_streams import delete, renewals

pytestmark = [pytest.mark.anyio]
MOVE = Action("move", goal=str, feedback=int, result=str)
LEASE = 4.0


class Arms:
    """The arms that all workers of a test move."""

    def __init__(self) -> None:
        self.busy: Counter[str] = Counter()
        self.most: Counter[str] = Counter()
        self.order: list[str] = []
        self.has_begun = anyio.Event()
        self.go = anyio.Event()

    async def move(self, goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        arm, _, what = goal.request.partition(" ")
        self.busy[arm] += 1
        self.most[arm] = max(self.most[arm], self.busy[arm])
        self.order.append(goal.request)
        self.has_begun.set()
        try:
            if what == "waits":
                await self.go.wait()
            await anyio.lowlevel.checkpoint()
        finally:
            self.busy[arm] -= 1
        yield goal.request


def limit(**settings: Any) -> Schedule:
    """Return a schedule for one worker."""
    fields: dict[str, Any] = {"concurrency": 1, "queue": 99, "fleet_limit": "arms"}
    return Schedule(key=lambda goal: goal.partition(" ")[0], **fields | settings)


@asynccontextmanager
async def workers(url: str, arms: Arms, count: int) -> AsyncGenerator[None, None]:
    async with AsyncExitStack() as stack:
        for _ in range(count):
            server = ActionServer(MOVE, arms.move, schedule=limit())
            await stack.enter_async_context(serve(server, f"{url}?lease={LEASE:g}"))
        yield


@pytest.mark.promise("FLEET-12")
async def test_a_key_is_used_by_one_worker_at_a_time(shared_broker: NatsServer, fleet: str) -> None:
    arms, url = Arms(), shared_broker.url(fleet)
    async with workers(url, arms, 3), connect(url, MOVE) as client:
        sent = [f"{arm} {number}" for number in range(8) for arm in ("left", "right")]
        goals = [await client.send_goal(one) for one in sent]
        with anyio.fail_after(LEASE + 20):
            for goal in goals:
                await goal.result()
    assert arms.most == {"left": 1, "right": 1}
    assert sorted(arms.order) == sorted(sent)


@pytest.mark.promise("FLEET-8", "FLEET-12")
async def test_a_goal_keeps_its_place_when_the_stream_of_the_places_is_lost(
    shared_broker: NatsServer, fleet: str, log: Hearing
) -> None:
    arms, url, names = Arms(), shared_broker.url(fleet), FleetNames(fleet)
    async with workers(url, arms, 2), connect(url) as connection:
        client = ActionClient(connection.endpoint(MOVE), MOVE)
        first = await client.send_goal("left waits")
        with anyio.fail_after(LEASE + 5):
            await arms.has_begun.wait()
        others = [await client.send_goal(f"left {n}") for n in range(4)]
        await delete(shared_broker, names.keys)
        await log.told(f"the stream {names.keys} was lost, and with it the slots of keys", 2)
        await renewals(shared_broker, names, 8)  # for longer than a lease
        assert arms.order == ["left waits"]
        arms.go.set()
        with anyio.fail_after(20):
            for goal in (first, *others):
                await goal.result()
    assert arms.most == {"left": 1}
