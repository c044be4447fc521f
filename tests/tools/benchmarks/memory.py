"""Memory of an active goal and of a kept result.

Memory is the resident memory of a whole process, with Python, the libraries, and the free memory
that the allocator keeps.
"""

from __future__ import annotations

from typing import Any

from tests.tools.benchmarks.ways import KEPT, WAYS, Pair, started

MEASURED = ("inproc", "tcp", "grpc")
COUNTS = (10, 1000, 10_000)
WARM_UP = 400
"""Goals that run before memory is measured."""
FIRST_RESULTS = 1000
"""Results that are kept before memory is measured for the first time."""
AIM = 120
"""The limit for the server's process with 10,000 active goals, in megabytes."""
MEGA, KILO = 1e6, 1e3


def processes(key: str, pair: Pair) -> dict[str, int]:
    """Return the resident memory of both ends, in bytes."""
    if pair.server is None:
        return {key: pair.client.resident}
    return {f"{key}_server": pair.server.resident, f"{key}_client": pair.client.resident}


def labels() -> dict[str, str]:
    named: dict[str, str] = {}
    for key in MEASURED:
        if WAYS[key].has_server:
            named |= {f"{key}_{end}": f"{WAYS[key].label}: {end}" for end in ("server", "client")}
        else:
            named[key] = f"{WAYS[key].label}: both ends"
    return named


async def measure(without: dict[str, str], scale: float) -> dict[str, Any]:
    """Measure the report `memory`.

    A peer that fails with so many goals is left out from then on.
    """
    counts = sorted({max(10, round(count * scale)) for count in COUNTS})
    resident: dict[str, dict[int, int]] = {}
    for key in [key for key in MEASURED if key not in without]:
        sizes: dict[str, dict[int, int]] = {}
        held = 0
        async with started(WAYS[key]) as pair:
            await pair.client.ask("goals", WARM_UP)
            try:
                for count in counts:
                    await pair.client.ask("hold", count - held)
                    await pair.client.ask("goals", 1)  # sent after them, so they have begun
                    held = count
                    for name, size in processes(key, pair).items():
                        sizes.setdefault(name, {})[count] = size
            except RuntimeError:
                if WAYS[key].is_ours:
                    raise
                without[key] = f"it failed with {count:,} active goals"
            else:
                resident |= sizes
    return _report(resident, counts, await kept(scale))


def _report(
    resident: dict[str, dict[int, int]], counts: list[int], results: dict[str, float]
) -> dict[str, Any]:
    named = labels()
    ways: dict[str, Any] = {}
    for name, sizes in resident.items():
        key = name.partition("_")[0]
        of_one = (sizes[counts[-1]] - sizes[counts[0]]) / (counts[-1] - counts[0])
        ways[name] = {
            "label": named[name],
            "group": WAYS[key].group,
            "ours": WAYS[key].is_ours,
            "megabytes": {str(count): round(size / MEGA, 1) for count, size in sizes.items()},
            "kilobytes_each_goal": round(of_one / KILO, 2),
            "kilobytes_each_result": results.get(name),
        }
    return {"counts": counts, "aim_megabytes": AIM, "ways": ways, "ratios": []}


async def kept(scale: float) -> dict[str, float]:
    """Measure the kilobytes that each result costs if all are kept."""
    more = max(500, round(COUNTS[-1] * scale))
    found: dict[str, float] = {}
    for key, way in KEPT.items():
        async with started(way) as pair:
            await pair.client.ask("goals", FIRST_RESULTS)
            before = processes(key, pair)
            await pair.client.ask("goals", more)
            for name, size in processes(key, pair).items():
                if not name.endswith("client"):  # a client keeps no results
                    found[name] = round((size - before[name]) / more / KILO, 2)
    return found
