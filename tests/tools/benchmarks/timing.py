"""Measurements in turns, so that a slow moment of the machine affects all of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from statistics import median
from time import perf_counter
from typing import TypeAlias

Work: TypeAlias = Callable[[int], Awaitable[object]]
"""A function that does its work so many times."""
Clock: TypeAlias = Callable[[], float]
"""`process_time` for work that is all in this process: what other processes do counts less."""

ROUNDS = 5


async def seconds_each(work: Work, times: int, clock: Clock = perf_counter) -> float:
    start = clock()
    await work(times)
    return (clock() - start) / times


async def in_turn(*works: Work, times: int, clock: Clock = perf_counter) -> list[tuple[float, ...]]:
    """Return the seconds per item of each, from all rounds but the first."""
    for work in works:
        await work(times // 5 + 1)
    return [
        tuple([await seconds_each(work, times, clock) for work in works]) for _ in range(ROUNDS)
    ]


async def beside(
    ours: Work, other: Work, times: int, clock: Clock = perf_counter
) -> dict[str, float]:
    """Measure both in turns. `ratio` is our rate divided by that of the other."""
    pairs = await in_turn(ours, other, times=times, clock=clock)
    return {
        "per_second": round(1 / median(pair[0] for pair in pairs)),
        "other_per_second": round(1 / median(pair[1] for pair in pairs)),
        "ratio": round(median(pair[1] / pair[0] for pair in pairs), 3),
    }
