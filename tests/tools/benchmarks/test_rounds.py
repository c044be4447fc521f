"""How rates and latencies are made of what the ways say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from tests.support.json_program import Program
from tests.tools.benchmarks import rounds
from tests.tools.benchmarks.contender import AT_ONCE
from tests.tools.benchmarks.ways import Pair

pytestmark = pytest.mark.asyncio


class Scripted:
    """A client that answers as a function of what it is asked, and keeps the questions."""

    def __init__(self, answer: Callable[[str, int], Any]) -> None:
        self.asked: list[tuple[str, int]] = []
        self._answer = answer

    async def ask(self, do: str, times: int = 1) -> Any:
        self.asked.append((do, times))
        return self._answer(do, times)

    def as_pair(self) -> Pair:
        return Pair(None, cast("Program", self))


def taking(seconds: float, share: float = 1.0) -> Scripted:
    """One that takes so long for each, and does that share of them."""
    return Scripted(lambda _, times: [times * share, times * seconds])


async def test_a_rate_is_of_single_goals_also_when_they_come_in_batches() -> None:
    found = await rounds.rates({"tcp": taking(0.1).as_pair()}, "batches", 1.0)

    assert found["ways"]["tcp"]["per_second"] == pytest.approx(AT_ONCE / 0.1)


async def test_a_ratio_is_of_the_rates_within_a_round() -> None:
    """A machine that slows down slows both, and the ratio stays."""
    slowness = 0

    def ours(_: str, times: int) -> list[float]:
        nonlocal slowness
        slowness += 1
        return [times, times * 0.01 * slowness]

    def other(_: str, times: int) -> list[float]:
        return [times, 2 * times * 0.01 * slowness]

    running = {"tcp": Scripted(ours).as_pair(), "grpc": Scripted(other).as_pair()}

    (ratio,) = (await rounds.rates(running, "goals", 1.0))["ratios"]

    assert ratio == {"of": "tcp", "to": "grpc", "median": 2.0, "low": 2.0, "high": 2.0}


async def test_a_way_that_loses_goals_of_a_batch_is_asked_once() -> None:
    losing = taking(10.0, share=0.034)

    found = await rounds.rates({"rclpy": losing.as_pair()}, "batches", 1.0)

    assert found["ways"]["rclpy"] == {"answered": 17, "of": AT_ONCE, "seconds": 10}
    assert losing.asked == [("batches", 1)]


async def test_feedback_that_is_lost_is_not_counted_and_is_told_of() -> None:
    found = await rounds.rates({"rclpy": taking(0.001, share=0.25).as_pair()}, "feedback", 1.0)

    way = found["ways"]["rclpy"]
    assert (way["per_second"], way["arrived"]) == (250, 0.25)


async def test_both_ways_over_ros_send_as_many_messages_at_once() -> None:
    ours, rclpy = taking(0.01), taking(0.002)

    await rounds.rates({"ros2": ours.as_pair(), "rclpy": rclpy.as_pair()}, "feedback", 1.0)

    assert ours.asked[-1] == rclpy.asked[-1] == ("feedback", 70)


async def test_a_percentile_that_few_samples_lie_beyond_is_left_out() -> None:
    found = rounds.percentiles([0.001] * 999)

    assert (found["p90"], found["p99"], found["p99.9"]) == (1, None, None)
