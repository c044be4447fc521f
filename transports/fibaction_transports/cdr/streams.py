"""The bytes of a payload, read and written one value after another, with CDR's alignment.

A number of `n` bytes begins at a multiple of `n`, counted from the end of the header of 4 bytes.
Nothing is allocated for what a payload announces before the payload is long enough for it.
"""

from __future__ import annotations

import sys
from struct import Struct
from typing import Final

from fibaction.border.peer_text import excerpt
from fibaction.words.errors import ProtocolError


class CdrError(ProtocolError, ValueError):
    """A payload that cannot be read, or a value that cannot be written, as a message of ROS.

    The text names the type, the field and what is wrong there, for example
    "geometry_msgs/msg/Polygon.points[3].x: 4 bytes expected, 2 bytes left".
    """

    def __init__(self, problem: str, *, field: str = "", type_name: str = "") -> None:
        super().__init__(problem)
        self.problem = problem
        """The cause, without its place."""
        self.field = field
        """The path to the field, for example `points[3].x`; empty for the message as a whole."""
        self.type_name = type_name
        """The type of the whole message."""

    def __str__(self) -> str:
        place = f"{self.type_name}.{self.field}" if self.field else self.type_name
        return excerpt(f"{place}: {self.problem}" if place else self.problem)

    def put_under(self, step: str) -> None:
        """Put a step before the path: the name of a field, `[index]`, or nothing."""
        dot = "." if step and self.field and not self.field.startswith("[") else ""
        self.field = f"{step}{dot}{self.field}"


MAX_VALUES: Final = 1_000_000
"""The strings and nested messages in one payload, at most. Numbers are limited by its length."""

HEADER = b"\x00\x01\x00\x00"
"""The header of plain CDR, little-endian. The low two bits of its last byte count the padding."""
HEADER_BYTES: Final = 4

BIG_ENDIAN: Final = 0
LITTLE_ENDIAN: Final = 1
_PLAIN = (BIG_ENDIAN, LITTLE_ENDIAN)
_PADDING = 3
_COUNTS = (Struct(">I"), Struct("<I"))
_WORD = 4
NATIVE: Final = LITTLE_ENDIAN if sys.byteorder == "little" else BIG_ENDIAN
"""The order of bytes of this machine."""

pack_count = _COUNTS[LITTLE_ENDIAN].pack


def too_short(size: int, left: int, field: str = "") -> CdrError:
    """Return the error for a payload in which fewer bytes are left than are needed."""
    return CdrError(f"{size} bytes expected, {max(left, 0)} bytes left", field=field)


class CdrReader:
    """The rest of a payload."""

    __slots__ = ("at", "data", "end", "order", "room")

    def __init__(self, payload: bytes | bytearray | memoryview) -> None:
        """Read the header.

        Raises:
            CdrError: It is not that of plain CDR.
        """
        if len(payload) < HEADER_BYTES:
            raise CdrError(f"a payload of {len(payload)} bytes, which has no header of 4 bytes")
        kind = payload[0] << 8 | payload[1]
        if kind not in _PLAIN:
            raise CdrError(
                f"encapsulation 0x{kind:04x}; only plain CDR, 0x0000 and 0x0001, is read"
            )
        self.data = memoryview(payload)[HEADER_BYTES:]
        self.end = len(self.data) - (payload[3] & _PADDING)
        self.at = 0
        self.order = kind
        """0 for big-endian, 1 for little-endian."""
        self.room = MAX_VALUES
        """The strings and nested messages that may still come."""

    def take(self, size: int, alignment: int = 1) -> int:
        """Return where the next `size` bytes begin, and go behind them.

        Raises:
            CdrError: Fewer are left.
        """
        start = self.at + (-self.at % alignment)
        if start + size > self.end:
            raise too_short(size, self.end - start)
        self.at = start + size
        return start

    def count(self) -> int:
        """Read the number of elements, or of bytes, that follow.

        Raises:
            CdrError: The payload ends before.
        """
        start = self.at + (-self.at % _WORD)
        self.at = start + _WORD
        if self.at > self.end:
            raise too_short(_WORD, self.end - start)
        count: int = _COUNTS[self.order].unpack_from(self.data, start)[0]
        return count

    def reserve(self, values: int) -> None:
        """Take note of strings or nested messages that are read next.

        Raises:
            CdrError: The payload has too many.
        """
        self.room -= values
        if self.room < 0:
            raise CdrError(f"more than {MAX_VALUES:,} strings and nested messages in one payload")


class CdrWriter:
    """The beginning of a payload, in pieces: arrays are copied once, when the pieces are joined."""

    __slots__ = ("at", "pieces")

    def __init__(self) -> None:
        self.pieces: list[bytes | memoryview] = [HEADER]
        self.at = 0
        """The bytes that were written, without the header."""

    def put(self, piece: bytes | memoryview, alignment: int = 1) -> None:
        """Write a piece, which counts in bytes, at the next multiple of `alignment`."""
        gap = -self.at % alignment
        if gap:
            self.pieces.append(bytes(gap))
        self.pieces.append(piece)
        self.at += gap + len(piece)

    def payload(self) -> bytes:
        """Return the payload, padded to a multiple of 4 bytes as submessages of RTPS must be."""
        gap = -self.at % _WORD
        if gap:
            self.pieces[0] = HEADER[:-1] + bytes([gap])
            self.pieces.append(bytes(gap))
        return b"".join(self.pieces)
