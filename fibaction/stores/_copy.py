"""The goals in a file, in a copy of it, so that a server can continue using the file.

A server keeps its file locked. But SQLite only appends to its write-ahead log, until it has written
all of the log to the file and begins the log again, with another header. So a copy of both is of
one moment if neither the file nor the header of the log has changed meanwhile.

The process of the server must not do this: when a process closes a file, it loses its locks on it.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager, suppress
from functools import partial
from shutil import copyfile, copymode
from stat import S_ISREG
from tempfile import TemporaryDirectory
from typing import TypeVar

import anyio
from anyio import to_thread

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._history import past_in
from fibaction.stores._journal_file import JournalFile
from fibaction.stores._wal import HEADER
from fibaction.words.errors import StoreError
from fibaction.words.goal_query import GoalQuery

ValueT = TypeVar("ValueT")

TRIES = 50
COPY_PAUSE = 0.02
"""Seconds after which a file that was being written is copied again."""
TICK = 50_000_000
"""Nanoseconds in which a file can change more than once without a change of its time."""


async def stored_goals(path: str, past: GoalQuery | None = None) -> dict[str, list[StoredGoal]]:
    """Return all goals in the file of a `SqliteStore`, by the names of their actions; with `past`,
    also those of its history that are wanted, without their requests.

    Raises:
        StoreError: There is no such file, or it is not a store; the text says why.
    """
    failing = f"cannot read the goals in {excerpt(path)}"
    return await _with_copy(path, failing, None, partial(_read, failing, past))


async def back_up(path: str, target: str) -> int:
    """Copy the file of a `SqliteStore` and its log into one new file, and return the number of its
    goals. A file of that name is replaced.

    Raises:
        StoreError: There is no such file, or it is not a store; the text says why.
        OSError: The new file cannot be written.
    """
    failing = f"cannot back up the goals in {excerpt(path)}"
    return await _with_copy(path, failing, target, partial(_keep, failing, path, target))


async def _with_copy(
    path: str, failing: str, target: str | None, use: Callable[[str], ValueT]
) -> ValueT:
    """Return what `use` makes of a copy of the file and its log."""
    for _ in range(TRIES):
        made = await to_thread.run_sync(_try, path, failing, target, use)
        if made:
            return made[0]
        await anyio.sleep(COPY_PAUSE)
    raise StoreError(f"{failing}: it changes all the time; try again when there is less work")


def _try(
    path: str, failing: str, target: str | None, use: Callable[[str], ValueT]
) -> tuple[ValueT] | tuple[()]:
    """Return what `use` makes of a copy, which is on the disk of the target, in a tuple; an empty
    one if a copy cannot be made now.
    """
    path = os.path.realpath(path)  # the log is next to the file, and not next to a link to it
    with _explained(failing):
        if not S_ISREG(os.stat(path).st_mode):
            raise StoreError(f"{failing}: it is not a file")
    folder = None if target is None else os.path.dirname(os.path.abspath(target))
    with TemporaryDirectory(prefix=".fibaction-", dir=folder) as within:
        copy = os.path.join(within, "goals.db")
        with _explained(failing):
            if not _copied(path, copy):
                return ()
        return (use(copy),)


def _read(failing: str, past: GoalQuery | None, copy: str) -> dict[str, list[StoredGoal]]:
    # "normal": a log that is written while it is copied may look like a damaged one.
    with closing(JournalFile(copy, "normal", failing=failing)) as file:
        goals = file.goals()
        of_past = {} if past is None else past_in(file, past)
    for of_action in goals.actions.values():
        of_action.drop_expired(sys.maxsize, time.time_ns())
    found = {action: of_action.in_order() for action, of_action in goals.actions.items()}
    for action, ended in of_past.items():
        kept = found.get(action, [])
        known = {(goal.stamp, goal.goal_id) for goal in kept}
        found[action] = [one for one in ended if (one.stamp, one.goal_id) not in known] + kept
    return found


def _keep(failing: str, path: str, target: str, copy: str) -> int:
    """Check the copy, which leaves one file, and give it its name."""
    goals = _read(failing, None, copy)
    copymode(path, copy)
    os.replace(copy, target)
    return sum(map(len, goals.values()))


@contextmanager
def _explained(failing: str) -> Generator[None, None, None]:
    try:
        yield
    except FileNotFoundError:
        raise StoreError(f"{failing}: there is no such file") from None
    except OSError as exc:
        raise StoreError(f"{failing}: {exc.strerror}") from exc


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
