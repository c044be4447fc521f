"""Streams that are deleted while workers serve, and a broker that comes back without them."""

from __future__ import annotations

import secrets
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle, connect, serve
from fibaction.words.errors import TransportError
from fibaction.words.goal_history import GoalHistory
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.lost_streams import LostStreams
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.worker.takeover import Takeover
from fibaction_transports.nats.workers import FleetWorkers
from tests.fleet.workers import Setup, workers
from tests.kills.victim import WORK, Done, Work
from tests.support.memory_broker import MemoryBrokers
from tests.support.nats_server import NatsServer
from tests.support.virtual_time import in_virtual_time
from tests.transports.hearing import Hearing
from tests.transports.nats.members import NAMES, member

pytestmark = [pytest.mark.anyio]
COUNT = Action("count", goal=int, feedback=str, result=int)
LEASE = 6.0
"""Long enough that a busy machine does not keep a worker from renewing its lease in time."""
IN_TIME = LEASE + 2


class Worker:
    """A worker whose goals above 0 end when the test says so."""

    def __init__(self) -> None:
        self.go = anyio.Event()
        self.attempts: list[tuple[int, int]] = []

    async def count(self, goal: GoalHandle[int]) -> AsyncGenerator[str | int, None]:
        self.attempts.append((goal.request, goal.attempt))
        yield "begun"
        if goal.request:
            await self.go.wait()
        yield goal.request


@asynccontextmanager
async def serving(url: str) -> AsyncGenerator[Worker, None]:
    worker = Worker()
    server = ActionServer(COUNT, worker.count, recovery="rerun")
    async with serve(server, url):
        yield worker


async def delete(server: NatsServer, *streams: str) -> None:
    """Delete streams as an operator does."""
    async with open_broker(FleetSettings("x", (server.address,))) as broker:
        for stream in streams:
            await jetstream.call(broker, f"STREAM.DELETE.{stream}")


async def renewals(server: NatsServer, names: FleetNames, count: int) -> None:
    """Wait until workers have renewed their leases so many times."""
    async with open_broker(FleetSettings("x", (server.address,))) as broker:
        async with broker.watch(names.workers, names.worker()) as watch:
            with anyio.fail_after(30):
                while count > 0:
                    count -= len(await watch.next() or ())


async def all_know(log: Hearing, count: int, streams: list[str]) -> None:
    """Wait until so many workers have told the loss of each stream."""
    for stream in streams:
        await log.told(f"the stream {stream} was lost", count)


Names = Callable[[FleetNames], str]
ALL: list[Names] = [
    lambda names: names.goals,
    lambda names: names.workers,
    lambda names: names.notes,
]


@pytest.mark.promise("FLEET-8")
async def test_a_fleet_goes_on_when_streams_are_deleted(
    shared_broker: NatsServer, log: Hearing
) -> None:
    # Four fleets at once: each is watched for longer than a lease.
    async with anyio.create_task_group() as tasks:
        for lost in (ALL[:1], ALL[1:2], ALL[2:], ALL):
            tasks.start_soon(a_fleet_goes_on_without, lost, shared_broker, log)
    assert not [line for line in log.warnings if "is gone" in line or "gives up" in line]


async def a_fleet_goes_on_without(lost: list[Names], broker: NatsServer, log: Hearing) -> None:
    fleet = secrets.token_hex(4)
    names, url = FleetNames(fleet), broker.url(fleet, f"?lease={LEASE:g}")
    streams = [one(names) for one in lost]
    async with (
        serving(url) as one,
        serving(url) as two,
        connect(broker.url(fleet)) as connection,
    ):
        client = ActionClient(connection.endpoint(COUNT), COUNT)
        goals = [await client.send_goal(number) for number in (1, 2, 3, 4)]
        await delete(broker, *streams)
        await all_know(log, 2, streams)
        with anyio.fail_after(IN_TIME):
            assert await client.call(0) == 0
        await renewals(broker, names, 8)  # for longer than a lease
        for worker in (one, two):
            worker.go.set()
        with anyio.fail_after(30):
            assert [await goal.result() for goal in goals] == [1, 2, 3, 4]
    assert sorted(one.attempts + two.attempts) == [(number, 1) for number in range(5)]


