"""One run of a seed: a fleet on virtual time, and what was seen of it."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import AsyncGenerator, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import anyio
from anyio import CancelScope, current_time
from msgspec.structs import replace

from fibaction import (
    Action,
    ActionClient,
    ActionError,
    ActionServer,
    ConnectionLost,
    Endpoint,
    GoalHandle,
    GoalID,
    GoalRejected,
    Schedule,
    ServerNotFound,
    StoreError,
)
from fibaction_transports.nats.client.connection import open_fleet
from fibaction_transports.nats.lines import ClientLines  # noqa: F401  # patched when it is loaded
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import goal_entry
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.worker import open_worker
from tests.fleet_simulation.invariants import Cut, Seen, Stretch, Told, violations
from tests.simulation import loop as virtual
from tests.simulation.machine import made_up
from tests.support.memory_broker import MemoryBroker, MemoryBrokers

LEASE = 5.0
PATIENCE = 40.0
"""Seconds that clients wait for a goal that is lost."""
LENGTH = 25.0
"""Seconds in which goals are sent and faults happen."""
QUIET = 120.0
"""Seconds after that, in which everything has to come to its end."""
MAX_ATTEMPTS = 5
CANCELED = 0.4
"""The part of the goals that are canceled."""
CLEAN_UP = 0.8
"""Seconds that executors take for their clean-up, at most: less than the margin of a lease."""

WORK = Action("work", goal=int, feedback=int, result=str, checkpoint=int)
NAMES = FleetNames("simulated")


def key_of(request: int) -> int:
    """Return the key of a goal."""
    return request % 2


@dataclass
class Report:
    """The result of one run."""

    seed: int
    violations: list[str]
    goals: int
    takeovers: int
    kills: int
    cuts: int


class Process:
    """One life of a worker."""

    def __init__(self, world: World, name: str, number: int) -> None:
        self.name = f"{name}, life {number}"
        self.worker = name
        self.world = world
        self.broker: MemoryBroker = world.brokers.member(self.name)
        self.scope = CancelScope()
        self.is_dead = False

    async def run(self) -> None:
        """Serve until killed, or until its store fails."""
        world = self.world
        settings = FleetSettings("simulated", worker=self.worker, lease=LEASE)
        server = ActionServer(
            WORK,
            self.work,
            recovery=world.recovery,
            max_attempts=MAX_ATTEMPTS,
            schedule=world.schedule and replace(world.schedule),  # each worker has its own
            result_timeout=600,
            watchdog=0,  # each look of its thread at the clock lets virtual time pass
        )
        try:
            with self.scope:
                async with open_worker(self.broker, NAMES, settings) as worker:
                    server.keep_in(worker.store)
                    async with server, worker.serve([server]):
                        await anyio.sleep_forever()
        except (StoreError, ActionError) as exc:
            if not self.is_dead and "cannot join the fleet" not in str(exc):
                world.seen.errors.append(f"{self.name} has failed: {exc}")
            self.is_dead = True

    def kill(self) -> None:
        """End it at once: nothing that it does from now on is seen by anybody."""
        self.is_dead = True
        self.broker.is_away = True
        self.broker.subscriptions.clear()
        self.world.brokers.members.remove(self.broker)
        for stretch in self.world.seen.stretches:
            if stretch.process == self.name:
                stretch.ended = min(stretch.ended, current_time())
        self.scope.cancel()

    async def work(self, goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        """Count to the goal, with a checkpoint at each second step."""
        chance = self.world.chance
        restored = goal.restored or 0
        key = key_of(goal.request)
        stretch = Stretch(goal.goal_id, self.name, goal.attempt, restored, current_time(), key)
        if not self.is_dead:
            self.world.seen.stretches.append(stretch)
        try:
            for step in range(restored + 1, goal.request + 1):
                await anyio.sleep(chance.uniform(0.01, 1.0))
                if step % 2 == 0:
                    await goal.checkpoint(step)
                    stretch.checkpoints.append(step)
                yield step
        except BaseException:
            with CancelScope(shield=True):
                await anyio.sleep(chance.uniform(0, CLEAN_UP))
            raise
        finally:
            stretch.ended = min(stretch.ended, current_time())
        yield f"counted to {goal.request}"


class World:
    """A fleet, and all that happens to it."""

    def __init__(self, seed: int) -> None:
        self.chance = chance = random.Random(f"fleet {seed}")
        self.seen = Seen(LEASE, MAX_ATTEMPTS)
        self.brokers: MemoryBrokers
        rules: list[Literal["abort", "rerun"]] = ["abort", "rerun", "rerun"]
        self.recovery = chance.choice(rules)
        self.schedule = chance.choice(
            [None, Schedule(concurrency=1, queue=20), Schedule(concurrency=2, queue=3)]
        )
        limits = random.Random(f"limit {seed}")
        if limits.random() < 0.5:
            self.schedule = Schedule(
                key=key_of,
                concurrency=limits.choice([1, 1, 2]),
                total=limits.choice([None, 1, 2]),
                queue=20,
                fleet_limit="simulated",
            )
            self.seen.most_of_key = self.schedule.concurrency or math.inf
        self.lives: dict[str, Process] = {}
        self.count = 0
        self.kills = 0
        self.lost = chance.choice([0.0, 0.0, 0.02, 0.1])
        self.delay = chance.choice([0.0, 0.002, 0.1])

    async def run(self) -> None:
        """Let it happen."""
        chance = self.chance
        self.brokers = MemoryBrokers()
        self.brokers.loses_answer = lambda _write: chance.random() < self.lost
        self.brokers.delay = lambda: chance.uniform(0, self.delay)
        async with self.brokers, anyio.create_task_group() as tasks:
            workers = [f"w{number}" for number in range(self.chance.randint(2, 4))]
            with anyio.move_on_after(LENGTH + QUIET) as limit:
                async with anyio.create_task_group() as living:
                    for name in workers:
                        living.start_soon(self._live, name, tasks)
                    async with anyio.create_task_group() as clients:
                        for number in range(self.chance.randint(1, 3)):
                            clients.start_soon(self._client, number)
                    await self._all_ended()
                    living.cancel_scope.cancel()
            if limit.cancelled_caught:
                self.seen.errors.append("it does not come to an end")
            tasks.cancel_scope.cancel()
        for write in self.brokers.writes:
            if write.data and write.subject.startswith(NAMES.all_goals().partition("*")[0]):
                self.seen.entries.append(goal_entry(write.data))

    async def _all_ended(self) -> None:
        """Wait until all records have ended; the time is limited outside."""
        while any(  # noqa: ASYNC110  # the brokers tell nobody, and virtual time costs nothing
            record.data and not goal_entry(record.data).goal.status.is_terminal
            for record in self.brokers.matching(NAMES.all_goals())
        ):
            await anyio.sleep(0.5)

    # Workers

    async def _live(self, name: str, tasks: anyio.abc.TaskGroup) -> None:
        """Run the lives of one worker, with what happens to it."""
        chance = self.chance
        await anyio.sleep(chance.uniform(0, 2))
        end = virtual.EPOCH + LENGTH
        while True:
            self.count += 1
            life = self.lives[name] = Process(self, name, self.count)
            tasks.start_soon(life.run)
            while True:
                await anyio.sleep(chance.uniform(1, 20))
                if life.is_dead:  # it could not join
                    break
                if current_time() > end:
                    await anyio.sleep_forever()
                if chance.random() < 0.5:
                    await self._cut(life)
                else:
                    life.kill()
                    self.kills += 1
                    break
            await anyio.sleep(chance.uniform(0, 2 * LEASE))

    async def _cut(self, life: Process) -> None:
        began = current_time()
        life.broker.is_away = True
        await anyio.sleep(self.chance.choice([0.5, LEASE / 2, 2 * LEASE]))
        life.broker.is_away = False
        self.seen.cuts.append(Cut(life.name, began, current_time()))

    # Clients

    async def _client(self, number: int) -> None:
        chance = self.chance
        broker = self.brokers.member(f"client {number}")
        settings = FleetSettings("simulated", reconnect_timeout=PATIENCE)
        async with open_fleet(broker, NAMES, settings) as connection:
            endpoint = connection.endpoint(WORK)
            await endpoint.wait_for_server()
            async with anyio.create_task_group() as goals:
                for _ in range(chance.randint(2, 10)):
                    goals.start_soon(self._goal, endpoint, chance.uniform(0, LENGTH))

    async def _goal(self, endpoint: Endpoint, wait: float) -> None:
        chance = self.chance
        client = ActionClient(endpoint, WORK)
        await anyio.sleep(wait)
        told = Told(GoalID.random())
        try:
            goal = await client.send_goal(chance.randint(0, 8), goal_id=told.goal_id)
            told.is_accepted = True
            self.seen.told.append(told)
            if chance.random() < CANCELED:
                await anyio.sleep(chance.uniform(0, 3))
                told.cancel = await goal.cancel()
                told.cancel_at = current_time()
            told.outcome = await goal.outcome()
        except (ConnectionLost, GoalRejected, ServerNotFound) as exc:
            told.error = str(exc)
        except ActionError as exc:
            told.error = str(exc)
            self.seen.errors.append(f"{told.goal_id}: {type(exc).__name__}: {exc}")


class _Errors(logging.Handler):
    """The errors in the log, which are bugs."""

    def __init__(self, seen: Seen) -> None:
        super().__init__(logging.ERROR)
        self._seen = seen

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            text = logging.Formatter().formatException(record.exc_info)
            self._seen.errors.append(f"{record.getMessage()}\n{text}")


@contextmanager
def _listening(seen: Seen) -> Generator[None, None, None]:
    handler = _Errors(seen)
    logger = logging.getLogger("fibaction")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


def simulate(seed: int) -> Report:
    """Run a seed, and return its report."""
    # Some 80 seconds are enough for what ends; a mistake that never does is found the sooner.
    loop = virtual.VirtualLoop(longest=500, most_turns=3_000_000)
    world = World(seed)
    with _listening(world.seen), made_up(loop, seed):
        try:
            virtual.run(world.run, loop)
        except (virtual.Deadlock, virtual.Livelock) as exc:
            world.seen.errors.append(f"{type(exc).__name__}: {exc}")
    found = list(violations(world.seen))
    starts = [entry.goal.goal_id for entry in world.seen.entries]
    owners = {(entry.goal.goal_id, entry.incarnation) for entry in world.seen.entries}
    takeovers = len({one for one in owners if one[1]}) - len(set(starts))
    return Report(seed, found, len(set(starts)), takeovers, world.kills, len(world.seen.cuts))
