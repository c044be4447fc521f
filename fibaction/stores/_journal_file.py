"""The file of a journal: a database of SQLite, used by one thread of one process.

The journal is one table. A history is another one, which `_history` writes by `add_with`.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from copy import copy
from pathlib import Path
from typing import TypeVar

from anyio import to_thread

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._wal import (
    LOG_IS_MISSING,
    PAGE,
    begin_log,
    is_damaged,
    lacks_log,
    prepare_mark,
)
from fibaction.stores.journal_rows import DamagedRow, KeptGoals, WholeRecord, encode_row
from fibaction.words.errors import StoreError
from fibaction.words.goals import GoalID

FoundT = TypeVar("FoundT")

APPLICATION = 0x66696261
"""The `application_id` in the header of the file: "fiba"."""
VERSION = 1
"""The `user_version` in the header of the file: the version of the table and of its rows."""
LARGEST_LOG = 4 * 1024 * 1024
"""Bytes that are written to the write-ahead log before it is copied to the file."""

WHAT_TO_DO = {
    sqlite3.SQLITE_BUSY: (
        "it is in use by another process or another SqliteStore; stop that one, use another file,"
        " or give the servers of one process one SqliteStore"
    ),
    sqlite3.SQLITE_FULL: "the disk is full; make room on it and start the server again",
    sqlite3.SQLITE_READONLY: "the file or its folder is read-only; allow this process to write",
    sqlite3.SQLITE_NOTADB: "it is not a store of goals; use another file",
    sqlite3.SQLITE_CORRUPT: (
        "the file is damaged; restore it and the files next to it from a copy, or remove all of"
        " them to start without its goals"
    ),
}
"""The text for each of SQLite's errors that people can do something about."""


