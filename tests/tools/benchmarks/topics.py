"""Topics over DDS: a node of fibaction and one of rclpy, each beside the same stock peer.

It runs with the Python that has ROS 2; the process of fibaction does not import rclpy.
"""

from __future__ import annotations

import sys
from contextlib import AsyncExitStack
from importlib.util import find_spec
from statistics import median
from typing import Any, NamedTuple

import anyio

from tests.support.json_program import Program, program
from tests.tools.benchmarks.topics_end import CONTENDERS, PERIODS

ROUNDS = 5
TRIED = 20
"""Messages that show whether two ends have found each other."""
ARRIVAL = 0.5
"""Seconds for the last messages."""


class Turn(NamedTuple):
    """What a contender does in a turn."""

    title: str
    messages: int
    share: float = 0.0
    """The most that it may take of a core."""


TURNS = {
    "small": Turn("52 bytes, one each millisecond", 3_000, 0.25),
    "flood": Turn("52 bytes, as fast as they are published", 8_000),
    "large": Turn("a megabyte, 30 a second", 90, 0.1),
}


class Cost(NamedTuple):
    """What a turn has cost: seconds of the processor for a message that arrived, the share that
    arrived, and messages each second.
    """

    used: float
    arrived: float
    rate: float


async def measure(scale: float) -> dict[str, Any]:
    """Measure all turns, of one contender after the other in each round."""
    if find_spec("rclpy") is None:
        raise SystemExit("rclpy is not installed: `make ros` makes .venv-ros, which has it")
    from tests.ros2 import conftest  # noqa: F401  # here, because others run without ROS

    report: dict[str, Any] = {"aim, messages for the same processor, to rclpy": 3.0}
    async with AsyncExitStack() as stack:
        ends: dict[str, Program] = {}
        for name in ("stock", *CONTENDERS):
            child = ("-m", f"{__package__}.topics_end", name)
            ends[name] = await stack.enter_async_context(program(sys.executable, *child))
            await ends[name].line()
        for what, turn in TURNS.items():
            for way in ("received", "published"):
                for name in CONTENDERS:
                    while not (await _heard(ends, name, "small", way, TRIED))[0]:
                        pass
                costs: dict[str, list[Cost]] = {name: [] for name in CONTENDERS}
                for number in range(ROUNDS + 1):
                    for name in CONTENDERS:
                        times = max(20, int(turn.messages * scale))
                        cost = await _cost(ends, name, what, way, times)
                        if number:
                            costs[name].append(cost)
                report[f"{way}: {turn.title}"] = _row(costs, turn, PERIODS[what])
    return report


async def _cost(ends: dict[str, Program], name: str, what: str, way: str, times: int) -> Cost:
    before = ends[name].cpu_seconds
    heard, seconds = await _heard(ends, name, what, way, times)
    used = ends[name].cpu_seconds - before
    return Cost(used / heard, heard / times, heard / seconds)


async def _heard(
    ends: dict[str, Program], name: str, what: str, way: str, times: int
) -> tuple[int, float]:
    """Send messages, and return how many arrived, and the seconds between the first and last."""
    end, peer = ends[name], ends["stock"]
    sender, reader = (peer, end) if way == "received" else (end, peer)
    await sender.ask(f"{what} {name}", times)
    await anyio.sleep(ARRIVAL)
    heard, seconds = await reader.ask(f"heard {name}")
    return heard, seconds


def _row(costs: dict[str, list[Cost]], turn: Turn, period: float) -> dict[str, float]:
    row: dict[str, float] = {}
    for name, found in costs.items():
        used, arrived, rate = map(median, zip(*found, strict=True))
        row[f"{name}, microseconds of the processor for a message"] = round(used * 1e6)
        row[f"{name}, share that arrived"] = round(arrived, 3)
        row[f"{name}, messages each second"] = round(rate)
        if turn.share:
            row[f"{name}, share of a core"] = round(used / period, 3)
    if turn.share:
        row["share of a core: aim"] = turn.share
    ours, stock = costs.values()
    ratios = [theirs.used / own.used for own, theirs in zip(ours, stock, strict=True)]
    return row | {"messages for the same processor, to rclpy": round(median(ratios), 2)}
