"""Measurements in turns, so that a slow moment of the machine affects all of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from statistics import median
from time import perf_counter
from typing import TypeAlias

Work: TypeAlias = Callable[[int], Awaitable[object]]
"""A function that does its work so many times."""

ROUNDS = 5


async def seconds_each(work: Work, times: int) -> float:
    start = perf_counter()
    await work(times)
    return (perf_counter() - start) / times


async def in_turn(*works: Work, times: int) -> list[tuple[float, ...]]:
    """Return the seconds per item of each, from all rounds but the first."""
    for work in works:
        await work(times // 5 + 1)
    return [tuple([await seconds_each(work, times) for work in works]) for _ in range(ROUNDS)]


async def beside(ours: Work, other: Work, times: int) -> dict[str, float]:
    """Measure both in turns. `ratio` is our rate divided by that of the other."""
    pairs = await in_turn(ours, other, times=times)
    return {
        "per_second": round(1 / median(pair[0] for pair in pairs)),
        "other_per_second": round(1 / median(pair[1] for pair in pairs)),
        "ratio": round(median(pair[1] / pair[0] for pair in pairs), 3),
    }