class JournalFile:
    """The open file of a journal. Each method can raise a StoreError."""

    def __init__(
        self, path: str, sync: str, failing: str = "", *, largest_log: int = LARGEST_LOG
    ) -> None:
        """Open the file, or make a new one, and lock it. An error begins with what is `failing`.

        Raises:
            StoreError: It cannot be used; the text says why.
        """
        self._path = path
        self._failing = failing or f"cannot keep goals in {excerpt(path)}"
        self._largest_log = largest_log
        self._last = 0
        self._logged = 0
        self.size = 0
        """Bytes of all rows."""
        self.first_size = 0
        """Bytes of the rows that `replace` wrote last."""
        _check_place(path)
        if lacks_log(path):
            raise self._error(LOG_IS_MISSING)
        if sync == "full":  # without it, several of the last commits may be torn after a power cut
            self._check_log()
        with suppress(OSError):  # SQLite has better words for what is wrong
            # For its owner only, and so is the log, since the goals of all clients are in them.
            # "EXCL": to close a file that exists would end the lock that this process may have.
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
        with self._explained():
            # Without a timeout: the process that has the lock keeps it until it ends.
            self._db = sqlite3.connect(path, timeout=0, isolation_level=None)
        try:
            with self._explained():
                self._prepare(sync)
                self._last = self._db.execute("select coalesce(max(n), 0) from log").fetchone()[0]
            self._identity = _identity_of(path)
            self._log_identity = _identity_of(path + "-wal")
        except BaseException:
            self._db.close()
            raise

    def _check_log(self) -> None:
        """Check what SQLite would read as the end of the log, then remove."""
        with self._explained():
            if not os.path.exists(self._path) or not is_damaged(self._path + "-wal"):
                return
            # The process that uses the file may have written to its log meanwhile. Reading leaves
            # the log as it is, so that the next start finds the damage, too.
            uri = f"{Path(self._path).as_uri()}?mode=ro"
            with closing(sqlite3.connect(uri, timeout=0, uri=True)) as db:
                db.execute("select count(*) from sqlite_master")
            raise DamagedRow("its write-ahead log has changed")

    def _prepare(self, sync: str) -> None:
        # Before anything is read: then WAL needs no shared memory, and the lock is kept.
        self._db.execute("pragma locking_mode=exclusive")
        if self._is_empty():
            self._db.execute(f"pragma page_size={PAGE}")
            self._db.execute("pragma journal_mode=wal")
            self._create()
        else:
            self._check_header()
            self._db.execute("pragma journal_mode=wal")
        self._db.execute(f"pragma synchronous={sync}")
        self._db.execute(f"pragma fullfsync={int(sync == 'full')}")
        if self._pragma("quick_check") != "ok":
            raise DamagedRow("its pages do not fit together")
        prepare_mark(self._db)

    def _pragma(self, name: str) -> object:
        return self._db.execute(f"pragma {name}").fetchone()[0]

    def _is_empty(self) -> bool:
        count = self._db.execute("select count(*) from sqlite_master").fetchone()[0]
        return count == 0 and self._pragma("application_id") == 0

    def _create(self) -> None:
        self._db.execute("begin immediate")
        self._db.execute("create table log(n integer primary key, data blob not null)")
        self._db.execute(f"pragma application_id={APPLICATION}")
        self._db.execute(f"pragma user_version={VERSION}")
        self._db.execute("insert into log values (?, ?)", (1, next(KeptGoals().rows(1))))
        self._db.execute("commit")

    def _check_header(self) -> None:
        if self._pragma("application_id") != APPLICATION:
            raise self._error("it is a database of another program; use another file")
        version = self._pragma("user_version")
        if version != VERSION:
            raise self._error(
                f"it is of version {version}, and this release of fibaction knows version"
                f" {VERSION}; use the release that wrote it, or another file"
            )

    @property
    def next_number(self) -> int:
        """The number of the row that is added next."""
        return self._last + 1

    def add(self, row: bytes) -> None:
        """Add a row; it is durable when this returns."""
        with self._explained():
            self._bound_log()
            self._db.execute("insert into log values (?, ?)", (self._last + 1, row))
            self._last += 1
            self.size += len(row)
            self._logged += PAGE + len(row)
            self._check_path()

    def add_with(self, row: bytes, write: Callable[[sqlite3.Connection], int]) -> bool:
        """Add a row, and what a function writes to other tables, in one commit; it returns the
        bytes of that. Return whether there was room for both; else the row alone was added.
        """
        with self._explained():
            self._bound_log()

            def both(db: sqlite3.Connection) -> int:
                db.execute("insert into log values (?, ?)", (self._last + 1, row))
                return write(db)

            if not self._commit(both):
                self.add(row)
                return False
            self._last += 1
            self.size += len(row)
            self._logged += PAGE + len(row)
            self._check_path()
        return True

    def write(self, work: Callable[[sqlite3.Connection], int]) -> bool:
        """Let a function write to other tables, in one commit; it returns the bytes of that. Return
        whether there was room for it.
        """
        with self._explained():
            self._bound_log()
            return self._commit(work)

    def look(self, work: Callable[[sqlite3.Connection], FoundT]) -> FoundT:
        """Return what a function finds in other tables."""
        with self._explained():
            return work(self._db)

    def _commit(self, work: Callable[[sqlite3.Connection], int]) -> bool:
        """Commit what a function writes. Without room on the disk, nothing of it is written: the
        disk has lost nothing that it said it had, as after another error it may have.
        """
        try:
            self._db.execute("begin immediate")
            written = work(self._db)
            self._db.execute("commit")
        except BaseException as exc:
            if self._db.in_transaction:
                self._db.execute("rollback")
            if _code_of(exc) == sqlite3.SQLITE_FULL:
                return False
            raise
        self._logged += written
        return True

    def rows(self) -> Iterator[tuple[int, bytes]]:
        """Yield the number and the bytes of each row."""
        with self._explained():
            yield from self._db.execute("select n, data from log order by n")

    def goals(self) -> KeptGoals:
        """Return the goals that all rows add up to."""
        goals = KeptGoals()
        with self._explained():
            size = 0
            for number, row in self.rows():
                goals.read(number, row)
                size += len(row)
            if not size:
                raise DamagedRow("all rows are missing")
        return goals

    def replace(self, rows: Iterable[bytes]) -> None:
        """Write these rows instead of all that there are."""
        with self._explained():
            self._bound_log()
            last, size = self._last, 0
            self._db.execute("begin immediate")
            for number, row in enumerate(rows, last + 1):
                self._db.execute("insert into log values (?, ?)", (number, row))
                self._last = number
                size += len(row)
            self._db.execute("delete from log where n <= ?", (last,))
            self._db.execute("commit")
            self.size = self.first_size = size
            self._logged += size
            self._check_path()

    def _bound_log(self) -> None:
        """Begin the log again when it is large; before a write, so that none fails that is kept."""
        if self._logged > self._largest_log:
            self._logged = 0
            begin_log(self._db)

    def close(self) -> None:
        """Close the file, whatever state it is in."""
        with suppress(sqlite3.Error):
            self._db.close()

    def _check_path(self) -> None:
        """Check that what was written to is still there for the next start."""
        if _identity_of(self._path) != self._identity:
            raise self._error("the file was removed or replaced while it was in use")
        if _identity_of(self._path + "-wal") != self._log_identity:
            raise self._error(
                f"{excerpt(self._path)}-wal was removed or replaced while it was in use"
            )

    @contextmanager
    def _explained(self) -> Generator[None, None, None]:
        """Turn whatever goes wrong into a StoreError of one sentence."""
        try:
            yield
        except StoreError:
            raise
        except DamagedRow as exc:
            raise self._error(f"{WHAT_TO_DO[sqlite3.SQLITE_CORRUPT]} ({exc})") from exc
        except sqlite3.Error as exc:
            raise self._error(WHAT_TO_DO.get(_code_of(exc), str(exc))) from exc
        except Exception as exc:
            raise self._error(f"{type(exc).__name__}: {exc}") from exc

    def _error(self, reason: str) -> StoreError:
        return StoreError(f"{self._failing}: {excerpt(reason, 400)}")


