"""`python -m tests.tools.benchmarks.many_participants`: fifty participants of DDS on one machine.

Each of some processes has nodes with an action server each, at `dds://` on this machine only. One
client waits for all of them, and sends a goal to each. It prints the seconds, those of the
processor of the servers, and the share of a core that these use when nothing happens.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import AsyncExitStack
from time import perf_counter

import anyio

from fibaction import ActionServer, connect, serve
from tests.support.fibonacci import Goal
from tests.support.json_program import ROOT, program
from tests.support.ros_domain import own_domain
from tests.tools.benchmarks.child import say
from tests.tools.benchmarks.over_fibaction import action_of_ros, execute_of_ros

FOLDERS = ROOT / "examples/ros2"
IDLE = 10.0
"""Seconds in which nothing happens."""


def name_of(number: int) -> str:
    return f"robot_{number}/fibonacci"


async def serve_some(first: int, count: int) -> None:
    """Serve some actions, each at a node of its own, until the input ends."""
    async with AsyncExitStack() as stack:
        for number in range(first, first + count):
            server = ActionServer(action_of_ros(name_of(number)), execute_of_ros)
            await stack.enter_async_context(serve(server, f"dds://robot_{number}"))
        say("ready")
        await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True)


async def drive(participants: int, processes: int) -> None:
    """Start the servers, and send a goal to each of them."""
    each = participants // processes
    begun = perf_counter()
    async with AsyncExitStack() as stack:
        others = [
            await stack.enter_async_context(
                program(sys.executable, "-m", __spec__.name, "--first", f"{first}", f"{each}")
            )
            for first in range(0, each * processes, each)
        ]
        for other in others:
            await other.line()
        tell(f"{each * processes} participants in {processes} processes are ready", begun)
        connection = await stack.enter_async_context(connect("dds://driver"))
        clients = [
            connection.client(action_of_ros(name_of(number))) for number in range(each * processes)
        ]
        for client in clients:
            await client.wait_for_server()
        tell("the client has found all of them", begun)
        async with anyio.create_task_group() as tasks:
            for client in clients:
                tasks.start_soon(client.call, Goal(0))
        tell("each has run a goal", begun)
        used = [other.cpu_seconds for other in others]
        await anyio.sleep(IDLE)
        idle = sum(other.cpu_seconds for other in others) - sum(used)
        print(f"{sum(used):5.1f} s of the processor; idle {idle / IDLE:.3f} of a core")


def tell(what: str, begun: float) -> None:
    print(f"{perf_counter() - begun:5.1f} s: {what}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("participants", type=int, nargs="?", default=50)
    parser.add_argument("--processes", type=int, default=5)
    parser.add_argument("--first", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.first is not None:
        anyio.run(serve_some, given.first, given.participants)
        return
    with own_domain() as patch:
        patch.setenv("FIBACTION_SEARCH", str(FOLDERS))
        anyio.run(drive, given.participants, given.processes)


if __name__ == "__main__":
    main()
