"""`CdrCodec`: a message of ROS between bytes of CDR and the structs made from its definition.

A codec is compiled once for each type. Nested messages are taken apart, so that a message becomes
a flat row of values: numbers that follow each other are one step, whether they are in one message
or in several. Arrays of messages have a row of their own, which is used for each element.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import Any, Final

from fibaction.interfaces.definitions import FieldDefinition, FieldType
from fibaction.interfaces.files import InterfaceMessage
from fibaction.interfaces.ros_types import attribute
from fibaction_transports.cdr.arrays import ArraySize, ElementArray, NumberArray, OctetArray
from fibaction_transports.cdr.cdr_error import CdrError
from fibaction_transports.cdr.steps import CODES, CdrStep, PrimitiveRun, RunItem, Text, WideText
from fibaction_transports.cdr.streams import CdrReader, CdrWriter

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


def _getter(paths: Sequence[str]) -> Callable[[Any], Sequence[Any]]:
    """Return a function that returns the values at all paths of a message."""
    if not paths:
        return lambda message: ()
    get = attrgetter(*paths)
    return get if len(paths) > 1 else lambda message: (get(message),)


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
        parts: list[tuple[str, _Build]] = []
        for field in message.definition.fields:
            below = (*names, field.name), (*path, attribute(field.name))
            nested = message.nested.get(field.name)
            if nested is not None and not field.type.is_array:
                part = self._add(row, nested, *below)
            else:
                step = self._part(field, ".".join(below[0]), nested)
                part = itemgetter(row.add(step, ".".join(below[1])))
            parts.append((attribute(field.name), part))
        return lambda values: cls(**{name: part(values) for name, part in parts})

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
