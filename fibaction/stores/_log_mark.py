"""The mark in a journal's file by which a missing write-ahead log is noticed.

Theory of operation
-------------------

SQLite keeps commits in a log next to the file, and copies them to the file from time to time. If
the log of a killed process is removed, SQLite finds an older state in the file, and says nothing.
The file itself must tell that it needs its log.

`needs_log` is 1 in the file, and the first commit of the log makes it 0:

1. The mark becomes 1, and everything is copied to the file. Now the log can begin again.
2. The mark becomes 0. This is the first commit in the log, before any that a client is told of.

So the file alone says 1. The file with its log says 0, and a reader of both leaves 0 in the file: a
process that closes it, another program that opens it after a kill, and copies the log to the file,
and a release of fibaction that does not know the mark. For the same reason SQLite must not copy the
log to the file while it is in use (`wal_autocheckpoint`), or the file would have 0, and later
commits only in the log.

A kill between both steps leaves a log without anything new. Then only another program that copies
the log to the file, before the next start, would leave 1 in a file that is whole.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

LOG_IS_MISSING = (
    "the file next to it that ends in -wal is missing, and with it the newest goals; put it back,"
    " restore both files from a copy, or make it an empty file to continue without those goals"
)


def lacks_log(path: str) -> bool:
    """Return whether a file that is not in use needs its log, and there is none."""
    if os.path.exists(f"{path}-wal") or not os.path.exists(path):
        return False
    # Immutable, so that SQLite reads the file alone, and makes no log.
    uri = f"{Path(path).as_uri()}?mode=ro&immutable=1"
    with suppress(sqlite3.Error), closing(sqlite3.connect(uri, uri=True)) as db:
        return bool(db.execute("select needs_log from mark").fetchone() == (1,))
    return False  # there is no mark in it; or it is not a store, which is told when it is opened


def begin_log(db: sqlite3.Connection) -> None:
    """Copy the log to the file, and begin it again."""
    db.execute("insert or replace into mark(rowid, needs_log) values (1, 1)")
    db.execute("pragma wal_checkpoint(restart)")
    db.execute("update mark set needs_log = 0")


def prepare_mark(db: sqlite3.Connection) -> None:
    """Begin the log of a file that was opened now; files of older releases have no mark."""
    db.execute("pragma wal_autocheckpoint=0")
    db.execute("create table if not exists mark(needs_log integer not null)")
    begin_log(db)
