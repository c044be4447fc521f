"""The server that is killed, in a process of its own, and the diary that outlives it."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncGenerator, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from signal import SIGTERM
from typing import Any, Literal, TypeAlias

import anyio
import msgspec

from fibaction import (
    Action,
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    Schedule,
    SqliteStore,
    serve,
)

TOO_HARD = "it was too hard"


class Work(msgspec.Struct):
    """A goal: so many steps, with a pause before each."""

    steps: int
    pause: float
    fails: bool = False
    """True if the goal ends as ABORTED after its last step."""
    tidying: float = 0.0
    """Seconds of the clean-up after a cancel."""
    key: int = 0
    """The thing that the goal needs for itself, where there is a limit for it."""


class Done(msgspec.Struct):
    """The number of steps that were taken, and the attempt that took the last one."""

    steps: int
    attempt: int


WORK = Action("work", goal=Work, feedback=int, result=Done, checkpoint=int)


class Setup(msgspec.Struct):
    """The settings of the server."""

    url: str
    store: str
    diary: str
    recovery: Literal["abort", "rerun"]
    max_attempts: int = 3


What: TypeAlias = Literal["began", "stepped", "kept"]


class Entry(msgspec.Struct):
    """A line of the diary: something that an executor has begun or done, or was told is kept."""

    at: int
    """Nanoseconds of the clock that all processes of this machine share."""
    what: What
    goal_id: str
    attempt: int
    steps: int
    """The steps that an attempt began with, those that it has taken, or those that are kept."""


LINE = 256
"""Bytes of a line of the diary. SIGKILL may cut a write between two pages, so no line is in two."""


class Diary:
    """A file to which executors append what they do. Each line is there when `write` returns, also
    after SIGKILL.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def write(self, what: What, goal: GoalHandle[Work], steps: int) -> None:
        """Append an entry about a goal."""
        entry = Entry(time.monotonic_ns(), what, str(goal.goal_id), goal.attempt, steps)
        os.write(self._file, msgspec.json.encode(entry).ljust(LINE - 1) + b"\n")

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def entries_of(path: Path) -> Iterator[Entry]:
    """Yield the entries of a diary."""
    for line in path.read_bytes().splitlines():
        yield msgspec.json.decode(line, type=Entry)


class Worker:
    """The executor, which keeps each second step."""

    def __init__(self, diary: Diary) -> None:
        self._diary = diary

    async def __call__(self, goal: GoalHandle[Work]) -> AsyncGenerator[int | Done, None]:
        steps: int = goal.restored or 0
        self._diary.write("began", goal, steps)
        try:
            while steps < goal.request.steps:
                await anyio.sleep(goal.request.pause)
                steps += 1
                self._diary.write("stepped", goal, steps)
                if steps % 2 == 0:
                    await goal.checkpoint(steps)
                    self._diary.write("kept", goal, steps)
                yield steps
        except anyio.get_cancelled_exc_class():
            await anyio.sleep(goal.request.tidying)
            raise GoalCanceled(result=Done(steps, goal.attempt)) from None
        if goal.request.fails:
            raise GoalAborted(TOO_HARD, result=Done(steps, goal.attempt))
        yield Done(steps, goal.attempt)


async def serve_until_stopped(url: str, diary: str, parent: Connection, **settings: Any) -> None:
    """Serve at a URL, tell the parent when clients can connect, and stop at SIGTERM."""
    written = Diary(Path(diary))
    server = ActionServer(
        WORK, Worker(written), result_timeout=float("inf"), max_results=1_000_000, **settings
    )
    with anyio.open_signal_receiver(SIGTERM) as signals:
        async with serve(server, url):
            parent.send("serving")
            await anext(signals)
    written.close()


async def serve_until_killed(setup: Setup, parent: Connection) -> None:
    """Serve goals that are kept in a file."""
    await serve_until_stopped(
        f"{setup.url}?heartbeat=1",
        setup.diary,
        parent,
        schedule=Schedule(concurrency=15, queue=1000),
        store=SqliteStore(setup.store),
        recovery=setup.recovery,
        max_attempts=setup.max_attempts,
        at_stop="keep",
    )


def run_victim(setup: Setup, parent: Connection) -> None:
    """Run the server in this process."""
    anyio.run(serve_until_killed, setup, parent)
