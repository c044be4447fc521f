"""A client of the fleet: it sends some orders at once, and prints which robot picks what.

    python client.py --orders 8

It knows the broker, and no robot. Kill one of them meanwhile: its orders go on with other robots.

Exit codes: 0 all orders are picked, 1 one was not, 2 the command line or the URL is invalid, 6 no
robot or no broker.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import anyio
from picking import URL, Order, Picked, Progress, Robot

from fibaction import (
    ActionClient,
    ActionError,
    ConnectionLost,
    Retry,
    ServerNotFound,
    TransportError,
    connect,
)

FAILED, UNREACHABLE = 1, 6
ITEMS = 10
PATIENT = Retry(attempts=20)
"""Sends an order again while all robots are busy."""


async def main(url: str, orders: int) -> int:
    """Send orders, wait until they are picked, and return the exit code.

    Raises:
        TransportError: The URL is invalid.
        ServerNotFound: No robot serves the action.
        ConnectionLost: The broker is gone.
    """
    done: list[bool] = []
    async with connect(url, Robot.pick) as client:
        await client.wait_for_server(timeout=10)
        async with anyio.create_task_group() as tasks:
            for number in range(1, orders + 1):
                tasks.start_soon(order, client, number, done)
    print(f"{sum(done)} of {orders} orders are picked", flush=True)
    return 0 if all(done) else FAILED


async def order(client: ActionClient[Any, Progress, Picked], number: int, done: list[bool]) -> None:
    """Send an order, print each item, and note whether all items were picked."""
    robot = ""

    def on_feedback(progress: Progress) -> None:
        nonlocal robot
        moved = f", after {robot}" if robot not in ("", progress.robot) else ""
        robot = progress.robot
        print(f"order {number:2}  item {progress.items:2} of {ITEMS} by {robot}{moved}", flush=True)

    try:
        picked = await client.call(Order(ITEMS), on_feedback=on_feedback, retry=PATIENT)
    except ActionError as error:
        print(f"order {number:2}  {error}", flush=True)
        done.append(False)
    else:
        print(f"order {number:2}  is picked: {picked.items} items", flush=True)
        done.append(picked.items == ITEMS)


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(
        description=__doc__,
        usage=argparse.SUPPRESS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--url", default=URL, help="URL of the fleet (default: %(default)s)")
    parser.add_argument(
        "--orders", type=int, default=8, help="orders that are sent (default: %(default)d)"
    )
    arguments = parser.parse_args()
    try:
        sys.exit(anyio.run(main, arguments.url, arguments.orders))
    except (ServerNotFound, ConnectionLost) as exc:
        parser.exit(UNREACHABLE, f"error: {exc}\n")
    except TransportError as exc:
        parser.error(str(exc))
