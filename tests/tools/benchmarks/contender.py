"""`Contender`: one way to run goals.

Each has a module of its own, `over_*`, with `serve`, whose block gets an address, and `connect`,
which takes that address and whose block gets a `Contender`. The number of a goal says what its
executor does; see below.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import monotonic_ns, perf_counter
from typing import NamedTuple

from anyio import create_task_group

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


class GoalTimes(NamedTuple):
    """Seconds from the moment that a goal was sent."""

    accepted: float | None
    """The seconds until the acceptance; None for contenders without such an answer."""
    ended: float


class Contender(ABC):
    @abstractmethod
    async def goals(self, times: int) -> None:
        """Run goals without feedback, one after another."""

    @abstractmethod
    async def batches(self, times: int) -> int:
        """Run batches of goals without feedback, one batch after another; return the number of
        goals that were done.
        """

    async def at_once(self, times: int, width: int) -> None:
        """Run goals without feedback, always so many at once."""

        async def some(first: int) -> None:
            for _ in range(first, times, width):
                await self.goals(1)

        async with create_task_group() as tasks:
            for first in range(width):
                tasks.start_soon(some, first)

    @abstractmethod
    async def feedback(self, times: int) -> int:
        """Run one goal with so many feedback messages, and read and decode them all; return the
        number that arrived.
        """

    async def goal_times(self, times: int) -> list[GoalTimes]:
        """Run goals as `goals` does, and return the times of each."""
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            await self.goals(1)
            taken.append(GoalTimes(None, perf_counter() - start))
        return taken

    @abstractmethod
    async def feedback_times(self, times: int) -> list[float]:
        """Return the seconds from the making of each paced feedback message to its decoding."""

    async def hold(self, times: int) -> None:
        """Send so many more pending goals."""
        raise NotImplementedError


def stamped() -> list[int]:
    """Return the time as numbers of a feedback message, by the clock that all processes share."""
    return list(divmod(monotonic_ns(), 10**9))


def seconds_since(stamp: list[int]) -> float:
    """Return the seconds since a message was made."""
    seconds, nanoseconds = stamp
    return (monotonic_ns() - nanoseconds) / 1e9 - seconds
