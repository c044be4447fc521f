"""`python -m tests.soak.ends server URL` or `client URL`: one of the two processes of a soak.

Each answers the orders of its standard input, one in a line, with a line of JSON: `begin` and
`state` with what it uses now, `end` with what it uses when it has let go of everything. It lives
until its input ends.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path
from typing import Any

import anyio
from anyio import TASK_STATUS_IGNORED
from anyio.abc import TaskStatus

from fibaction import ActionServer, GoalHandle, connect, serve
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

CONNECTIONS = {"tcp": 50, "ws": 50, "http": 50, "dds": 4}
"""The connections at the same time, by the transport; over DDS, each is a participant."""
SETTLING = 30.0
"""Seconds for what ends a moment after the last block: a socket closes when its last bytes are out,
in a later turn of the event loop. What has leaked stays longer."""


async def work(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    for number in range(goal.request.order):
        yield Feedback([number] * 10)
        if number % 7 == 0:
            await anyio.lowlevel.checkpoint()
    if goal.request.order % 5 == 0:
        raise ValueError("one goal in five goes wrong")
    yield Result([goal.request.order])


async def visit(
    url: str,
    seed: int,
    is_over: anyio.Event,
    ends: Counter[str],
    *,
    task_status: TaskStatus[None] = TASK_STATUS_IGNORED,
) -> None:
    """Connect again and again, and send goals over each connection."""
    chance = random.Random(seed)
    is_first = True
    while not is_over.is_set():
        async with connect(url, FIBONACCI, **settings(url)) as connected:
            if is_first:
                task_status.started()
                is_first = False
            for _ in range(chance.randrange(1, 200)):
                async with connected.send_goal(Goal(chance.randrange(100))) as goal:
                    if chance.random() < 0.3:
                        await goal.cancel()
                    if chance.random() < 0.5:
                        async for _ in goal.feedback:
                            if chance.random() < 0.05:
                                break
                    if chance.random() < 0.9:
                        ends[(await goal.outcome()).status.name] += 1
                if is_over.is_set():
                    break


def settings(url: str) -> dict[str, Any]:
    """Return the settings of both ends."""
    return {} if url.startswith("dds") else {"heartbeat": 5}


def state() -> dict[str, Any]:
    """Return what this process uses: memory in bytes, and processor time in seconds."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "memory": pages * resource.getpagesize(),
        "tasks": len(anyio.get_running_tasks()),
        "files": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
        "seconds": time.process_time(),
    }


async def settled(before: dict[str, Any]) -> dict[str, Any]:
    """Return the state as soon as there is no more than before, or after `SETTLING` seconds."""
    with anyio.move_on_after(SETTLING):
        while any(  # noqa: ASYNC110  # no event says that a file is closed
            state()[what] > before[what] for what in ("tasks", "files", "threads")
        ):
            await anyio.sleep(0.02)
    return state()


def say(value: object) -> None:
    print(json.dumps(value), flush=True)


async def orders() -> AsyncIterator[str]:
    """Yield the orders of the standard input, until it ends."""
    while line := await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True):
        yield json.loads(line)["do"]


async def server(url: str, given: AsyncIterator[str]) -> dict[str, Any]:
    """Serve until the order to end."""
    server = ActionServer(FIBONACCI, work, max_results=100)
    async with serve(server, url, **settings(url)) as (address,):
        say(address)
        await answer(given, Counter())
    return {}


async def client(url: str, given: AsyncIterator[str]) -> dict[str, Any]:
    """Send goals over all connections until the order to end; return how they ended."""
    ends: Counter[str] = Counter()
    is_over = anyio.Event()
    async with anyio.create_task_group() as tasks:
        for seed in range(
            CONNECTIONS[url.partition(":")[0]]
        ):  # all of them are open when the first sample is taken
            await tasks.start(visit, url, seed, is_over, ends)
        await answer(given, ends)
        is_over.set()
    return {"ends": dict(ends)}


async def answer(given: AsyncIterator[str], ends: Counter[str]) -> None:
    """Tell the state at each order, until the one to end."""
    async for order in given:
        if order == "end":
            return
        say({"goals": ends.total(), **state()})


async def run(end: str, url: str) -> None:
    given = orders()
    await anext(given)
    gc.freeze()  # modules stay, and each collection would look at them again
    await anyio.getaddrinfo("127.0.0.1", 0)  # asyncio keeps the thread that it starts for this
    before = state()
    say(before)
    found = await (server if end == "server" else client)(url, given)
    say({**found, **await settled(before)})
    async for _ in given:
        pass


if __name__ == "__main__":
    # One goal in five goes wrong on purpose, and its traceback is not what is looked for here.
    logging.getLogger("fibaction.server").setLevel(logging.CRITICAL)
    anyio.run(run, sys.argv[1], sys.argv[2])
