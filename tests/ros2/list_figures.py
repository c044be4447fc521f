"""Complete lists of a fleet: how many of the first looks have all robots, and in which time.

    python -m tests.ros2.list_figures [--robots 10] [--lists 100] [--busy 0] [--url ros2://]

Each robot is a stock server of rclpy in a process of its own. Each list is one `fibaction list -c`,
in a new process, one after another; `--busy` runs so many processes beside them that do nothing but
compute.
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import AsyncExitStack
from statistics import median
from time import perf_counter
from typing import Any

import anyio

from tests.ros2 import conftest  # noqa: F401  # a domain of its own
from tests.ros2.stock.process import peer

BUSY = "while True: pass"


async def one_list(url: str) -> tuple[str, float]:
    """List the actions; return what was printed, an error too, and the seconds."""
    start = perf_counter()
    command = [sys.executable, "-m", "fibaction", "-u", url, "list", "-c"]
    done = await anyio.run_process(command, check=False)
    return (done.stdout + done.stderr).decode().strip(), perf_counter() - start


async def measure(robots: int, lists: int, busy: int, url: str) -> dict[str, Any]:
    """Start the robots, list them so many times, and return the figures."""
    async with AsyncExitStack() as stack:
        for number in range(robots):
            await stack.enter_async_context(peer("robot", f"/robot{number}"))
        for _ in range(busy):
            process = await anyio.open_process([sys.executable, "-c", BUSY])
            stack.push_async_callback(process.aclose)
            stack.callback(process.kill)
        found = [await one_list(url) for _ in range(lists)]
    times = sorted(seconds for _, seconds in found)
    return {
        "url": url,
        "robots": robots,
        "busy": busy,
        "complete": sum(text == str(robots) for text, _ in found),
        "total": lists,
        "incomplete": [text for text, _ in found if text != str(robots)],
        "seconds": {"median": round(median(times), 2), "most": round(times[-1], 2)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.ros2.list_figures")
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--lists", type=int, default=100)
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--url", default="ros2://")
    given = parser.parse_args()
    figures = anyio.run(measure, given.robots, given.lists, given.busy, given.url)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
