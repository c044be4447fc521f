"""The measurements of `sizes`: the costs of a server with more and more of something.

Each function yields the figures of one size after another. The garbage collector is off while time
is measured, as its runs come at any moment, and their cost grows with all objects of a process.
"""

from __future__ import annotations

import gc
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from statistics import median
from time import process_time
from typing import Any, TypeAlias

import anyio

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalInfo,
    Limits,
    connect,
    serve,
)
from tests.fleet.servers import Servers, servers
from tests.support.json_program import processor_of

TCP = "tcp://127.0.0.1:0"

ROUNDS = 5
TIMES = 400
"""Goals in a round of a measurement."""
BYTES = 200_000_000
"""Bytes that a round sends at most, and then receives."""
IDLE = 3.0
"""Seconds for which connections are left alone."""
OPENED_AT_ONCE = 100
MICRO, KILO, MEGA = 1e6, 1e3, 1e6

WORK = Action("work", goal=int, feedback=str, result=int)
ECHO = Action("echo", goal=bytes, feedback=int, result=bytes)
LARGEST = 64_000_000
"""The bytes of the largest payload."""
HUGE = Limits(
    connections=2_000,
    goals=200_000,
    frame=2 * LARGEST,
    memory=4 * LARGEST,
    total_memory=8 * LARGEST,
    queue=4 * LARGEST,
)
ENDLESS = 1
Client: TypeAlias = ActionClient[int, str, int]
Measured: TypeAlias = AsyncGenerator[Sequence[float | None], None]
"""The values of each series, for one size after another; None for one that says nothing there."""


Work: TypeAlias = Callable[[int], Awaitable[object]]
"""A function that does its work so many times."""


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
    """End at once, or never."""
    if goal.request == ENDLESS:
        await anyio.sleep_forever()
    yield 0


async def echo(goal: GoalHandle[bytes]) -> AsyncGenerator[bytes, None]:
    yield goal.request


async def seconds_each(doing: Work, times: int) -> float:
    """Return the processor's seconds that each takes."""
    start = process_time()
    await doing(times)
    return (process_time() - start) / times


