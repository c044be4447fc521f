"""`python -m tests.tools.benchmarks.child server NAME` or `client NAME ADDRESS`: one end of a
contender.

It says what it has to say in lines of JSON. A server gives its address, and serves until standard
input ends; so it never outlives the benchmark, however that ends. A client says `ready`, and is
then told what to do: the name of a function below, and how many times.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Awaitable, Callable
from importlib import import_module
from time import perf_counter
from typing import Any

import anyio

from tests.tools.benchmarks.contender import AT_ONCE, Contender


def say(value: object) -> None:
    print(json.dumps(value), flush=True)


Work = Callable[[Contender, int], Awaitable[Any]]
"""A piece of work that is done so many times."""


def timed(work: Work) -> Work:
    """Return work with the number that was done, if it says so, and the seconds that it took."""

    async def do(contender: Contender, times: int) -> list[float]:
        start = perf_counter()
        done = await work(contender, times)
        return [times if done is None else done, perf_counter() - start]

    return do


async def batches(contender: Contender, times: int) -> float:
    return await contender.batches(times) / AT_ONCE


async def hold(contender: Contender, times: int) -> None:
    await contender.hold(times)
    # Where the server is in this process, the executors may have yet to begin.
    await anyio.wait_all_tasks_blocked()


ORDERS: dict[str, Work] = {
    "goals": timed(lambda contender, times: contender.goals(times)),
    "batches": timed(batches),
    "feedback": timed(lambda contender, times: contender.feedback(times)),
    "goal_times": lambda contender, times: contender.goal_times(times),
    "feedback_times": lambda contender, times: contender.feedback_times(times),
    "large": lambda contender, times: contender.large(times),
    "hold": hold,
}


LOOPS: dict[str, dict[str, Any]] = {
    "asyncio": {},
    "uvloop": {"backend_options": {"use_uvloop": True}},
    "trio": {"backend": "trio"},
}
"""The event loops, as settings of `anyio.run`."""


def ends_of(name: str) -> Any:
    """Return what has the two ends of a contender: a module, or an `Ends` of it after a dot.

    Raises:
        ValueError: There is none of that name.
    """
    module, _, way = name.partition(".")
    try:
        found = import_module(f"tests.tools.benchmarks.over_{module}")
    except ModuleNotFoundError as exc:
        if exc.name != f"tests.tools.benchmarks.over_{module}":
            raise
        raise ValueError(f"unknown contender {name!r}") from None
    return found.ENDS[way] if way else found


async def server(module: Any) -> None:
    async with module.serve() as address:
        say(address)
        await anyio.to_thread.run_sync(sys.stdin.read, abandon_on_cancel=True)


async def client(module: Any, address: str) -> None:
    async with module.connect(address) as contender:
        say("ready")
        while line := await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True):
            order = json.loads(line)
            say(await ORDERS[order["do"]](contender, order["times"]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.child")
    parser.add_argument("end", choices=["server", "client"])
    parser.add_argument("name", help="of a way")
    parser.add_argument("address", nargs="?", default="", help="for a client: what a server gave")
    parser.add_argument("--loop", choices=LOOPS, default="asyncio", help="%(default)s by default")
    arguments = parser.parse_args()
    try:
        module = ends_of(arguments.name)
    except ValueError as exc:
        parser.error(str(exc))
    if arguments.end == "server":
        anyio.run(server, module, **LOOPS[arguments.loop])
    else:
        anyio.run(client, module, arguments.address, **LOOPS[arguments.loop])
