"""The steps in which a message is read and written: numbers, strings, and several of them.

A step reads values from a payload into a list, and writes values of a sequence into a payload.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from fibaction_transports.cdr.streams import (
    LITTLE_ENDIAN,
    UNFIT,
    CdrError,
    CdrReader,
    CdrWriter,
    octets_of,
    pack_count,
    too_short,
    unfit,
)

CODES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""The codes of `struct`, and but for bool of `array`, for the primitives of a fixed size."""

_ORDERS = (">", "<")
_WORD = 4
_PHASES = 8
_DUMMY = "x"
"""The code of the octet that stands for a message without fields."""


class CdrStep(ABC):
    """A part of a message: one field, or several that follow each other."""

    name = ""
    """The path to the field; empty if errors name it already."""
    values = 1
    """The number of values that it reads and writes."""
    least: int
    """The bytes that it has at least."""
    weight = 1
    """The strings and messages that count for it, if it is the element of an array."""

    @abstractmethod
    def read(self, reader: CdrReader, into: list[Any]) -> None:
        """Append the values to a list.

        Raises:
            CdrError: The payload is malformed.
        """

    @abstractmethod
    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        """Write the values that begin at an index.

        Raises:
            CdrError: A value does not fit.
        """

    def read_many(self, reader: CdrReader, count: int, into: list[Any]) -> None:
        """Append elements of an array to a list, until it has `count` of them.

        Raises:
            CdrError: The payload is malformed.
        """
        try:
            for _ in range(len(into), count):
                self.read(reader, into)
        except CdrError as exc:
            exc.put_under(f"[{len(into)}]")
            raise

    def write_many(self, writer: CdrWriter, values: Sequence[Any], start: int = 0) -> None:
        """Write the elements of an array, from an index on.

        Raises:
            CdrError: A value does not fit.
        """
        for index in range(start, len(values)):
            try:
                self.write(writer, values, index)
            except CdrError as exc:
                exc.put_under(f"[{index}]")
                raise


class RunItem(NamedTuple):
    """A primitive in a run: a number, a bool, or a fixed number of octets."""

    name: str
    code: str
    """That of `struct`, for example `i`, `?` or `16s`; `x` stands for no value."""

    @property
    def size(self) -> int:
        return struct.calcsize(f"<{self.code}")

    @property
    def alignment(self) -> int:
        return 1 if self.code[-1] in "sx" else self.size


class PrimitiveRun(CdrStep):
    """Primitives of a fixed size that follow each other, read and written by one call.

    Where the gaps are depends on where the run begins, modulo 8: there is one `Struct` for each.
    """

    def __init__(self, items: Sequence[RunItem]) -> None:
        self.items = items
        self.least = sum(item.size for item in items)
        with_value = [item for item in items if item.code != _DUMMY]
        self.values = len(with_value)
        self._names = [item.name for item in with_value]
        # The indexes of values that are checked: when they are read, and when they are written.
        self.bools = [index for index, item in enumerate(with_value) if item.code == "?"]
        self.checked: list[tuple[int, Callable[[Any], Any]]] = [
            (index, _check_of(item))
            for index, item in enumerate(with_value)
            if item.code[-1] in "?s"
        ]
        self._structs: list[list[struct.Struct | None]] = [[None] * _PHASES for _ in _ORDERS]

    def _places(self, at: int) -> Iterator[tuple[RunItem, int, int]]:
        """Yield each item with its start and its end, for a run that begins at `at`."""
        for item in self.items:
            start = at + -at % item.alignment
            at = start + item.size
            yield item, start, at

    def layout(self, order: int, at: int) -> struct.Struct:
        """Return the layout for a run that begins at `at`.

        It depends on `at` modulo 8. Where a run ends, modulo its greatest alignment, does not: so
        of several runs in a row, all but the first have the same layout.
        """
        phase = at % _PHASES
        found = self._structs[order][phase]
        if found is None:
            layout, after = _ORDERS[order], phase
            for item, start, end in self._places(phase):
                layout += "x" * (start - after) + item.code.replace("?", "B")
                after = end
            found = self._structs[order][phase] = struct.Struct(layout)
        return found

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        packed = self._structs[reader.order][reader.at % _PHASES]
        if packed is None:
            packed = self.layout(reader.order, reader.at)
        if reader.at + packed.size > reader.end:
            raise self._too_short(reader)
        into += packed.unpack_from(reader.data, reader.at)
        reader.at += packed.size
        for index in self.bools:
            place = len(into) - self.values + index
            if into[place] > 1:
                raise CdrError(f"a bool is 0 or 1, not {into[place]}", field=self._names[index])
            into[place] = into[place] == 1

    def _too_short(self, reader: CdrReader) -> CdrError:
        item, start = next(
            (item, start) for item, start, end in self._places(reader.at) if end > reader.end
        )
        return too_short(item.size, reader.end - start, item.name)

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        values = values[index : index + self.values]
        if self.checked:
            values = list(values)
            for place, checked in self.checked:
                try:
                    values[place] = checked(values[place])
                except CdrError as exc:
                    exc.put_under(self._names[place])
                    raise
        packed = self._structs[LITTLE_ENDIAN][writer.at % _PHASES]
        if packed is None:
            packed = self.layout(LITTLE_ENDIAN, writer.at)
        try:
            piece = packed.pack(*values)
        except UNFIT as exc:
            codes = [item.code for item in self.items if item.code != _DUMMY]
            raise unfit(zip(self._names, codes, values, strict=True)) from exc
        writer.pieces.append(piece)
        writer.at += packed.size


