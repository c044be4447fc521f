"""Topics over DDS: a node of fibaction and one of rclpy, each beside the same stock peer.

A third one is a bare socket on asyncio beside another one, which shows how much of the cost is the
event loop's. It runs with the Python that has ROS 2; only rclpy's processes import rclpy.
"""

from __future__ import annotations

import sys
from contextlib import AsyncExitStack
from importlib.util import find_spec
from statistics import fmean, median
from typing import Any, NamedTuple

import anyio

from tests.support.json_program import Program, program
from tests.tools.benchmarks.topics_end import PERIODS

ROUNDS = 5
PEERS = {"fibaction": "stock", "rclpy": "stock", "bare": "bare_peer"}
"""The contenders, each with its peer."""
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
        told: dict[str, Any] = {}
        for name in {**dict.fromkeys(PEERS.values()), **PEERS}:
            child = ("-m", f"{__package__}.topics_end", name)
            ends[name] = await stack.enter_async_context(program(sys.executable, *child))
            told[name] = await ends[name].line()
        await ends["bare"].ask("to", told["bare_peer"])
        await ends["bare_peer"].ask("to", told["bare"])
        for what, turn in TURNS.items():
            for way in ("received", "published"):
                for name in PEERS:
                    while not (await _heard(ends, name, "small", way, TRIED))[0]:
                        pass
                costs: dict[str, list[Cost]] = {name: [] for name in PEERS}
                for number in range(ROUNDS + 1):
                    for name in PEERS:
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
    # What was published has its cost, whether a busy peer has heard it already or not.
    return Cost(used / (heard if way == "received" else times), heard / times, heard / seconds)


async def _heard(
    ends: dict[str, Program], name: str, what: str, way: str, times: int
) -> tuple[int, float]:
    """Send messages, and return how many arrived, and the seconds between the first and last."""
    end, peer = ends[name], ends[PEERS[name]]
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
    for name in ("fibaction", "bare"):
        # Not round by round: the system counts a hundredth of a second at a time.
        ratio = fmean(one.used for one in costs["rclpy"]) / fmean(one.used for one in costs[name])
        row[f"{name}, messages for the same processor, to rclpy"] = round(ratio, 2)
    return row
