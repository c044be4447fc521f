"""The write-ahead log of a store: the mark by which a missing one is noticed, and its damage.

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

The log that a killed process has left is looked at before SQLite reads it:

SQLite reads the log up to the first frame whose checksum is wrong. That is right after a kill, when
the last commit may be torn. But if a byte in the middle has changed, SQLite forgets all commits
from there on, and says nothing. Each commit is on the disk before the next one begins. So two
commits after such a frame cannot be torn ones: the log is damaged.

The format is at https://www.sqlite.org/fileformat2.html#the_write_ahead_log.
"""

from __future__ import annotations

import os
import sqlite3
import struct
import sys
from array import array
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import BinaryIO

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


PAGE = 4096
"""Bytes of a page."""
HEADER = 32
"""Bytes of the header of the log: its salts are at 16 to 24, its checksum at 24."""
FRAME = 24
"""Bytes of the header of a frame: the size of the database at 4, which is 0 except in the last
frame of a commit, then the salts of the log, and at 16 the checksum of all that is before."""
MASK = 0xFFFFFFFF

Sums = tuple[int, int]


def is_damaged(path: str) -> bool:
    """Return True if SQLite would forget commits that were complete."""
    try:
        with open(path, "rb") as file:
            return _lost_commits(file) > 1
    except FileNotFoundError:
        return False


def _lost_commits(file: BinaryIO) -> int:
    """Return the number of commits from the first frame on that SQLite does not read."""
    header = file.read(HEADER)
    if len(header) < HEADER:
        return 0
    words = "big" if header[3] & 1 else "little"
    sums = _summed(header[:24], (0, 0), words)
    is_valid = struct.pack(">II", *sums) == header[24:]
    salts = header[16:24] if is_valid else b""
    lost = 0
    for frame, page in _frames(file):
        salts = salts or frame[8:16]
        if is_valid:
            sums = _summed(page, _summed(frame[:8], sums, words), words)
            is_valid = frame[8:] == salts + struct.pack(">II", *sums)
        if not is_valid and frame[8:16] == salts and frame[4:8] != bytes(4):
            lost += 1
    return lost


def _frames(file: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    while len(data := file.read(FRAME + PAGE)) == FRAME + PAGE:
        yield data[:FRAME], data[FRAME:]


def _summed(data: bytes, sums: Sums, words: str) -> Sums:
    """Return SQLite's checksum of the data, which continues from earlier data."""
    numbers = array("I", data)
    if words != sys.byteorder:
        numbers.byteswap()
    first, second = sums
    pairs = iter(numbers)
    for one, two in zip(pairs, pairs, strict=True):
        first = (first + one + second) & MASK
        second = (second + two + first) & MASK
    return first, second
