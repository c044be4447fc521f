"""`Contender`: one way to run goals.

Each has a module `over_*`, or an `Ends` in one, with `serve`, whose block gets an address, and
`connect`, which takes that address and whose block gets a `Contender`. The number of a goal says
what its executor does; see below.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager
from time import monotonic_ns, perf_counter
from typing import Any, NamedTuple

from anyio import create_task_group, sleep, sleep_forever

AT_ONCE = 500
"""The number of goals in a batch."""

PENDING = -1
"""The number of a goal that ends when it is canceled. A number of 0 or more is the number of
feedback messages, which are sent as fast as possible."""
PACED = 1_000_000_000
"""The least number of a paced goal. The difference to it is the number of feedback messages; each
comes after a pause, and has the time of its making."""
PAUSE = 0.001
"""Seconds before a paced message, long enough for the last one to be read."""
LARGE = 1_000_000
"""The bytes of a large feedback message."""
LARGE_PAUSE = 1 / 30
"""Seconds between large feedback messages."""
ACTION_NAME = "FIBACTION_BENCH_ACTION"
"""The environment variable with the name of an action of ROS, which also has one `_large`."""


class GoalTimes(NamedTuple):
    """Seconds from the moment that a goal was sent."""

    accepted: float | None
    """The seconds until the acceptance; None for contenders without such an answer."""
    ended: float


class Contender(ABC):
    @abstractmethod
    async def goal(self) -> None:
        """Run one goal without feedback."""

    def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        """Run a goal of this number, and yield the numbers of each feedback message, decoded."""
        raise NotImplementedError

    async def goals(self, times: int) -> None:
        """Run goals without feedback, one after another."""
        for _ in range(times):
            await self.goal()

    async def batches(self, times: int) -> int:
        """Run batches of goals without feedback, one batch after another; return the number of
        goals that were done.
        """
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self.goal)
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        """Run one goal with so many feedback messages, and read and decode them all; return the
        number that arrived.
        """
        arrived = 0
        async for _ in self.numbers_of(times):
            arrived += 1
        return arrived

    async def goal_times(self, times: int) -> list[GoalTimes]:
        """Run goals as `goals` does, and return the times of each."""
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            await self.goals(1)
            taken.append(GoalTimes(None, perf_counter() - start))
        return taken

    async def feedback_times(self, times: int) -> list[float]:
        """Return the seconds from the making of each paced feedback message to its decoding."""
        return [seconds_since(one) async for one in self.numbers_of(PACED + times)]

    async def large(self, times: int) -> list[float]:
        """Run a goal with so many large feedback messages; return the number that arrived whole,
        the seconds, and those of the processor.
        """
        raise NotImplementedError

    async def hold(self, times: int) -> None:
        """Send so many more pending goals."""
        raise NotImplementedError


class Ends(NamedTuple):
    """The two ends of a way; the address of a server in the client's process is not needed."""

    serve: Callable[[], AbstractAsyncContextManager[str]]
    connect: Callable[[str], AbstractAsyncContextManager[Contender]]


async def messages_of(goal: int, feedback: Callable[[list[int]], Any]) -> AsyncGenerator[Any, None]:
    """Yield the feedback messages that the number of a goal asks for, made of their numbers; that
    of a pending goal does not end.
    """
    if goal >= PACED:
        for _ in range(goal - PACED):
            await sleep(PAUSE)
            yield feedback(stamped())
        return
    same = feedback([1, 2, 3])
    for _ in range(goal):
        yield same
    if goal == PENDING:
        await sleep_forever()


def stamped() -> list[int]:
    """Return the time as numbers of a feedback message, by the clock that all processes share."""
    return list(divmod(monotonic_ns(), 10**9))


def seconds_since(stamp: list[int]) -> float:
    """Return the seconds since a message was made."""
    seconds, nanoseconds = stamp
    return (monotonic_ns() - nanoseconds) / 1e9 - seconds
