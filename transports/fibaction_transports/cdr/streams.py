"""The bytes of a payload, read and written one value after another with CDR's alignment, and those
of arrays of numbers.

A number of `n` bytes begins at a multiple of `n`, counted from the end of the header of 4 bytes.
Nothing is allocated for what a payload announces before the payload is long enough for it.

Numbers to write may be in a list, or in an object that shows its memory, such as an `array.array`
or an array of numpy. The latter are copied as they are, if their type is the one of the field.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Collection, Iterable, Sequence
from itertools import starmap
from struct import Struct
from typing import Any, Final, TypeGuard

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


LISTS: Any = (list, tuple)
"""The types of lists that are taken as they are. `Any`, since a check by them tells nothing of the
items."""

UNFIT = (struct.error, OverflowError, TypeError)
"""The errors of `struct` for a value that it cannot pack."""

_FORMATS = {code: kind for kind in ("bhilq", "BHILQ", "fd", "?") for code in kind}
"""The kind of number of a code of `array`; with its size, it tells the type."""


def octets_of(
    value: Any, *, size: int | None = None, bound: int | None = None
) -> bytes | memoryview:
    """Return the values of an array of `byte`, `char` or `uint8`.

    Raises:
        CdrError: They are not octets, or their number is not allowed.
    """
    octets = value if isinstance(value, bytes) else numbers_of(value, "B")
    if size is not None or bound is not None:
        check_count(len(octets), size, bound)
    return octets


def numbers_of(value: Any, code: str) -> bytes | memoryview:
    """Return numbers as bytes, little-endian. `code` is their type, a code of `struct`.

    Raises:
        CdrError: They are not numbers of this type.
    """
    if not isinstance(value, LISTS):
        shown = _memory_of(value, code)
        if shown is not None:
            return shown
        if not _is_collection(value):
            raise CdrError(f"a list of numbers expected, found {type(value).__name__}")
        value = list(value)  # such as an array of another type of numbers
    if code == "?":
        return _bools(value)
    try:
        return struct.pack(f"<{len(value)}{code}", *value)
    except UNFIT as exc:
        raise unfit((f"[{index}]", code, number) for index, number in enumerate(value)) from exc


def unfit(values: Iterable[tuple[str, str, Any]]) -> CdrError:
    """Return the error for the first of several values that `struct` cannot pack.

    Each comes with its field and its code.
    """
    return next(error for error in starmap(_misfit, values) if error)


def _misfit(field: str, code: str, value: Any) -> CdrError | None:
    try:
        struct.pack(f"<{code}", value)
    except UNFIT as exc:
        return CdrError(f"{excerpt(repr(value))} does not fit: {exc}", field=field)
    return None


def _is_collection(value: Any) -> TypeGuard[Collection[Any]]:
    return isinstance(value, Collection) and not isinstance(value, (str, bytes, bytearray))


def _memory_of(value: Any, code: str) -> memoryview | None:
    """Return the memory of an object with numbers of this type, little-endian; None if there is
    none.

    Raises:
        CdrError: It has more than one dimension.
    """
    try:
        shown = memoryview(value)
    except (TypeError, ValueError, BufferError):
        return None
    if shown.ndim != 1:
        raise CdrError(f"one dimension expected, found {shown.ndim}: flatten the array")
    has_kind = _FORMATS.get(shown.format) == _FORMATS[code]
    if not has_kind or shown.itemsize != size_of(code):
        return None
    if not shown:  # an empty view cannot be cast
        return memoryview(b"")
    if shown.c_contiguous and (sys.byteorder == "little" or shown.itemsize == 1):
        return shown.cast("B")
    return None


def size_of(code: str) -> int:
    """Return the bytes of a number, or a bool."""
    return struct.calcsize(f"<{code}")


def _bools(values: Sequence[Any]) -> bytes:
    for index, value in enumerate(values):
        if value is not True and value is not False:
            raise CdrError(f"a bool expected, found {value!r}", field=f"[{index}]")
    return bytes(values)


def check_count(count: int, size: int | None, bound: int | None) -> None:
    """Check the number of elements of an array of a fixed size, or of a bounded sequence.

    Raises:
        CdrError: It is not allowed.
    """
    if size is not None and count != size:
        raise CdrError(f"{size} elements expected, found {count}")
    if bound is not None and count > bound:
        raise CdrError(f"{count} elements, of at most {bound}")