def _code_of(error: BaseException) -> int:
    """Return the number of SQLite for an error; 0 if it has none."""
    code: int = getattr(error, "sqlite_errorcode", 0) & 0xFF
    return code


def _identity_of(path: str) -> tuple[int, int] | None:
    """Return the numbers by which the system knows a file; None if there is none of that name."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _check_place(path: str) -> None:
    """Check what SQLite would only call "unable to open database file".

    Raises:
        StoreError: There cannot be a file at the path.
    """
    folder = os.path.dirname(path)
    reason = ""
    if os.path.isdir(path):
        reason = "it is a folder; name a file in it"
    elif not os.path.isdir(folder):
        reason = f"there is no folder {excerpt(folder)}; make it first"
    elif os.path.exists(path) and not os.path.isfile(path):
        reason = "it is not a regular file; name another one"
    elif not os.access(folder, os.W_OK | os.X_OK):
        reason = "this process may not write to the folder; use another one, or allow it"
    elif os.path.exists(path) and not os.access(path, os.R_OK | os.W_OK):
        reason = "this process may not read and write the file; use another one, or allow it"
    if reason:
        raise StoreError(f"cannot keep goals in {excerpt(path)}: {reason}")


async def rerun(path: str, action: str, goal_id: GoalID) -> GoalID:
    """Add a goal to the file of a `SqliteStore` for one that was given up, and return its ID. The
    next server runs it from the checkpoint of the old one, of which only the outcome is kept.

    Raises:
        StoreError: The file is in use or cannot be used, or the goal was not given up.
    """
    return await to_thread.run_sync(_rerun, path, action, goal_id)


def _rerun(path: str, action: str, goal_id: GoalID) -> GoalID:
    failing = f"cannot run goals in {excerpt(path)} again"
    with closing(JournalFile(path, "full", failing=failing)) as file:
        new = add_again(file, file.goals(), action, goal_id)
        if new is None:
            raise StoreError(f"{failing}: goal {goal_id} was not given up")
    return new.goal_id


def add_again(
    file: JournalFile, goals: KeptGoals, action: str, goal_id: GoalID
) -> StoredGoal | None:
    """Add a goal to a file, which has these goals, for one that was given up, and return it; None
    if it was not.
    """
    old = goals.of(action).given_up(goal_id)
    if old is None:
        return None
    new, ended = old.as_new(time.time_ns()), copy(old)
    ended.drop_request()
    records = [WholeRecord(action, new), WholeRecord(action, ended)]
    file.add(encode_row(file.next_number, list(records)))
    return new