def _check_of(item: RunItem) -> Callable[[Any], Any]:
    if item.code == "?":
        return checked_bool
    size = item.size

    def checked_octets(value: Any) -> bytes:
        if type(value) is bytes and len(value) == size:
            return value
        return bytes(octets_of(value, size=size))

    return checked_octets


def checked_bool(value: Any) -> bool:
    """Return the value if it is a bool.

    Raises:
        CdrError: It is not.
    """
    if value is True or value is False:
        return value
    raise CdrError(f"a bool expected, found {value!r}")


class Text(CdrStep):
    """A `string`: UTF-8, with a NUL at the end that counts."""

    least = _WORD

    def __init__(self, name: str = "", bound: int | None = None) -> None:
        """`bound` is the greatest length in characters."""
        self.name = name
        self._bound = bound

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        length = reader.count()
        if not length:  # some peers write an empty string without its NUL
            into.append("")
            return
        start = reader.take(length)
        end = start + length - 1
        if reader.data[end]:
            raise CdrError("a string without a NUL at its end")
        try:
            text = str(reader.data[start:end], "utf-8")
        except UnicodeDecodeError as exc:
            raise CdrError(f"a string that is not UTF-8: {exc.reason} at byte {exc.start}") from exc
        check_length(text, self._bound)
        into.append(text)

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        text = checked_text(values[index], self._bound)
        try:
            encoded = text.encode()
        except UnicodeEncodeError as exc:
            raise CdrError(f"a string that UTF-8 cannot hold: {exc.reason}") from exc
        if b"\0" in encoded:
            raise CdrError("a string with a NUL in it, where readers of ROS would cut it off")
        writer.put(pack_count(len(encoded) + 1) + encoded + b"\0", _WORD)


class WideText(CdrStep):
    """A `wstring`: the number of units of UTF-16, and each unit in 4 bytes."""

    least = _WORD

    def __init__(self, name: str = "", bound: int | None = None) -> None:
        """`bound` is the greatest length in characters."""
        self.name = name
        self._bound = bound

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        length = reader.count()
        start = reader.take(_WORD * length)
        order = ("be", "le")[reader.order]
        units = bytes(reader.data[start : reader.at])
        try:
            # The units of a surrogate pair become one character, as in UTF-16.
            wide = units.decode(f"utf-32-{order}", "surrogatepass")
            text = wide.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
        except UnicodeError as exc:
            raise CdrError("a wide string that is not UTF-16") from exc
        check_length(text, self._bound)
        into.append(text)

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        text = checked_text(values[index], self._bound)
        try:
            units = text.encode("utf-16-le")
        except UnicodeEncodeError as exc:
            raise CdrError(f"a string that UTF-16 cannot hold: {exc.reason}") from exc
        packed = bytearray(2 * len(units))
        packed[0::_WORD], packed[1::_WORD] = units[0::2], units[1::2]
        writer.put(pack_count(len(units) // 2) + packed, _WORD)


def checked_text(value: Any, bound: int | None) -> str:
    """Return the value if it is a string of at most `bound` characters.

    Raises:
        CdrError: It is not.
    """
    if not isinstance(value, str):
        raise CdrError(f"a str expected, found {value!r}")
    check_length(value, bound)
    return value


def check_length(text: str, bound: int | None) -> None:
    """Check that a string is not longer than its type allows.

    Raises:
        CdrError: It is.
    """
    if bound is not None and len(text) > bound:
        raise CdrError(f"a string of {len(text)} characters, of at most {bound}")
