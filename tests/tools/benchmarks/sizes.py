"""The growth of the costs of a server with its size, in six directions.

    python -m tests.tools.benchmarks.sizes [DIRECTION...] [--write]

Server and clients of a direction are one process, so that the processor's time of that process is
the cost of both ends; for a fleet, that of the broker is added. `--write` puts the tables into
docs/shown_to_hold.md, and makes the picture.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from itertools import repeat
from multiprocessing import get_context
from typing import NamedTuple

import anyio

from tests.support.nats_server import PROGRAM
from tests.tools.benchmarks import size_work
from tests.tools.benchmarks.size_page import Direction, Report, Series, table, write
from tests.tools.benchmarks.size_work import TIMES, Measured
from tests.tools.benchmarks.suite import machine

GOALS = [10, 100, 1_000, 10_000, 100_000]
CONNECTIONS = [1, 10, 100, 1_000]
PAYLOADS = [1, 1_000, 32_000, 1_000_000, 16_000_000, 64_000_000]
ACTIONS = [1, 10, 100, 500]
WATCHERS = [1, 10, 100]
WORKERS = [1, 2, 4, 8, 16]


class Plan(NamedTuple):
    """The sizes of a direction, their measurement, and the names of its figures."""

    of: str
    sizes: list[int]
    measure: Callable[[Sequence[int], int], Measured]
    series: Sequence[tuple[str, str]]
    """The name and the unit of each series."""
    shown: int = 0


PLANS = {
    "goals": Plan(
        "active goals",
        GOALS,
        size_work.with_active_goals,
        [("One more goal", "µs"), ("Memory of each, both ends", "kB")],
    ),
    "connections": Plan(
        "connections",
        CONNECTIONS,
        size_work.with_connections,
        [
            ("A goal over one of them", "µs"),
            ("A second of a connection without goals", "µs"),
            ("Memory of each, both ends", "kB"),
        ],
    ),
    "payloads": Plan(
        "bytes",
        PAYLOADS,
        size_work.with_payloads,
        [("A goal and a result of this size", "µs"), ("Each megabyte of both", "µs")],
        shown=1,
    ),
    "actions": Plan(
        "actions",
        ACTIONS,
        size_work.with_actions,
        [("A goal of one of them", "µs"), ("Each action of a list of all", "µs")],
    ),
    "watchers": Plan(
        "watchers",
        WATCHERS,
        size_work.with_watchers,
        [("A goal that all of them follow", "µs"), ("Of that, each watcher", "µs")],
        shown=1,
    ),
    "workers": Plan(
        "workers",
        WORKERS,
        size_work.with_workers,
        [("A goal, one after another", "µs"), (f"A goal, {TIMES} at once", "µs")],
    ),
}


async def measure(name: str, most: int, times: int) -> Direction:
    """Measure one direction, without the sizes that are larger than `most`."""
    of, every, run, series, shown = PLANS[name]
    sizes = [size for size in every if size <= max(most, every[0])]
    columns = [column async for column in run(sizes, times)]
    values = zip(*columns, strict=True)
    found = [Series(*labels, row) for labels, row in zip(series, values, strict=True)]
    return Direction(name, of, sizes, found, shown)


def measured(name: str, most: int, times: int) -> Direction:
    """Measure one direction in this process, which has measured no other one."""
    return anyio.run(measure, name, most, times)


def main() -> None:
    """Print the tables, or write them."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.sizes")
    parser.add_argument("directions", nargs="*", metavar="DIRECTION", help=f"of {', '.join(PLANS)}")
    parser.add_argument("--most", type=int, default=max(PAYLOADS), help="leave out larger sizes")
    parser.add_argument("--times", type=int, default=TIMES, help="goals in a round")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    names = arguments.directions or list(PLANS)
    if PROGRAM is None and "workers" in names:
        raise SystemExit("the workers need nats-server, which is not installed")
    found: list[Direction] = []
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for direction in pool.map(measured, names, repeat(arguments.most), repeat(arguments.times)):
            print(table(direction), end="\n\n", flush=True)
            found.append(direction)
    if arguments.write:
        on = machine()
        where = f"{on['processor']}, {on['cores']} cores, Python {platform.python_version()}"
        write(Report(where, datetime.now(UTC).date().isoformat(), found))


if __name__ == "__main__":
    main()
