"""`Contender`: one way to have goals done.

Each has a module of its own, `over_*`, with `serve`, which gives an address, and `connect`, which
takes that and gives a `Contender`. What a goal asks for is in its number; see below.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import monotonic_ns, perf_counter
from typing import NamedTuple

AT_ONCE = 500
"""So many goals are a batch."""

PENDING = -1
"""The number of a goal that ends when it is canceled. One of 0 or more is that of its feedback
messages, sent as quickly as can be."""
PACED = 1_000_000_000
"""A goal of a number from here on has so many feedback messages more than this. There is a pause
before each, and it holds the time when it was made."""
PAUSE = 0.001
"""Seconds: long enough for the message before to be read."""


class GoalTimes(NamedTuple):
    """Seconds from the moment that a goal was sent."""

    accepted: float | None
    """None where there is no such answer."""
    ended: float


class Contender(ABC):
    @abstractmethod
    async def goals(self, times: int) -> None:
        """Goals without feedback, one after another."""

    @abstractmethod
    async def batches(self, times: int) -> int:
        """Batches of goals without feedback, one batch after another; gives how many of the goals
        were done.
        """

    @abstractmethod
    async def feedback(self, times: int) -> int:
        """One goal with so many feedback messages, all of them read and decoded; gives how many of
        them arrived.
        """

    async def goal_times(self, times: int) -> list[GoalTimes]:
        """Goals as in `goals`, each of them timed."""
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            await self.goals(1)
            taken.append(GoalTimes(None, perf_counter() - start))
        return taken

    @abstractmethod
    async def feedback_times(self, times: int) -> list[float]:
        """Seconds from the making of each paced feedback message until it is decoded here."""

    async def hold(self, times: int) -> None:
        """Leave so many goals pending, beside those that are."""
        raise NotImplementedError


def stamped() -> list[int]:
    """The time, as numbers of a feedback message: all processes of a machine have one clock."""
    return list(divmod(monotonic_ns(), 10**9))


def seconds_since(stamp: list[int]) -> float:
    """How long ago a message was made."""
    seconds, nanoseconds = stamp
    return (monotonic_ns() - nanoseconds) / 1e9 - seconds
