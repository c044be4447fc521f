"""The costs that limit a fleet: of a renewal of a lease, of telling it, and of a scan of the goals.

    python -m tests.tools.benchmarks.fleet_limits

Each cost is the time of the processor of one process, so it does not depend on what else the
machine does. From it follows how many workers one broker carries: each of N workers renews its
lease three times within it, and each of the others is told.
"""

from __future__ import annotations

import os
import time
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import NamedTuple

import anyio

from fibaction import GoalID
from fibaction._runtime.notify import Notifier
from fibaction._runtime.tasks import Background
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import Sender
from fibaction_transports.nats.broker.broker import Broker, PutError
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import GoalEntry, LeaseEntry, encode
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.lease import RENEWALS
from fibaction_transports.nats.workers import FleetWorkers
from tests.fleet.servers import Servers, servers
from tests.support.nats_server import PROGRAM

NAMES = FleetNames("limits")
LEASES, ROUNDS, WATCHERS, GOALS = 200, 20, 20, 20_000
AT_ONCE = 500
"""Writes that wait for their answers."""
LEASE = 15.0


class Spent(NamedTuple):
    """Seconds: those that have passed, and those of the processor."""

    passed: float
    here: float
    broker: float


class Clock:
    """Measures what a part of the program costs here and at the brokers."""

    def __init__(self, running: Servers) -> None:
        self._pids = [one.pid for one in running.by_name.values()]
        self._began = self._now()

    def _now(self) -> Spent:
        broker = sum(_processor(pid) for pid in self._pids)
        return Spent(time.perf_counter(), time.process_time(), broker)

    def spent(self) -> Spent:
        """Return what was spent since the beginning."""
        return Spent(*(now - began for now, began in zip(self._now(), self._began, strict=True)))


def _processor(pid: int) -> float:
    """Return the seconds of the processor that a process has had."""
    with open(f"/proc/{pid}/stat") as stat:
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Writer:
    """Writes records, some hundred at a time."""

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self._sequences: dict[str, int] = {}
        self._open = 0
        self._news = Notifier()

    async def write(self, subject: str, data: bytes, ttl: float) -> None:
        while self._open >= AT_ONCE:
            await self._news.wait()
        self._open += 1

        def then(outcome: int | PutError) -> None:
            assert isinstance(outcome, int), outcome
            self._sequences[subject] = outcome
            self._open -= 1
            self._news.notify()

        expected = self._sequences.get(subject, 0)
        self._broker.put(subject, data, expected=expected, ttl=ttl, then=then)

    async def written(self) -> None:
        while self._open:
            await self._news.wait()

    async def renew(self, since: int) -> None:
        """Renew the leases of all workers, as often as `ROUNDS` says."""
        for number in range(ROUNDS):
            for worker in range(LEASES):
                await self.lease(f"w{worker}", since + number)
            await self.written()
        await self.lease(f"last{since}", since)

    async def lease(self, worker: str, since: int) -> None:
        entry = LeaseEntry(worker, bytes(8), since, 3600.0)
        await self.write(NAMES.worker(worker), encode(entry), 3600.0)


@asynccontextmanager
async def watcher(settings: FleetSettings) -> AsyncGenerator[FleetWorkers, None]:
    async with open_broker(settings) as broker, Background() as tasks:
        workers = FleetWorkers(broker, NAMES, tasks, 60)
        await workers.ready()
        yield workers


async def told(workers: FleetWorkers, since: int) -> None:
    """Wait until the last renewal is known: that of a new worker, which is news."""
    with anyio.fail_after(60):
        while workers.get(f"last{since}") is None:
            await workers.news.wait()


async def renewals(writer: Writer, settings: FleetSettings, running: Servers) -> tuple[float, ...]:
    """Print the costs of renewals, and return those of one write, one telling and one reading."""
    count = ROUNDS * LEASES
    await writer.renew(0)
    clock = Clock(running)
    await writer.renew(100)
    alone = clock.spent()
    async with AsyncExitStack() as stack:
        watchers = [await stack.enter_async_context(watcher(settings)) for _ in range(WATCHERS)]
        clock = Clock(running)
        await writer.renew(200)
        for one in watchers:
            await told(one, 200)
        watched = clock.spent()
    deliveries = count * WATCHERS
    write = alone.broker / count
    telling = (watched.broker - alone.broker) / deliveries
    reading = (watched.here - alone.here) / deliveries
    print(f"renewals: {count / alone.passed:.0f}/s; {write * 1e6:.0f} us each at the broker")
    print(f"telling a renewal to a worker: {telling * 1e6:.1f} us at the broker")
    print(f"reading a renewal: {reading * 1e6:.0f} us at the worker")
    return write, telling, reading


async def replicated(writer: Writer, running: Servers) -> None:
    await writer.renew(0)
    clock = Clock(running)
    await writer.renew(100)
    spent, count = clock.spent(), ROUNDS * LEASES
    print(
        f"renewals with three brokers: {count / spent.passed:.0f}/s;"
        f" {spent.broker / count * 1e6:.0f} us each at all brokers"
    )


async def scan(writer: Writer, settings: FleetSettings, running: Servers) -> None:
    for number in range(GOALS):
        goal_id = GoalID(number.to_bytes(16, "big"))
        goal = StoredGoal(goal_id, number, Sender("me"), bytes(32), bytes(100))
        entry = GoalEntry(goal, bytes(8), bytes(4))
        await writer.write(NAMES.goal("count", goal_id), encode(entry), 3600.0)
    await writer.written()
    async with open_broker(settings) as broker:
        clock = Clock(running)
        found = 0
        async with broker.watch(NAMES.goals, NAMES.goal("count")) as watch:
            while (records := await watch.next()) is not None:
                found += len(records)
        spent = clock.spent()
    assert found == GOALS
    print(
        f"scan: {found / spent.passed:.0f} records/s; {spent.here / found * 1e6:.0f} us each at the"
        f" worker, {spent.broker / found * 1e6:.0f} us at the broker"
    )


async def measure() -> None:
    with servers(1) as running:
        settings = FleetSettings("limits", tuple(running.hosts.split(",")))
        async with open_broker(settings) as broker:
            await broker.create_streams(NAMES)
            writer = Writer(broker)
            write, telling, reading = await renewals(writer, settings, running)
            await scan(writer, settings, running)
    with servers(3) as running:
        settings = FleetSettings("limits", tuple(running.hosts.split(",")))
        async with open_broker(settings) as broker:
            await broker.create_streams(NAMES)
            await replicated(Writer(broker), running)
    print(f"with one broker and a lease of {LEASE:g} s:")
    for count in (100, 1000, 10_000):
        rate = count * RENEWALS / LEASE
        print(
            f"{count:6,} workers: {rate:,.0f} renewals/s, {rate * count:,.0f} tellings/s;"
            f" {rate * (write + count * telling):.2f} processors of the broker,"
            f" {rate * reading:.3f} of each worker"
        )


def main() -> None:
    if PROGRAM is None:
        print("left out is the fleet: nats-server is not installed")
    else:
        anyio.run(measure)


if __name__ == "__main__":
    main()
