"""`CdrCodec`: a message of ROS between bytes of CDR and the structs made from its definition.

A codec is compiled once for each type. Nested messages are taken apart, so that a message becomes
a flat row of values: numbers that follow each other are one step, whether they are in one message
or in several. Arrays of messages have a row of their own, which is used for each element.

Two libraries do the same, and neither is used. rosbags 0.11 has values of its own, with arrays of
numpy, which would be copied into our structs and checked. It runs Python that it writes at run
time, and needs numpy and five other packages, which take about 90 MB. ros2-pyterfaces 0.3 knows no
actions, and its codec compiles C at run time, 35 s for the first message. In microseconds, on two
busy cores:

| encode, decode | here | rosbags |
| --- | --- | --- |
| 10 numbers | 2.0, 2.6 | 1.7, 2.2 |
| PoseStamped | 3.5, 7.6 | 4.4, 5.6 |
| 1,000 Points | 155, 780 | 346, 796 |
| 1 MB of uint8 | 32, 49 | 46, 3 |
| a point cloud of 1 MB | 47, 68 | 70, 12 |

rosbags returns views of the payload, and here bytes are copied. A list of a million numbers takes
18 ms to encode, so a large grid should be an array, which takes as long as bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from inspect import signature
from itertools import starmap
from operator import attrgetter, itemgetter
from typing import Any, Final

from fibaction.interfaces.definitions import FieldDefinition, FieldType
from fibaction.interfaces.files import InterfaceMessage
from fibaction.interfaces.ros_types import attribute
from fibaction_transports.cdr.arrays import ArraySize, ElementArray, NumberArray, OctetArray
from fibaction_transports.cdr.steps import CODES, CdrStep, PrimitiveRun, RunItem, Text, WideText
from fibaction_transports.cdr.streams import LITTLE_ENDIAN, UNFIT, CdrError, CdrReader, CdrWriter

_OCTET = "B"
_TEXTS: Final = {"string": Text, "wstring": WideText}

_Build = Callable[[Sequence[Any]], Any]


class CdrCodec:
    """Encodes and decodes one type of messages."""

    def __init__(
        self,
        message: InterfaceMessage,
        structs: Mapping[str, Callable[..., Any]],
        *,
        as_arrays: bool = False,
    ) -> None:
        """Compile a type.

        `structs` has a struct for the message, and for each that it nests, by class name, as
        `make_structs` returns them. With `as_arrays`, arrays of numbers are decoded as
        `array.array`, which is faster than a list; octets are `bytes` in any case.
        """
        self.type_name = message.type_name or message.class_name
        self._layout = _Layouts(structs, as_arrays=as_arrays).of(message)

    def encode(self, value: Any) -> bytes:
        """Return a message as a payload: plain CDR, little-endian, padded to 4 bytes.

        Arrays of numbers may be lists, or anything that shows its memory, such as an `array.array`
        or an array of numpy with one dimension.

        Raises:
            CdrError: A value does not fit.
        """
        writer = CdrWriter()
        try:
            self._layout.write(writer, (value,), 0)
        except CdrError as exc:
            exc.type_name = self.type_name
            raise
        return writer.payload()

    def decode(self, payload: bytes | bytearray | memoryview) -> Any:
        """Return the message in a payload, which may be of either byte order.

        Bytes after the message are left alone, as ROS does: some senders pad by more than 3 bytes.

        Raises:
            CdrError: The payload is malformed.
        """
        found: list[Any] = []
        try:
            self._layout.read(CdrReader(payload), found)
        except CdrError as exc:
            exc.type_name = self.type_name
            raise
        return found[0]


class _Layout(CdrStep):
    """A message as a row of steps."""

    def __init__(self, row: _Row, build: _Build) -> None:
        self._steps = row.steps
        self.least = sum(step.least for step, _ in self._steps)
        self.weight = row.messages
        self._paths = row.paths
        self._values_of = _getter(row.paths)
        self._build = build
        first = self._steps[0][0]
        self._run = first if len(self._steps) == 1 and isinstance(first, PrimitiveRun) else None
        """The only step, if numbers are all that the message has."""

    def read(self, reader: CdrReader, into: list[Any]) -> None:
        values: list[Any] = []
        for step, _ in self._steps:
            try:
                step.read(reader, values)
            except CdrError as exc:
                exc.put_under(step.name)
                raise
        into.append(self._build(values))

    def write(self, writer: CdrWriter, values: Sequence[Any], index: int) -> None:
        try:
            row = self._values_of(values[index])
        except AttributeError as exc:
            raise CdrError(f"a message expected: {exc}") from exc
        for step, place in self._steps:
            try:
                step.write(writer, row, place)
            except CdrError as exc:
                exc.put_under(step.name)
                raise

    def read_many(self, reader: CdrReader, count: int, into: list[Any]) -> None:
        if self._run is not None and not self._run.bools and count > 1:
            self.read_many(reader, 1, into)  # the gaps in it may be others
            packed = self._run.layout(reader.order, reader.at)
            end = reader.at + (count - 1) * packed.size
            if end <= reader.end:
                into.extend(map(self._build, packed.iter_unpack(reader.data[reader.at : end])))
                reader.at = end
        super().read_many(reader, count, into)

    def write_many(self, writer: CdrWriter, values: Sequence[Any], start: int = 0) -> None:
        if self._run is not None and not self._run.checked and values:
            super().write_many(writer, values[:1])  # the gaps in it may be others
            start = 1
            packed = self._run.layout(LITTLE_ENDIAN, writer.at)
            with suppress(*UNFIT, AttributeError):  # found again below, with its place
                rows = map(self._values_of, values[1:])
                writer.put(b"".join(starmap(packed.pack, rows)))
                return
        super().write_many(writer, values, start)


def _getter(paths: Sequence[str]) -> Callable[[Any], Sequence[Any]]:
    """Return a function that returns the values at all paths of a message."""
    if not paths:
        return lambda message: ()
    get = attrgetter(*paths)
    return get if len(paths) > 1 else lambda message: (get(message),)


def _builder(cls: Callable[..., Any], makers: Mapping[str, _Build], leaves: slice) -> _Build:
    """Return a function that makes a struct of the values of a row.

    `makers` are by the names of attributes; `leaves` are the values if no message is nested.
    """
    taken = signature(cls).parameters
    if [*taken] != [*makers] or any(one.kind is one.KEYWORD_ONLY for one in taken.values()):
        return lambda values: cls(**{name: make(values) for name, make in makers.items()})
    if leaves.stop:
        return lambda values: cls(*values[leaves])
    in_order = [*makers.values()]
    return lambda values: cls(*[make(values) for make in in_order])


class _Row:
    """The values of a message and of all that it nests, in their order on the wire."""

    def __init__(self) -> None:
        self.paths: list[str] = []
        """The paths of attributes that lead to the values."""
        self.messages = 0
        self.steps: list[tuple[CdrStep, int]] = []
        """Each step, with the index of its first value."""
        self._run: list[RunItem] = []

    def add(self, part: CdrStep | RunItem, path: str) -> int:
        """Add a value, and return its index."""
        if isinstance(part, RunItem):
            self._run.append(part)
        else:
            self.end_run()
            self.steps.append((part, len(self.paths)))
        self.paths.append(path)
        return len(self.paths) - 1

    def add_dummy(self, name: str) -> None:
        """Add the octet that stands for a message without fields."""
        self._run.append(RunItem(name, "x"))

    def end_run(self) -> None:
        """Make a step of the primitives that were added last."""
        if self._run:
            run = PrimitiveRun(self._run)
            self.steps.append((run, len(self.paths) - run.values))
            self._run = []


class _Layouts:
    """The layouts of a message, and of messages that it has in arrays."""

    def __init__(self, structs: Mapping[str, Callable[..., Any]], *, as_arrays: bool) -> None:
        self._structs = structs
        self._as_arrays = as_arrays
        self._made: dict[str, _Layout] = {}

    def of(self, message: InterfaceMessage) -> _Layout:
        """Return the layout of a message."""
        if message.class_name not in self._made:
            row = _Row()
            build = self._add(row, message, (), ())
            row.end_run()
            self._made[message.class_name] = _Layout(row, build)
        return self._made[message.class_name]

    def _add(
        self, row: _Row, message: InterfaceMessage, names: tuple[str, ...], path: tuple[str, ...]
    ) -> _Build:
        """Add the fields of a message to a row, and return what makes its struct of the values."""
        cls = self._structs[message.class_name]
        row.messages += 1
        if not message.definition.fields:
            row.add_dummy(".".join(names))
            return lambda values: cls()
        makers: dict[str, _Build] = {}
        start, is_flat = len(row.paths), True
        for field in message.definition.fields:
            below = (*names, field.name), (*path, attribute(field.name))
            nested = message.nested.get(field.name)
            if nested is not None and not field.type.is_array:
                makers[attribute(field.name)] = self._add(row, nested, *below)
                is_flat = False
            else:
                step = self._part(field, ".".join(below[0]), nested)
                makers[attribute(field.name)] = itemgetter(row.add(step, ".".join(below[1])))
        return _builder(cls, makers, slice(start, start + len(makers) if is_flat else 0))

    def _part(
        self, field: FieldDefinition, name: str, nested: InterfaceMessage | None
    ) -> CdrStep | RunItem:
        kind = field.type
        code = CODES.get(kind.base, "")
        if not kind.is_array:
            return RunItem(name, code) if code else _text(kind, name)
        size = ArraySize(kind.size, kind.bound)
        if nested is not None:
            return ElementArray(name, self.of(nested), size)
        if not code:
            return ElementArray(name, _text(kind, ""), size)
        if code != _OCTET:
            return NumberArray(name, code, size, as_arrays=self._as_arrays)
        return OctetArray(name, size) if kind.size is None else RunItem(name, f"{kind.size}s")


def _text(kind: FieldType, name: str) -> CdrStep:
    return _TEXTS[kind.base](name, kind.characters)
