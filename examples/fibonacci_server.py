"""A server of the Fibonacci action, which runs until Ctrl-C or SIGTERM.

Exit codes: 0 stopped, 2 the command line or the URL is invalid.
"""

from __future__ import annotations

import argparse
import logging
import math
from importlib.util import find_spec
from signal import SIGINT, SIGTERM

import anyio
from fibonacci import FIBONACCI, URL, make_server

from fibaction import GoalStatus, TransportError, serve
from fibaction.border.abc import StatusStream

logger = logging.getLogger("fibonacci")


async def main(url: str, period: float) -> None:
    """Serve until a signal arrives, then end the goals, so that their clients get an outcome.

    Raises:
        TransportError: The URL is invalid or cannot be served at.
    """
    server = make_server(period)
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(server, url) as (where,), anyio.create_task_group() as tasks:
            tasks.start_soon(log_goals, await server.status())
            print(f"serving {FIBONACCI.name} at {where}, Ctrl-C stops it", flush=True)
            await anext(signals)
            # This also ends the stream of statuses, after the last one, and so the task above.
            await server.stop()


async def log_goals(changes: StatusStream) -> None:
    """Log each status change of each goal until the server stops."""
    with changes:
        while (goal := await changes.receive()) is not None:
            if goal.status is not GoalStatus.UNKNOWN:  # its end has been logged before
                logger.info("goal %s %s", goal.goal_id, goal.status.name)


def seconds(text: str) -> float:
    """Read a finite number of seconds, 0 or more.

    Raises:
        ValueError: The text is something else.
    """
    value = float(text)
    if not 0 <= value < math.inf:
        raise ValueError(text)
    return value


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--url", default=URL, help="URL to serve at (default: %(default)s)")
    parser.add_argument(
        "--period", type=seconds, default=1.0, help="seconds per number (default: %(default)g)"
    )
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, help="all that follows is for ROS 2, with ros2://"
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    options = {"use_uvloop": find_spec("uvloop") is not None}
    try:
        anyio.run(main, arguments.url, arguments.period, backend_options=options)
    except TransportError as exc:
        parser.error(str(exc))
