"""A look at the write-ahead log that a killed process has left, before SQLite reads it.

SQLite reads the log up to the first frame whose checksum is wrong. That is right after a kill, when
the last commit may be torn. But if a byte in the middle has changed, SQLite forgets all commits
from there on, and says nothing. Each commit is on the disk before the next one begins. So two
commits after such a frame cannot be torn ones: the log is damaged.

The format is at https://www.sqlite.org/fileformat2.html#the_write_ahead_log.
"""

from __future__ import annotations

import struct
import sys
from array import array
from collections.abc import Iterator
from typing import BinaryIO

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
