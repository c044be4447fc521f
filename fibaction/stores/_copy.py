"""The goals in a file, read from a copy of it, so that a server can go on using the file.

A server keeps its file locked. But SQLite only appends to its write-ahead log, until it has written
all of the log to the file and begins the log anew, with another header. So a copy of both is of one
moment if neither the file nor the header of the log has changed meanwhile.

The process of the server must not do this: when a process closes a file, it loses its locks on it.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import closing, suppress
from shutil import copyfile
from tempfile import TemporaryDirectory

import anyio
from anyio import to_thread

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._journal_file import JournalFile
from fibaction.stores._wal import HEADER
from fibaction.words.errors import StoreError

TRIES = 50
PAUSE = 0.02
"""Seconds after which a file that was being written is copied again."""
TICK = 50_000_000
"""Nanoseconds in which a file can change more than once without a change of its time."""


async def stored_goals(path: str) -> dict[str, list[StoredGoal]]:
    """Return all goals in the file of a `SqliteStore`, by the names of their actions.

    Raises:
        StoreError: There is no such file, or it is not a store; the text says why.
    """
    for _ in range(TRIES):
        goals = await to_thread.run_sync(_read, path)
        if goals is not None:
            return goals
        await anyio.sleep(PAUSE)
    raise StoreError(
        f"{_failing(path)}: it changes all the time; try again when there is less work"
    )


def _failing(path: str) -> str:
    return f"cannot read the goals in {excerpt(path)}"


def _read(path: str) -> dict[str, list[StoredGoal]] | None:
    """Return the goals; None if a copy cannot be made now."""
    path = os.path.realpath(path)  # the log is beside the file, and not beside a link to it
    if os.path.exists(path) and not os.path.isfile(path):
        raise StoreError(f"{_failing(path)}: it is not a file")
    with TemporaryDirectory(prefix="fibaction-") as folder:
        copy = os.path.join(folder, "goals.db")
        try:
            if not _copied(path, copy):
                return None
        except FileNotFoundError:
            raise StoreError(f"{_failing(path)}: there is no such file") from None
        except OSError as exc:
            raise StoreError(f"{_failing(path)}: {exc.strerror}") from exc
        with closing(JournalFile(copy, "normal", failing=_failing(path))) as file:
            goals = file.goals()
    for of_action in goals.actions.values():
        of_action.drop_expired(sys.maxsize, time.time_ns())
    return {action: of_action.in_order() for action, of_action in goals.actions.items()}


def _copied(path: str, copy: str) -> bool:
    before = _state(path)
    if before is None:
        return False
    copyfile(path, copy)
    with suppress(FileNotFoundError):
        copyfile(f"{path}-wal", f"{copy}-wal")
    return _state(path) == before


def _state(path: str) -> tuple[object, ...] | None:
    """Return values that differ after each change of the file, and after each new log; None if the
    file has changed just now.
    """
    found = os.stat(path)
    if abs(time.time_ns() - found.st_mtime_ns) < TICK:
        return None
    header = b""
    with suppress(FileNotFoundError), open(f"{path}-wal", "rb") as log:
        header = log.read(HEADER)
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, header
