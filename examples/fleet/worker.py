"""A worker of the fleet: a robot that picks orders. Run as many as you like, on any machine.

    python worker.py robot1

Kill it at any moment, for example with `kill -9`: its orders go on with other robots when its lease
has ended, by default after 5 s. After Ctrl-C or SIGTERM they go on at once.

Exit codes: 0 stopped, 2 the command line, the URL or the broker cannot be used.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
from signal import SIGINT, SIGTERM

import anyio
from picking import URL, Robot, make_server

from fibaction import StoreError, TransportError, serve


async def main(url: str, name: str, period: float) -> None:
    """Serve as one worker of the fleet until a signal arrives.

    Raises:
        TransportError: The URL is invalid, or the broker cannot be used.
        StoreError: The broker does not keep what is to be kept.
    """
    mark = "&" if "?" in url else "?"
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(make_server(name, period), f"{url}{mark}worker={name}"):
            print(f"{name} serves {Robot.pick.name} as process {os.getpid()}", flush=True)
            await anext(signals)


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
    parser = argparse.ArgumentParser(
        description=__doc__,
        usage=argparse.SUPPRESS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", help="name of the robot, of which there is one in the fleet")
    parser.add_argument("--url", default=URL, help="URL of the fleet (default: %(default)s)")
    parser.add_argument(
        "--period", type=seconds, default=0.5, help="seconds per item (default: %(default)g)"
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s")
    try:
        anyio.run(main, arguments.url, arguments.name, arguments.period)
    except (TransportError, StoreError) as exc:
        parser.error(str(exc))
