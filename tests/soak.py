"""A soak: fifty connections with goals of all kinds, for some minutes, in one process.

    make soak            # ten minutes; or: python -m tests.soak --seconds 60 --over ws

It prints, once in a while, how much memory is in use, and how many tasks and files are open; at the
end it fails if any of them has grown after the first tenth of the time.
"""

from __future__ import annotations

import argparse
import gc
import json
import logging
import math
import os
import random
import resource
import sys
from collections import Counter
from collections.abc import AsyncGenerator
from pathlib import Path

import anyio

from fibaction import ActionServer, GoalHandle, connect, serve
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result

CONNECTIONS = 50
GROWTH = 1.1
"""The factor by which memory may grow because of the allocator's fragmentation."""


async def work(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    for number in range(goal.request.order):
        yield Feedback([number] * 10)
        if number % 7 == 0:
            await anyio.lowlevel.checkpoint()
    if goal.request.order % 5 == 0:
        raise ValueError("one goal in five goes wrong")
    yield Result([goal.request.order])


async def client(url: str, seed: int, until: float, ends: Counter[str]) -> None:
    chance = random.Random(seed)
    while anyio.current_time() < until:
        async with connect(url, FIBONACCI, heartbeat=5) as connected:
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
                if anyio.current_time() >= until:
                    break


def state() -> dict[str, int]:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "memory": pages * resource.getpagesize(),
        "tasks": len(anyio.get_running_tasks()),
        "files": len(os.listdir("/proc/self/fd")),
    }


async def soak(seconds: float, scheme: str) -> int:
    ends: Counter[str] = Counter()
    nothing_open = state()
    server = ActionServer(FIBONACCI, work, max_results=100)
    async with serve(server, f"{scheme}://127.0.0.1:0", heartbeat=5) as (url,):
        start = anyio.current_time()
        async with anyio.create_task_group() as tasks:
            for seed in range(CONNECTIONS):
                tasks.start_soon(client, url, seed, start + seconds, ends)
            await anyio.sleep(seconds / 10)
            warm = state()
            for _ in range(9):
                await anyio.sleep(seconds / 10)
                print(json.dumps({"goals": ends.total(), **state()}), flush=True)
            last = state()
    after = state()
    states = {"before": nothing_open, "warm": warm, "last": last, "after": after}
    print(json.dumps({"ends": dict(ends), **states}))
    grown = last["memory"] > warm["memory"] * GROWTH
    left = any(after[what] > nothing_open[what] for what in ("tasks", "files"))
    return 1 if grown or left or not ends else 0


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.soak",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--seconds", type=float, default=600.0, help="how long it takes; %(default)g if not given"
    )
    parser.add_argument(
        "--over",
        choices=["tcp", "ws", "http"],
        default="tcp",
        help="the transport; %(default)s if not given",
    )
    arguments = parser.parse_args()
    seconds = arguments.seconds
    if not 0 < seconds < math.inf:
        parser.error("--seconds is more than 0")
    # One goal in five goes wrong on purpose, and its traceback is not what is looked for here.
    logging.getLogger("fibaction.server").setLevel(logging.CRITICAL)
    return anyio.run(soak, seconds, arguments.over)


if __name__ == "__main__":
    sys.exit(main())
