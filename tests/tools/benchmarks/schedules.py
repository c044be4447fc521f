"""The costs of a `Schedule`: speed beside a server without one, and a queue of 10,000 goals.

    python -m tests.tools.benchmarks.schedules [--rounds N]

Both sides of a ratio run in turns in one process, and it is the processor's time that counts, so
that other programs disturb little. The garbage collector is off while time is measured, since its
runs come at any moment; their cost grows with all objects of a process.
"""

from __future__ import annotations

import argparse
import gc
import tracemalloc
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AsyncExitStack
from statistics import median
from time import process_time
from typing import TypeAlias

import anyio
from msgspec.structs import replace

from fibaction import Action, ActionClient, ActionServer, GoalHandle, GoalID, Schedule, serve
from fibaction import connect as connect_to
from fibaction.border.abc import GoalStream

WORK = Action("work", goal=int, feedback=int, result=str)
AT_ONCE = 500
BATCHES = 4
FEW, MANY = 10, 10_000
"""Goals that wait while the cost of one more is measured."""
TIMES = 200
"""Goals by which the cost of one is measured."""
SHORT, ENDLESS = 0, 1
"""Remainders of goals by 10: a short goal ends at once, an endless one when it is canceled."""

KEYS = 5
BOUNDED = Schedule(concurrency=100, queue=10_000)
QUEUES = {
    "in turn": Schedule(concurrency=KEYS, queue=2 * MANY),
    "in turn, with timeouts": Schedule(
        concurrency=KEYS, queue=2 * MANY, queue_timeout=3600, run_timeout=3600
    ),
    "by key": Schedule(concurrency=1, queue=2 * MANY, key=lambda goal: goal // 100 % KEYS),
    "by priority": Schedule(
        concurrency=KEYS, queue=2 * MANY, when_full="preempt", priority=lambda goal: goal // 10 % 10
    ),
}
"""The queues in which goals wait."""
Step: TypeAlias = "Callable[[Queue], Awaitable[None]]"


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.request % 10 == ENDLESS:
        await anyio.sleep_forever()
    yield "done"


# Speed


async def batches(url: str, schedule: Schedule | None) -> float:
    """Return the seconds of goals that are sent at once."""
    server = ActionServer(WORK, work, schedule=schedule)
    async with serve(server, url) as (there,), connect_to(there, WORK) as client:
        await batch(client)
        gc.collect()
        began = process_time()
        for _ in range(BATCHES):
            await batch(client)
        return process_time() - began


async def batch(client: ActionClient[int, int, str]) -> None:
    async with anyio.create_task_group() as tasks:
        for _ in range(AT_ONCE):
            tasks.start_soon(client.call, SHORT)


async def speed(rounds: int) -> None:
    """Print the rate with a schedule to that without."""
    for url in ("inproc://work", "tcp://127.0.0.1:0"):
        ratios = sorted(
            [await batches(url, None) / await batches(url, BOUNDED) for _ in range(rounds)]
        )
        print(
            f"{AT_ONCE} goals at once, {url.partition(':')[0]}: {median(ratios):.2f} of the rate"
            f" without a schedule ({ratios[0]:.2f} to {ratios[-1]:.2f})"
        )


# A queue


class Queue:
    """A server with one goal of each key that runs, and others that wait for it."""

    def __init__(self, server: ActionServer[int, int, str]) -> None:
        self._server = server
        self._streams: deque[GoalStream] = deque()
        self._number = 0

    async def fill(self, waiting: int) -> None:
        """Send goals until so many wait."""
        for _ in range(KEYS + waiting):
            await self.send()

    async def send(self, urgency: int = 1) -> None:
        """Send an endless goal, which waits."""
        self._number += 1
        goal = WORK.goal.encode(self._number * 100 + urgency * 10 + ENDLESS)
        self._streams.append(await self._server.send_goal(GoalID.random(), goal))

    async def cancel(self) -> None:
        """Cancel the goal that was sent last, which waits."""
        await self._server.cancel_goals(self._streams.pop().goal_id)

    async def turn(self) -> None:
        """Cancel the goal that was sent first, which runs, so that the next one starts; send one
        more.
        """
        stream = self._streams.popleft()
        await self._server.cancel_goals(stream.goal_id)
        await stream.outcome()
        await self.send()

    async def preempt(self) -> None:
        """Send an urgent goal, which preempts the one that runs, and let it run."""
        await self.send(urgency=0)
        urgent = self._streams.pop()
        await self._streams.popleft().outcome()
        self._streams.appendleft(urgent)
        await self.turn()


async def microseconds(step: Step, queue: Queue) -> float:
    """Return the microseconds of the processor that one step takes."""
    began = process_time()
    for _ in range(TIMES):
        await step(queue)
    return (process_time() - began) / TIMES * 1e6


async def growth(name: str, schedule: Schedule, steps: list[Step], rounds: int) -> None:
    """Print the cost of each step while few and while many goals wait."""
    few: dict[str, list[float]] = {step.__name__: [] for step in steps}
    many: dict[str, list[float]] = {step.__name__: [] for step in steps}
    async with AsyncExitStack() as stack:
        queues: list[tuple[Queue, dict[str, list[float]]]] = []
        for waiting, found in ((FEW, few), (MANY, many)):
            # Servers with the same object would share its places.
            alone = replace(schedule)
            server = ActionServer(WORK, work, schedule=alone, shutdown_timeout=0)
            queue = Queue(await stack.enter_async_context(server))
            await queue.fill(waiting)
            queues.append((queue, found))
        gc.collect()
        for number in range(rounds + 1):
            for step in steps:
                for queue, found in queues:
                    taken = await microseconds(step, queue)
                    if number:  # the first round fills caches
                        found[step.__name__].append(taken)
    for called, before in few.items():
        ratios = [high / low for low, high in zip(before, many[called], strict=True)]
        print(
            f"{name}, {called}: {median(before):.0f} us with {FEW} that wait, and with {MANY:,}"
            f" {median(ratios):.2f} times as much ({min(ratios):.2f} to {max(ratios):.2f})"
        )


async def memory() -> None:
    """Print the memory of one goal that waits, in one process."""
    async with ActionServer(WORK, work, schedule=QUEUES["in turn"], shutdown_timeout=0) as server:
        queue = Queue(server)
        await queue.fill(FEW)
        gc.collect()
        tracemalloc.start()
        for _ in range(MANY):
            await queue.send()
        gc.collect()
        each = tracemalloc.get_traced_memory()[0] / MANY
        tracemalloc.stop()
    print(f"memory of each of {MANY:,} goals that wait, with its stream: {each:,.0f} bytes")


async def measure(rounds: int) -> None:
    await memory()
    gc.disable()
    await speed(rounds)
    for name, schedule in QUEUES.items():
        steps: list[Step] = [Queue.send, Queue.cancel, Queue.turn]
        if schedule.when_full == "preempt":
            steps.append(Queue.preempt)
        await growth(name, schedule, steps, rounds)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.schedules")
    parser.add_argument("--rounds", type=int, default=9)
    anyio.run(measure, parser.parse_args().rounds)


if __name__ == "__main__":
    main()
