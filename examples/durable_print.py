"""A 3-D printer whose jobs survive it: kill it at any moment, start it again, and it goes on.

    python examples/durable_print.py
    fibaction send_goal print "{name: gear, layers: 60}" --feedback

The object is a text file with one line for each layer. Kill the printer while it works, for example
with `kill -9`, and start it again: it goes on above the last layer that it has kept, and the client
that waits sees only a pause. After Ctrl-C, a planned stop, it goes on in the same way. One object
is printed at a time; the jobs that wait are kept, too. A job during which the printer was killed
three times is given up.

Exit codes: 0 stopped, 2 the command line, the URL or the store cannot be used.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
from pathlib import Path
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
from msgspec import Struct

from fibaction import (
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    Report,
    Schedule,
    SqliteStore,
    StoreError,
    TransportError,
    action,
    serve,
)

URL = "tcp://127.0.0.1:7400"
DAY = 24 * 60 * 60
MOST_LAYERS = 100_000


class Goal(Struct):
    """An order to print an object of so many layers."""

    name: str
    layers: int


class Feedback(Struct):
    """The number of layers that are printed."""

    layers: int


class Result(Struct):
    """The number of printed layers, also if the job was canceled, and the file with the object."""

    layers: int
    file: str


def on_goal(goal: Goal) -> None:
    """Accept an object that has a name for a file, and at least one layer.

    Raises:
        GoalRejected: It cannot be printed.
    """
    if not goal.name.isidentifier():
        raise GoalRejected(
            f"{goal.name!r} is not a name: letters, digits and _, and a letter or _ first"
        )
    if not 1 <= goal.layers <= MOST_LAYERS:
        raise GoalRejected(f"an object has 1 to {MOST_LAYERS} layers, not {goal.layers}")


class Printer:
    """A printer that puts objects into a folder, and takes `period` seconds for each layer."""

    def __init__(self, folder: Path, period: float) -> None:
        self._folder = folder
        self._period = period

    @action(checkpoint=int)
    async def print(
        self, report: Report[Feedback], handle: GoalHandle[object], goal: Goal
    ) -> Result:
        """Print layer upon layer, from the last one that was kept."""
        done: int = handle.restored or 0
        file = self._folder / f"{goal.name}-{handle.goal_id}.txt"
        print(f"{file.name}: attempt {handle.attempt}, from layer {done + 1}", flush=True)
        try:
            while done < goal.layers:
                await anyio.sleep(self._period)
                put_layer(file, done + 1)
                # A kill at this point makes the next attempt print this layer again. That does no
                # harm, since a layer goes to its own height.
                done += 1
                await handle.checkpoint(done)
                await report(Feedback(done))
        except anyio.get_cancelled_exc_class():
            raise GoalCanceled(result=Result(done, file.name)) from None
        return Result(done, file.name)


def put_layer(file: Path, number: int) -> None:
    """Write a layer to its own place in the file, the first one at the beginning."""
    line = f"layer {number:6}\n".encode()
    with file.open("r+b" if file.exists() else "wb") as stream:
        stream.seek((number - 1) * len(line))
        stream.write(line)
        stream.flush()
        os.fsync(stream.fileno())  # the work is on the disk before the checkpoint says so


def make_server(store: Path, folder: Path, period: float) -> ActionServer[Any, Feedback, Result]:
    """Return a printer that keeps its jobs in a store, and results for a day."""
    return ActionServer(
        Printer(folder, period).print,
        on_goal=on_goal,
        schedule=Schedule(concurrency=1, queue=100),
        store=SqliteStore(store),
        recovery="rerun",
        at_stop="keep",
        result_timeout=DAY,
    )


async def main(url: str, store: Path, folder: Path, period: float) -> None:
    """Serve the printer until a signal arrives.

    Raises:
        TransportError: The URL is invalid or cannot be served at.
        StoreError: The store cannot be used, or has failed.
    """
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(make_server(store, folder, period), url) as (where,):
            print(f"serving {Printer.print.name} at {where}, Ctrl-C stops it", flush=True)
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


def folder(text: str) -> Path:
    """Read the path of a folder that exists.

    Raises:
        ValueError: There is no such folder.
    """
    path = Path(text)
    if not path.is_dir():
        raise ValueError(text)
    return path


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(
        description=__doc__,
        usage=argparse.SUPPRESS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--url", default=URL, help="URL to serve at (default: %(default)s)")
    parser.add_argument(
        "--store", type=Path, default="print.db", help="file of the jobs (default: %(default)s)"
    )
    parser.add_argument(
        "--folder", type=folder, default=".", help="folder for the objects (default: this one)"
    )
    parser.add_argument(
        "--period", type=seconds, default=0.5, help="seconds per layer (default: %(default)g)"
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    try:
        anyio.run(main, arguments.url, arguments.store, arguments.folder, arguments.period)
    except (TransportError, StoreError) as exc:
        parser.error(str(exc))
