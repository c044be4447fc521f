"""ROS 2 without ROS: fibaction at `dds://` beside stock rclpy, each end in its own process.

It runs with the Python that has ROS 2; no process of fibaction imports rclpy.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from importlib.util import find_spec
from statistics import median
from time import time
from typing import Any, NamedTuple

import anyio

from tests.support.json_program import Program, program
from tests.support.processes import used_by
from tests.tools.benchmarks.contender import ACTION_NAME, AT_ONCE

OURS, STOCK = "fibaction", "rclpy"
REMEMBERED = {f"a server that remembers {count}": count for count in (10, 1000)}
"""Servers of fibaction by the number of ended goals in their lists of statuses."""
CONTENDERS = {
    OURS: "fibaction.dds",
    STOCK: "rclpy",
    **{name: f"fibaction.dds_{count}" for name, count in REMEMBERED.items()},
}
ROUNDS = 5
MESSAGES = 10_000
LARGE_MESSAGES = 60
STARTS = 7
SETTLING = 3.0
"""Seconds after which participants have found each other."""


class Row(NamedTuple):
    """A client and a server, by who made them."""

    client: str
    server: str

    def __str__(self) -> str:
        return f"{self.client} at {self.server}"


ROWS = (
    Row(OURS, STOCK),
    Row(STOCK, STOCK),
    Row(STOCK, OURS),
    Row(OURS, OURS),
    *(Row(OURS, server) for server in REMEMBERED),
)


async def measure(scale: float) -> dict[str, Any]:
    if find_spec("rclpy") is None:
        raise SystemExit("rclpy is not installed: `make ros` makes .venv-ros, which has it")
    async with peers() as (clients, servers):
        times = max(10, int(300 * scale))
        report: dict[str, Any] = {
            "goals, one after another": await one_after_another(clients, servers, times),
            f"goals, {AT_ONCE} at once": await at_once(clients, max(1, int(ROUNDS * scale))),
            "feedback of one goal": await feedback(clients, int(MESSAGES * scale)),
            "feedback of a megabyte, 30 a second": await large(
                clients, int(LARGE_MESSAGES * scale)
            ),
            "from the start of Python to the first result": await starts(
                max(3, int(STARTS * scale))
            ),
        }
    return report


@asynccontextmanager
async def peers() -> AsyncGenerator[tuple[dict[Row, Program], dict[str, Program]], None]:
    """Run all ends, in a ROS domain of their own, as tests do; clients, and servers by name."""
    from tests.ros2 import conftest  # noqa: F401  # here, because others run without ROS

    async with AsyncExitStack() as stack:

        async def started(end: str, by: str, name: str) -> Program:
            child = ("-m", f"{__package__}.child", end, CONTENDERS[by], name)
            running = await stack.enter_async_context(
                program(sys.executable, *child, environment={ACTION_NAME: name})
            )
            await running.line()
            return running

        servers = {
            name_of(row): await started("server", row.server, name_of(row)) for row in ROWS[1:]
        }
        clients = {row: await started("client", row.client, name_of(row)) for row in ROWS}
        yield clients, servers


def name_of(row: Row) -> str:
    """Return the name of the action of a row.

    A server of fibaction sends each client what the slowest can bear, so the one of the row without
    rclpy has no client of rclpy.
    """
    if row.server in REMEMBERED:
        return f"benchmark_dds_{REMEMBERED[row.server]}"
    return f"benchmark_dds_{'alone' if row == Row(OURS, OURS) else row.server}"


async def one_after_another(
    clients: dict[Row, Program], servers: dict[str, Program], times: int
) -> dict[str, float]:
    """Measure rates, and the processor time of both ends: on a machine with other work, only the
    latter is what it is on an idle one.
    """
    taken: dict[Row, list[float]] = {row: [] for row in ROWS}
    used: dict[Row, list[tuple[float, float]]] = {row: [] for row in ROWS}
    for number in range(ROUNDS + 1):
        for row, client in clients.items():
            ends = client, servers[name_of(row)]
            before = [end.cpu_seconds for end in ends]
            count = times if number else max(times, REMEMBERED.get(row.server, 0))
            _, seconds = await client.ask("goals", count)
            if number:
                taken[row].append(seconds)
                at_client, at_server = (
                    end.cpu_seconds - cpu for end, cpu in zip(ends, before, strict=True)
                )
                used[row].append((at_client, at_server))
    report: dict[str, float] = {}
    for row, all_seconds in taken.items():
        report[f"{row}, per second"] = round(times / median(all_seconds))
        for end, cpu in zip(("client", "server"), zip(*used[row], strict=True), strict=True):
            report[f"{row}, microseconds of the {end}"] = round(median(cpu) / times * 1e6)
    stock = taken[Row(STOCK, STOCK)]
    for row, target in ((Row(OURS, STOCK), 2.0), (Row(STOCK, OURS), 3.3)):
        ratios = [one / ours for ours, one in zip(taken[row], stock, strict=True)]
        report[f"{row}, to stock at both ends"] = round(median(ratios), 2)
        report[f"{row}, to stock at both ends: aim"] = target
    report[f"{Row(OURS, OURS)}, per second: aim"] = 1_500
    return report


async def at_once(clients: dict[Row, Program], rounds: int) -> dict[str, float]:
    report: dict[str, float] = {f"{Row(OURS, OURS)}, per second: aim": 3_000}
    for row in (Row(OURS, OURS), Row(OURS, STOCK)):
        found = [await clients[row].ask("batches") for _ in range(rounds)]
        report[f"{row}, per second"] = round(AT_ONCE / median(seconds for _, seconds in found))
    return report


async def feedback(clients: dict[Row, Program], messages: int) -> dict[str, float]:
    report: dict[str, float] = {"messages": messages, "aim per second, with none lost": 10_000}
    for row in (Row(OURS, OURS), Row(OURS, STOCK), Row(STOCK, STOCK)):
        found = [await clients[row].ask("feedback", messages) for _ in range(ROUNDS)]
        report[f"{row}, per second"] = round(median(arrived / taken for arrived, taken in found))
        report[f"{row}, share that arrived"] = round(
            sum(arrived for arrived, _ in found) / (messages * ROUNDS), 4
        )
    return report


async def large(clients: dict[Row, Program], messages: int) -> dict[str, float]:
    report: dict[str, float] = {"messages": messages, "aim of a core": 0.15}
    for row in (Row(OURS, OURS), Row(OURS, STOCK)):
        arrived, seconds, used = await clients[row].ask("large", messages)
        report[f"{row}, arrived"] = arrived
        report[f"{row}, per second"] = round(arrived / seconds, 1)
        report[f"{row}, client's share of a core"] = round(used / seconds, 3)
    return report


async def starts(times: int) -> dict[str, float]:
    """Measure whole programs that send one goal to the server of rclpy."""
    found: dict[str, list[tuple[float, float, float]]] = {one: [] for one in (OURS, STOCK)}
    await anyio.sleep(SETTLING)
    for _ in range(times):
        for one, starts in found.items():
            starts.append(await anyio.to_thread.run_sync(_start, one))
    report: dict[str, float] = {"aim in seconds": 0.35, "aim in megabytes": 35}
    for one, pairs in found.items():
        seconds, used, size = map(median, zip(*pairs, strict=True))
        report[f"{one}, seconds"] = round(seconds, 2)
        report[f"{one}, seconds of the processor"] = round(used, 2)
        report[f"{one}, megabytes"] = round(size, 1)
    return report


def _start(one: str) -> tuple[float, float, float]:
    """Return the seconds to the first result, those of the processor in all, and the megabytes of
    memory at that result.
    """
    command = [sys.executable, "-m", f"{__package__}.once", one, name_of(Row(STOCK, STOCK))]
    environ = dict(os.environ)
    environ.pop("PYTHONDONTWRITEBYTECODE", None)  # modules are compiled by the first start only
    begun = time()
    used = used_by(command, environ)
    answered, size = json.loads(used.out.partition("\n")[0])
    return answered - begun, used.seconds, size / 1e6
