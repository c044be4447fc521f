"""The steps for arrays of a fixed size and for sequences.

Arrays of numbers are copied as a whole, not number by number.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, cast

from fibaction_transports.cdr.steps import CdrStep
from fibaction_transports.cdr.streams import (
    LISTS,
    NATIVE,
    CdrError,
    CdrReader,
    CdrWriter,
    check_count,
    numbers_of,
    octets_of,
    pack_count,
    size_of,
    too_short,
)

_WORD = 4


class ArraySize(NamedTuple):
    """The number of elements that an array may have."""

    size: int | None = None
    """That of an array of a fixed size, which is not written; None for a sequence."""
    bound: int | None = None
    """The greatest number of elements of a sequence."""

    def read(self, reader: CdrReader, least: int) -> int:
        """Read the number of elements, of which each has at least `least` bytes.

        Raises:
            CdrError: It is not allowed, or the payload is too short for them.
        """
        if self.size is None:
            count = reader.count()
            if self.bound is not None:
                check_count(count, None, self.bound)
        else:
            count = self.size
        if count * least > reader.end - reader.at:
            raise too_short(count * least, reader.end - reader.at)
        return count

    def write(self, writer: CdrWriter, count: int) -> None:
        """Check and write the number of elements.

        Raises:
            CdrError: It is not allowed.
        """
        if self.size is not None or self.bound is not None:
            check_count(count, self.size, self.bound)
        if self.size is None:
            writer.put(pack_count(count), _WORD)


class OctetArray(CdrStep):
    """An array of `byte`, `char` or `uint8`, which is `bytes` in Python."""

    def __init__(self, name: str, size: ArraySize) -> None:
        self.name = name
        self.least = _WORD if size.size is None else size.size
        self._size = size

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        start = reader.take(self._size.read(reader, 1))
        into.append(bytes(reader.data[start : reader.at]))

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        octets = octets_of(values[index])
        self._size.write(writer, len(octets))
        writer.put(octets)


class NumberArray(CdrStep):
    """An array of numbers or of bools: a list, or if asked for an `array.array` of numbers."""

    def __init__(self, name: str, code: str, size: ArraySize, *, as_arrays: bool) -> None:
        self.name = name
        self._code = code
        # The types of a memoryview's `cast` know literals only, of which one stands for all here.
        self._format: Literal["i"] = cast(Literal["i"], code)
        self._itemsize = size_of(code)
        self.least = _WORD if size.size is None else size.size * self._itemsize
        self._size = size
        self._as_arrays = as_arrays

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        count = self._size.read(reader, self._itemsize)
        if not count:  # no gap before numbers that are not there
            into.append(array(self._code) if self._as_arrays and self._code != "?" else [])
            return
        start = reader.take(count * self._itemsize, self._itemsize)
        raw = reader.data[start : reader.at]
        if self._code == "?":
            _check_bools(raw)
        elif self._as_arrays or reader.order != NATIVE:
            numbers: array[Any] = array(self._code)
            numbers.frombytes(raw)
            if reader.order != NATIVE:
                numbers.byteswap()
            into.append(numbers if self._as_arrays else numbers.tolist())
            return
        into.append(raw.cast(self._format).tolist())

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        numbers = numbers_of(values[index], self._code)
        count = len(numbers) // self._itemsize
        self._size.write(writer, count)
        writer.put(numbers, self._itemsize if count else 1)


def _check_bools(raw: memoryview) -> None:
    others = bytes(raw).translate(None, b"\0\1")
    if others:
        raise CdrError(f"a bool is 0 or 1, not {others[0]}")


class ElementArray(CdrStep):
    """An array of strings or of messages: a list."""

    def __init__(self, name: str, element: CdrStep, size: ArraySize) -> None:
        self.name = name
        self.least = _WORD if size.size is None else size.size * element.least
        self._element = element
        self._size = size

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        element = self._element
        count = self._size.read(reader, element.least)
        reader.reserve(count * element.weight)
        items: list[Any] = []
        element.read_many(reader, count, items)
        into.append(items)

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        items = values[index]
        if not isinstance(items, LISTS):
            raise CdrError(f"a list expected, found {type(items).__name__}")
        self._size.write(writer, len(items))
        self._element.write_many(writer, items)
