"""Rates and latencies of several ways, measured in turns.

Machines are shared and noisy. In each round, all ways do some work, one after another, so that a
slow moment affects all. Ratios are those within a round: the median of all rounds, the lowest and
the highest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import median
from typing import Any

from tests.support.json_program import Program
from tests.tools.benchmarks.contender import AT_ONCE
from tests.tools.benchmarks.ways import ROS, WAYS, Pair

ROUNDS = 7
SECONDS = 0.7
"""Seconds that each way works in a round."""
LATENCY_SECONDS = 1.0

PERCENTILES = {"p50": 500, "p90": 900, "p99": 990, "p99.9": 999}
"""The percentiles, in thousandths."""
ENOUGH = 10
"""The least samples beyond a percentile that is reported, except the median."""

BESIDE = [
    ("inproc", "tasks"),
    ("tcp", "sockets"),
    ("tcp", "task_sockets"),
    ("tcp", "grpc"),
    ("tcp", "nats"),
    ("tcp_uvloop", "tcp"),
    ("tcp_trio", "tcp"),
    ("tls", "tcp"),
    ("unix", "tcp"),
    ("ws", "tcp"),
    ("http", "tcp"),
    ("ros2", "rclpy"),
    ("ros2", "rclpy_deep"),
    ("ros2", "rclpy_events"),
]
"""The pairs of ways whose ratios are reported."""


async def calibrated(client: Program, order: str, seconds: float) -> tuple[int, float, float]:
    """Return the number of times that take about so long, and the amount and the seconds of the
    last trial.
    """
    times = 1 if order == "batches" else 20
    while True:
        done, taken = await client.ask(order, times)
        if taken >= seconds / 4:
            return max(1, round(times * seconds / taken)), done, taken
        times = math.ceil(times * min(10, max(2, seconds / 2 / taken)))


async def rates(running: Mapping[str, Pair], order: str, scale: float) -> dict[str, Any]:
    """Measure the goals, or the feedback messages, per second."""
    each = AT_ONCE if order == "batches" else 1
    ways: dict[str, dict[str, Any]] = {}
    times: dict[str, int] = {}
    for key, pair in running.items():
        wanted, done, taken = await calibrated(pair.client, order, SECONDS * scale)
        ways[key] = {}
        if order == "batches" and done < 1:
            # It loses goals, and is in another state after that.
            ways[key] = {"answered": round(done * AT_ONCE), "of": AT_ONCE, "seconds": round(taken)}
        else:
            times[key] = wanted
    if order == "feedback":
        _same_of_ros(times)
    rounds = [
        {key: await _round(running, key, order, n) for key, n in times.items()}
        for _ in range(ROUNDS)
    ]
    for key in times:
        per_second = sorted(each * done / taken for done, taken in (one[key] for one in rounds))
        ways[key] = {
            "per_second": _rounded(median(per_second)),
            "low": _rounded(per_second[0]),
            "high": _rounded(per_second[-1]),
        }
        if order == "feedback":
            share = sum(one[key][0] for one in rounds) / (times[key] * ROUNDS)
            ways[key] |= {"at_once": times[key], "arrived": round(share, 3)}
    speeds = [{key: done / taken for key, (done, taken) in one.items()} for one in rounds]
    return {"ways": ways, "ratios": ratios(speeds)}


def _same_of_ros(times: dict[str, int]) -> None:
    """Use the same number for all ways over ROS, which loses more the more is sent at once."""
    of_ros = [key for key in times if WAYS[key].group == ROS]
    for key in of_ros:
        times[key] = min(times[one] for one in of_ros)


async def _round(
    running: Mapping[str, Pair], key: str, order: str, times: int
) -> tuple[float, float]:
    done, taken = await running[key].client.ask(order, times)
    return done, taken


async def goal_latencies(running: Mapping[str, Pair], scale: float) -> dict[str, Any]:
    """Measure the milliseconds from sending a goal to its acceptance, and to its end."""
    times = {
        key: (await calibrated(pair.client, "goals", LATENCY_SECONDS * scale))[0]
        for key, pair in running.items()
    }
    rounds: list[dict[str, list[tuple[float | None, float]]]] = [
        {key: await running[key].client.ask("goal_times", n) for key, n in times.items()}
        for _ in range(ROUNDS)
    ]
    ways: dict[str, dict[str, Any]] = {}
    for key in running:
        taken = [one for each in rounds for one in each[key]]
        ways[key] = {"ended": percentiles([ended for _, ended in taken])}
        accepted = [one for one, _ in taken if one is not None]
        ways[key]["accepted"] = percentiles(accepted) if accepted else None
    medians = [
        {key: median(ended for _, ended in taken) for key, taken in each.items()} for each in rounds
    ]
    return {"ways": ways, "ratios": ratios(medians)}


async def feedback_latencies(running: Mapping[str, Pair], scale: float) -> dict[str, Any]:
    """Measure the milliseconds from making a feedback message to decoding it at the client."""
    # With the pause before each, some seven hundred are sent in a second.
    times = max(20, round(700 * LATENCY_SECONDS * scale))
    for pair in running.values():
        await pair.client.ask("feedback_times", 20)
    rounds: list[dict[str, list[float]]] = [
        {key: await pair.client.ask("feedback_times", times) for key, pair in running.items()}
        for _ in range(ROUNDS)
    ]
    ways = {
        key: {"seen": percentiles([one for each in rounds for one in each[key]])} for key in running
    }
    # A way that has lost all messages of a round does not have a median there.
    whole = [key for key in running if all(each[key] for each in rounds)]
    medians = [{key: median(each[key]) for key in whole} for each in rounds]
    return {"ways": ways, "ratios": ratios(medians)}


def percentiles(seconds: list[float]) -> dict[str, float | None]:
    """Return percentiles in milliseconds, by nearest rank; None with too few samples beyond."""
    ordered = sorted(seconds)
    found: dict[str, float | None] = {}
    for name, thousandths in PERCENTILES.items():
        rank = -(-len(ordered) * thousandths // 1000)
        is_told = len(ordered) - rank >= ENOUGH or (name == "p50" and rank > 0)
        found[name] = round(ordered[rank - 1] * 1e3, 4) if is_told else None
    return found | {"samples": len(ordered)}


def ratios(rounds: list[dict[str, float]]) -> list[dict[str, Any]]:
    """Return the ratio of each measured pair in `BESIDE`: the median, the lowest, the highest."""
    found: list[dict[str, Any]] = []
    for one, other in BESIDE:
        # If nothing arrived in a round, the pair does not have a ratio.
        if one in rounds[0] and all(values.get(other) for values in rounds):
            each = sorted(values[one] / values[other] for values in rounds)
            found.append(
                {
                    "of": one,
                    "to": other,
                    "median": _rounded(median(each)),
                    "low": _rounded(each[0]),
                    "high": _rounded(each[-1]),
                }
            )
    return found


def _rounded(value: float) -> float:
    """Round to three digits, since more would be noise."""
    return float(f"{value:.3g}")
