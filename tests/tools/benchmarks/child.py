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
from pathlib import Path
from time import perf_counter
from typing import Any

import anyio

from tests.tools.benchmarks.contender import AT_ONCE, Contender


def say(value: object) -> None:
    print(json.dumps(value), flush=True)


async def goals(contender: Contender, times: int) -> list[float]:
    """Return the number that were done, and the seconds that they took, as all orders do."""
    start = perf_counter()
    await contender.goals(times)
    return [times, perf_counter() - start]


async def batches(contender: Contender, times: int) -> list[float]:
    start = perf_counter()
    done = await contender.batches(times)
    return [done / AT_ONCE, perf_counter() - start]


async def hundred(contender: Contender, times: int) -> list[float]:
    start = perf_counter()
    await contender.at_once(times, 100)
    return [times, perf_counter() - start]


async def five_hundred(contender: Contender, times: int) -> list[float]:
    start = perf_counter()
    await contender.at_once(times, 500)
    return [times, perf_counter() - start]


async def feedback(contender: Contender, times: int) -> list[float]:
    start = perf_counter()
    return [await contender.feedback(times), perf_counter() - start]


async def goal_times(contender: Contender, times: int) -> list[tuple[float | None, float]]:
    return [(one.accepted, one.ended) for one in await contender.goal_times(times)]


async def feedback_times(contender: Contender, times: int) -> list[float]:
    return await contender.feedback_times(times)


async def hold(contender: Contender, times: int) -> None:
    await contender.hold(times)
    # Where the server is in this process, the executors may have yet to begin.
    await anyio.wait_all_tasks_blocked()


ORDERS: dict[str, Callable[[Contender, int], Awaitable[Any]]] = {
    one.__name__: one
    for one in (
        goals,
        hundred,
        five_hundred,
        batches,
        feedback,
        goal_times,
        feedback_times,
        hold,
    )
}


LOOPS: dict[str, dict[str, Any]] = {
    "asyncio": {},
    "uvloop": {"backend_options": {"use_uvloop": True}},
    "trio": {"backend": "trio"},
}
"""The event loops, as settings of `anyio.run`."""
MODULES = {path.stem.removeprefix("over_") for path in Path(__file__).parent.glob("over_*.py")}
"""The names of the contenders that have a module of their own."""


def ends_of(name: str) -> Any:
    """Return what has the two ends of a contender.

    Raises:
        ValueError: There is none of that name.
    """
    # The module of fibaction's own ways is not imported for a peer, whose memory is measured.
    if name in MODULES:
        return import_module(f"tests.tools.benchmarks.over_{name}")
    from tests.tools.benchmarks.over_fibaction import ENDS

    if name not in ENDS:
        names = ", ".join(sorted(MODULES | ENDS.keys()))
        raise ValueError(f"unknown contender {name!r}; the contenders are {names}")
    return ENDS[name]


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