@pytest.mark.promise("FLEET-8")
async def test_a_fleet_goes_on_when_its_broker_comes_back_without_its_storage(
    own_broker: NatsServer, fleet: str, log: Hearing
) -> None:
    names = FleetNames(fleet)
    async with (
        serving(own_broker.url(fleet, f"?lease={LEASE:g}")) as one,
        serving(own_broker.url(fleet, f"?lease={LEASE:g}")) as two,
        connect(own_broker.url(fleet)) as connection,
    ):
        client = ActionClient(connection.endpoint(COUNT), COUNT)
        goals = [await client.send_goal(number) for number in (1, 2, 3, 4)]
        own_broker.kill()
        own_broker.lose_data()
        own_broker.start()
        await all_know(log, 2, [names.workers, names.goals, names.notes])
        with anyio.fail_after(IN_TIME):
            assert await client.call(0) == 0
        for worker in (one, two):
            worker.go.set()
        with anyio.fail_after(8):
            assert [await goal.result() for goal in goals] == [1, 2, 3, 4]
    assert sorted(one.attempts + two.attempts) == [(number, 1) for number in range(5)]


@pytest.mark.promise("FLEET-8")
async def test_goals_of_a_lost_worker_are_taken_over_in_time_when_the_notes_were_deleted(
    shared_broker: NatsServer, fleet: str, log: Hearing, tmp_path: Path
) -> None:
    names, url = FleetNames(fleet), shared_broker.url(fleet, f"?lease={LEASE:g}")
    setup = Setup("lost", f"{url}&worker=lost", str(tmp_path / "diary"), "rerun")

    async def work(goal: GoalHandle[Work]) -> AsyncGenerator[Done, None]:
        yield Done(goal.request.steps, goal.attempt)

    async with workers(setup) as [lost], connect(shared_broker.url(fleet)) as connection:
        client = ActionClient(connection.endpoint(WORK), WORK)
        goals = [await client.send_goal(Work(number, 99)) for number in (1, 2, 3)]
        async with serve(ActionServer(WORK, work, recovery="rerun"), url):
            await delete(shared_broker, names.notes)
            await all_know(log, 1, [names.notes])
            lost.kill()
            with anyio.fail_after(IN_TIME):
                for goal, number in zip(goals, (1, 2, 3), strict=True):
                    assert await goal.result() == Done(number, 2)


@in_virtual_time()
async def test_a_stream_that_was_opened_for_several_limits_is_made_again_once() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        workers = FleetWorkers(a.broker, NAMES, a.journals.tasks, 5)
        lost = LostWorkers(a.broker, NAMES, a.membership, workers)
        streams = LostStreams(a.journals, Takeover(a.journals, workers, lost), 1)
        await streams.open()
        for _ in range(3):
            await streams.open_keys(lambda: None)
        made: list[str] = []

        async def note(call: str, subject: str) -> None:
            if call == "create_streams":
                made.append(subject)

        a.broker.before = note
        shared.stream = None
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(streams.run)
            await anyio.sleep(0.5)  # of virtual time: the first look, and no second one
            tasks.cancel_scope.cancel()
        assert made == ["keys"]


async def test_a_stream_that_could_not_be_opened_is_not_made_with_those_that_are_lost() -> None:
    class Refusing:
        """A broker that has no room for the streams of keys and of the past."""

        async def create_streams(
            self, *_: object, has_keys: bool, history: object, **_more: object
        ) -> None:
            if has_keys or history:
                raise TransportError("there is no room for it")
            made.append("the others")

    made = list[str]()
    parts: Any = SimpleNamespace(
        broker=Refusing(), names=NAMES, membership=SimpleNamespace(rewrite=list)
    )
    taken: Any = None
    streams = LostStreams(parts, taken, 1)
    with pytest.raises(TransportError):
        await streams.open_keys(lambda: None)
    with pytest.raises(TransportError):
        await streams.open_history(GoalHistory())
    await streams._make(streams._more)
    assert made == ["the others"]