async def cost(doing: Work, times: int) -> float:
    """Return the seconds of this process's processor for each time."""
    await doing(times // 5 + 1)
    gc.collect()
    gc.disable()
    try:
        rounds = [await seconds_each(doing, times) for _ in range(ROUNDS)]
    finally:
        gc.enable()
    return median(rounds)


def goals_of(*clients: Client) -> Work:
    """Return a function that sends so many goals, one after another, by the clients in turn."""

    async def send(times: int) -> None:
        for number in range(times):
            await clients[number % len(clients)].call(0)

    return send


async def with_active_goals(sizes: Sequence[int], times: int) -> Measured:
    server = ActionServer(WORK, work, max_goals=HUGE.goals, max_results=1_000)
    async with serve(server, TCP, limits=HUGE) as (url,), connect(url, WORK) as client:
        held: list[object] = []
        empty = resident()
        for size in sizes:
            while len(held) < size:
                more = min(OPENED_AT_ONCE, size - len(held))
                held += await at_once([client.send_goal(ENDLESS) for _ in range(more)])
            kilobytes = (resident() - empty) / size / KILO
            yield await cost(goals_of(client), times) * MICRO, kilobytes


async def with_connections(sizes: Sequence[int], times: int) -> Measured:
    server = ActionServer(WORK, work, max_results=1_000)
    idle_time = IDLE * times / TIMES
    async with serve(server, TCP, limits=HUGE) as (url,), AsyncExitStack() as stack:
        clients: list[Client] = []
        empty = resident()
        for size in sizes:
            while len(clients) < size:
                clients.append(await stack.enter_async_context(connect(url, WORK)))
            each = await cost(goals_of(*clients), max(times, 2 * size))
            kilobytes = (resident() - empty) / size / KILO
            start = process_time()
            await anyio.sleep(idle_time)
            idle = (process_time() - start) / idle_time / size
            yield each * MICRO, idle * MICRO, kilobytes


async def with_payloads(sizes: Sequence[int], times: int) -> Measured:
    server = ActionServer(ECHO, echo, max_results=10)
    async with (
        serve(server, TCP, limits=HUGE) as (url,),
        connect(url, ECHO, limits=HUGE) as client,
    ):
        for size in sizes:
            payload = bytes(size)

            async def send(times: int, payload: bytes = payload) -> None:
                for _ in range(times):
                    await client.call(payload)

            each = await cost(send, max(1, min(times, BYTES // size)))
            megabytes = 2 * size / MEGA
            yield each * MICRO, each * MICRO / megabytes if megabytes >= 1 else None


async def with_actions(sizes: Sequence[int], times: int) -> Measured:
    for size in sizes:
        made = [
            Action(f"work{number}", goal=int, feedback=str, result=int) for number in range(size)
        ]
        served = [ActionServer(action, work, max_results=1_000) for action in made]
        async with (
            serve(served, TCP, limits=HUGE) as (url,),
            connect(url) as connection,
            connect(url, made[-1]) as client,
        ):

            async def list_all(times: int, ask: Any = connection.actions) -> None:
                for _ in range(times):
                    await ask()

            listing = await cost(list_all, max(10, times // size))
            yield await cost(goals_of(client), times) * MICRO, listing * MICRO / size


async def with_watchers(sizes: Sequence[int], times: int) -> Measured:
    server = ActionServer(WORK, work, max_results=1_000)
    async with serve(server, TCP, limits=HUGE) as (url,), connect(url, WORK) as client:
        alone = await cost(goals_of(client), times)
        async with anyio.create_task_group() as tasks:
            watchers: list[Watcher] = []
            for size in sizes:
                while len(watchers) < size:
                    watchers.append(Watcher())
                    tasks.start_soon(watchers[-1].run, url)
                for watcher in watchers:
                    await watcher.began.wait()

                async def send(times: int) -> None:
                    seen = [watcher.ends for watcher in watchers]
                    await goals_of(client)(times)
                    for watcher, before in zip(watchers, seen, strict=True):
                        await watcher.sees(before + times)

                each = await cost(send, times)
                yield each * MICRO, (each - alone) * MICRO / size
            tasks.cancel_scope.cancel()


class Watcher:
    """A client that follows all events of the action."""

    def __init__(self) -> None:
        self.began = anyio.Event()
        self.ends = 0
        self._wanted = 0
        self._seen = anyio.Event()

    async def run(self, url: str) -> None:
        async with connect(url, WORK) as client, client.events(feedback=False) as events:
            self.began.set()
            async for event in events:
                self.ends += isinstance(event, GoalInfo) and event.status.is_terminal
                if self.ends >= self._wanted:
                    self._seen.set()

    async def sees(self, ends: int) -> None:
        """Wait until it has seen the ends of so many goals."""
        if self.ends < ends:
            self._wanted, self._seen = ends, anyio.Event()
            await self._seen.wait()


async def with_workers(sizes: Sequence[int], times: int) -> Measured:
    with servers(1) as running:
        url = f"nats://{running.hosts}/sizes"
        async with AsyncExitStack() as stack:
            workers = 0
            for size in sizes:
                while workers < size:
                    workers += 1
                    server = ActionServer(WORK, work, max_results=1_000)
                    where = f"{url}?worker=w{workers}"
                    await stack.enter_async_context(serve(server, where))
                async with connect(url, WORK) as client:
                    one_by_one = await fleet_cost(client, running, times, at_once=False)
                    yield one_by_one, await fleet_cost(client, running, times, at_once=True)


async def fleet_cost(client: Client, running: Servers, times: int, *, at_once: bool) -> float:
    """Return the microseconds of a goal, here and at the broker."""
    found: list[float] = []
    for _ in range(ROUNDS + 1):
        start = used(running)
        if at_once:
            async with anyio.create_task_group() as tasks:
                for _ in range(times):
                    tasks.start_soon(client.call, 0)
        else:
            await goals_of(client)(times)
        found.append((used(running) - start) / times * MICRO)
    return median(found[1:])


def used(running: Servers) -> float:
    """Return the processor's seconds of this process and of the brokers so far."""
    return process_time() + sum(processor_of(one.pid) for one in running.by_name.values())


async def at_once(sending: Sequence[Awaitable[object]]) -> list[object]:
    """Wait for all of them, and return what they return."""
    found: list[object] = []

    async def one(it: Awaitable[object]) -> None:
        found.append(await it)

    async with anyio.create_task_group() as tasks:
        for it in sending:
            tasks.start_soon(one, it)
    return found


def resident() -> int:
    """Return the resident memory of this process, in bytes."""
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * 4096
