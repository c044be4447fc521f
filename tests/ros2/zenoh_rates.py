"""Goals each second over Zenoh, with fibaction and rclpy at either end, in turns.

    FIBACTION_ZENOH_PEER=PREFIX .venv-ros/bin/python -m tests.ros2.zenoh_rates [start | memory]

The rate of a pair is the median of its rounds after the first, when both servers remember the goals
of some time.
"""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from pathlib import Path
from statistics import median
from time import perf_counter

import anyio

from fibaction import ActionClient, connect, serve
from fibaction_transports.ros2.on_zenoh.node import ZenohAdapter, ZenohNode, ZenohSettings
from fibaction_transports.ros2.settings import NodeSettings
from tests.ros2.stock.ours import Behaviour, action
from tests.ros2.stock.process import peer
from tests.ros2.stock.telling import say
from tests.ros2.test_two_middlewares import FAST_DDS
from tests.ros2.zenoh_peer import middleware, router_for
from tests.support.fibonacci import Feedback, Goal, Result

GOALS = 100
AT_ONCE = 200
ROUNDS = 8
STARTS = 12
SERVERS = {"stock": "stock_usual", "ours": "ours"}
"""The action of each server. Both remember their goals as long as is the default in rclpy and here:
a stock client spends most of its time on the lists of statuses, which have all of them.
"""


async def serve_ours() -> None:
    """Serve until standard input ends."""
    async with serve(Behaviour().server("ours"), "zenoh:///ours"):
        say("ready")
        await anyio.wait_readable(sys.stdin.fileno())


async def one_by_one(client: ActionClient[Goal, Feedback, Result]) -> float:
    began = perf_counter()
    for _ in range(GOALS):
        assert await client.call(Goal(1)) == Result([0, 1])
    return (perf_counter() - began) / GOALS


async def at_once(client: ActionClient[Goal, Feedback, Result]) -> float:
    began = perf_counter()
    async with anyio.create_task_group() as tasks:
        for _ in range(AT_ONCE):
            tasks.start_soon(client.call, Goal(1))
    return (perf_counter() - began) / AT_ONCE


async def measure() -> None:
    """Measure all pairs in turns, and print their rates and multiples of the stock pair."""
    found = defaultdict[str, list[float]](list)
    stock_node = middleware("zenoh")
    with router_for("zenoh"):
        async with (
            peer("server", **stock_node),
            peer("tests.ros2.zenoh_rates", "serve"),
            peer("client", **stock_node) as stock,
            connect("zenoh:///client") as connection,
        ):
            for _ in range(ROUNDS):
                for name, served in SERVERS.items():
                    client = connection.client(action(served))
                    await client.wait_for_server(20)
                    try:
                        seconds = await stock.ask("one_by_one", action=served, count=GOALS)
                        found[f"stock -> {name}"].append(seconds)
                    except AssertionError:  # a request was forgotten for ten seconds
                        print(f"a turn of stock -> {name} was too long")
                    found[f"ours -> {name}"].append(await one_by_one(client))
                    found[f"ours -> {name}, {AT_ONCE} at once"].append(await at_once(client))
    usual = median(found["stock -> stock"][1:])
    for name, seconds in found.items():
        one = median(seconds[1:])
        print(f"{name:28} {1 / one:7.0f}/s {usual / one:6.1f} times the stock pair")


async def start() -> None:
    """Print how long a program takes to its first goal, and to know 50 other participants."""
    with router_for("zenoh"):
        async with peer("server", **middleware("zenoh")), peer("server", **FAST_DDS):
            for url in ("zenoh:///new", "zenoh:///new?mode=client", "dds://new"):
                found: list[float] = []
                for _ in range(STARTS):
                    began = perf_counter()
                    async with connect(url, action("stock")) as client:
                        assert await client.call(Goal(1)) == Result([0, 1])
                    found.append(perf_counter() - began)
                print(f"{url:25} first goal after {median(found) * 1e3:.0f} ms")
        async with AsyncExitStack() as opened:
            known = [await opened.enter_async_context(new_node(one)) for one in range(50)]
            for one in known:
                await know(one, 50)
            async with new_node(50) as late:
                began = perf_counter()
                await know(late, 51)
                print(f"50 participants known after {(perf_counter() - began) * 1e3:.0f} ms")


async def know(node: ZenohNode, count: int) -> None:
    """Wait until a node knows so many, itself included."""
    await node.until(lambda: len(node.nodes()) >= count)


def new_node(number: int) -> AbstractAsyncContextManager[ZenohNode]:
    """Return a node with a session of its own."""
    settings = ZenohSettings(mode="client", config=f"queries_default_timeout={500_000 + number}")
    return ZenohAdapter(NodeSettings(f"n{number}"), settings).open()


def threads_and_memory() -> tuple[int, int]:
    """Return the number of threads of this process, and its memory in kilobytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    values = dict(line.split(":") for line in lines)
    return int(values["Threads"]), int(values["VmRSS"].split()[0])


async def memory() -> None:
    """Print the memory that a session in mode `client` adds to a process."""
    with router_for("zenoh"):
        async with connect("zenoh:///first?mode=client"):
            before = threads_and_memory()
            async with connect("zenoh:///second?mode=client&config=queries_default_timeout=500000"):
                after = threads_and_memory()
    print(f"another session: {after[1] - before[1]} kB, {after[0] - before[0]} threads")


if __name__ == "__main__":
    os.environ.setdefault("ROS_DOMAIN_ID", "93")
    way = {"serve": serve_ours, "memory": memory, "start": start}.get(sys.argv[-1], measure)
    anyio.run(way)
