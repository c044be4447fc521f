"""Values for arrays of numbers: the accepted forms, and the bytes of each.

Numbers may be in a list, or in an object that shows its memory, such as an `array.array` or an
array of numpy. The latter are copied as they are, if their type is the one of the field.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Collection, Iterable, Sequence
from itertools import starmap
from typing import Any, TypeGuard

from fibaction.border.peer_text import excerpt
from fibaction_transports.cdr.streams import CdrError

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
