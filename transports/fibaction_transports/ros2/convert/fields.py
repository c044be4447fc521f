"""The kinds of fields of ROS messages, without nested messages.

A kind that is bound to the type which the user's end expects is a `Part`. It converts values from a
payload to values for the fields of messages, and back. What makes bytes of messages may check
little or nothing, so all values are checked here.

A message has an integer for a `byte`, `bytes` for several of them, an `array.array` for several
numbers, and lists for everything else. Where the messages of a middleware's adapter have others,
it has subclasses of these kinds.
"""

from __future__ import annotations

import array
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, TypeAlias

import msgspec
from msgspec import Meta

from fibaction.interfaces.ros_types import PRIMITIVES, Byte, limited, string
from fibaction.interfaces.ros_types import array as array_of
from fibaction.types.ros_messages import LARGE_ARRAY, numpy, pack, unpack
from fibaction_transports.ros2.convert.schemas import ANYTHING, Option, UserSchema

Convert: TypeAlias = Callable[[Any], Any] | None
"""A conversion; None if the value is used as it is."""


class Unfit(ValueError):
    """A value that does not fit. `path` leads to it, relative to the place of the exception."""

    def __init__(self, text: str, path: str = "") -> None:
        super().__init__(text)
        self.path = path

    @classmethod
    def like(cls, exc: msgspec.MsgspecError) -> Unfit:
        """Convert an error of msgspec."""
        text, _, path = str(exc).partition(" - at `$")
        return cls(text, path.removesuffix("`"))

    def under(self, step: str) -> Unfit:
        """Return this error with a longer path: a step, `.field` or `[index]`, comes before it."""
        self.path = step + self.path
        return self

    def __str__(self) -> str:  # as msgspec writes it
        return f"{self.args[0]} - at `${self.path}`"


class Part:
    """One place in a message, with the type that the user's end expects there."""

    def __init__(self, decoded: Any, make: Convert = None, read: Convert = None) -> None:
        self.decoded = decoded
        """The type that is decoded from a payload."""
        self.make = make
        """Converts a decoded value to ROS's. Raises Unfit."""
        self.read = read
        """Converts a value of ROS to one that msgspec can encode."""

    def put(self, message: Any, name: str, value: Any) -> None:
        """Set a field of a message.

        Raises:
            Unfit: The value does not fit.
        """
        setattr(message, name, value if self.make is None else self.make(value))


class Kind(ABC):
    """One kind of field."""

    text: str
    """Its name in interface definitions."""
    noun: str
    """Its name in a sentence."""
    words: tuple[str, ...]
    """The kinds of schemas that match it: see `Option.word`."""
    default: Any
    """The type of the field in structs that are made from the ROS type."""

    def bind(self, wanted: UserSchema, path: str, problems: list[str]) -> Part:
        """Return the part for a schema; mismatches are added to `problems`."""
        tries: list[list[str]] = []
        for option in wanted.options:
            found: list[str] = []
            if option.word in (ANYTHING, *self.words):
                part = self.match(option, path, found)
                if not found:
                    return part
            else:
                found.append(f"{path}: the ROS type has {self.noun}, the action has {option}")
            tries.append(found)
        if len(tries) == 1:
            problems.extend(tries[0])
        else:
            several = ", ".join(str(option) for option in wanted.options)
            problems.append(
                f"{path}: the ROS type has {self.noun},"
                f" and the action has none that matches: {several}"
            )
        return Part(Any)

    @abstractmethod
    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        """Return the part for an option that is one of `words`, or ANYTHING."""


class Single(Kind):
    """A value that is used as it was decoded, after a check at most."""

    def __init__(self, text: str, word: str, decoded: Any, check: Convert = None) -> None:
        self.text = self.noun = text
        self.words = (word,)
        self.default = decoded
        self._part = Part(decoded, check)

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        return self._part


_BEYOND_FLOAT32 = 2.0**128 - 2.0**103  # from here on a float32 is infinite


def _float32(value: float) -> float:
    if _BEYOND_FLOAT32 <= abs(value) < float("inf"):
        raise Unfit("Expected `float` of 32 bits")
    return value


def text_kind(wide: bool, bound: int | None, check: Convert = None) -> Single:
    """Return the kind of a string; `bound` is its greatest length in characters."""
    name = "wstring" if wide else "string"
    if bound is not None:
        name += f"<={bound}"
    return Single(name, "string", string(bound), check)


class Octet(Kind):
    """A `byte`: an integer in a message; an integer or `bytes` for users."""

    text = noun = "byte"
    words = ("integer", "bytes")
    default = Byte
    decoded: ClassVar[Any] = default | Annotated[bytes, Meta(min_length=1, max_length=1)]

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        return Part(self.decoded, _number, _octet if option.word == "bytes" else None)


def _number(value: int | bytes) -> int:
    return value if isinstance(value, int) else value[0]


def _octet(number: int) -> bytes:
    return bytes((number,))


class Number(Single):
    """A number. A message has several of them in an `array.array`, or as a default in a list."""

    def __init__(self, text: str, code: str) -> None:
        """`text` is also numpy's name of the type, and `code` the type code of `array`."""
        self.code = code
        if self.is_float:
            check = _float32 if code == "f" else None
            super().__init__(text, "number", float, check)
        else:
            super().__init__(text, "integer", PRIMITIVES[text])

    @property
    def is_float(self) -> bool:
        """True if it is not an integer."""
        return self.code in "fd"

    @property
    def dtype(self) -> Any:
        """Numpy's type."""
        # By name, not by code: numpy has two types of 64 bits, of which ROS's C code takes one.
        return numpy().dtype(self.text)


SINGLES: dict[str, Kind] = {
    "bool": Single("bool", "boolean", bool),
    "byte": Octet(),
    "float32": Number("float32", "f"),
    "float64": Number("float64", "d"),
    "int8": Number("int8", "b"),
    "uint8": Number("uint8", "B"),
    "int16": Number("int16", "h"),
    "uint16": Number("uint16", "H"),
    "int32": Number("int32", "i"),
    "uint32": Number("uint32", "I"),
    "int64": Number("int64", "q"),
    "uint64": Number("uint64", "Q"),
}
"""The basic types, by their names in interface definitions."""

_LIST: Any = list  # its element types are known only at run time


class ArrayKind(Kind):
    """An array or a sequence of any kind."""

    words: tuple[str, ...] = ("array",)

    def __init__(self, element: Kind, size: int | None, bound: int | None) -> None:
        """`size` is the length of a fixed-size array, `bound` the greatest length of a sequence."""
        self.element = element
        self.size = size
        self.bound = bound
        length = size if bound is None else f"<={bound}"
        self.text = self.noun = f"{element.text}[{'' if length is None else length}]"
        self.default = array_of(element.default, size=size, bound=bound)

    def limited(self, collection: Any) -> Any:
        """Return a type of collections with the lengths that this field allows."""
        return limited(collection, size=self.size, bound=self.bound)

    def match(self, option: Option, path: str, problems: list[str]) -> Part:
        if self.size is not None and option.length not in (None, self.size):
            problems.append(
                f"{path}: the ROS type has {self.text}, the action has {option.length} elements"
            )
        elements = [self.element.bind(one, f"{path}[]", problems) for one in option.elements]
        return self.part(option, elements[0])

    def part(self, option: Option, element: Part) -> Part:
        """Return the part for a list of such elements, or for another kind of option."""
        make, read = element.make, element.read
        return Part(
            self.limited(_LIST[element.decoded]),
            None if make is None else lambda values: _each(make, values),
            None if read is None else lambda values: [read(value) for value in values],
        )


def _each(make: Callable[[Any], Any], values: list[Any]) -> list[Any]:
    made: list[Any] = []
    try:
        for value in values:
            made.append(make(value))  # noqa: PERF401 - its length tells which one does not fit
    except Unfit as exc:
        raise exc.under(f"[{len(made)}]") from None
    return made


class Octets(ArrayKind):
    """Several `byte`s: `bytes` in a message."""

    words = ("array", "bytes")

    def part(self, option: Option, element: Part) -> Part:
        listed = super().part(option, element)
        return Part(
            self.limited(bytes) | listed.decoded,
            _octets,
            (listed.read or list) if option.word == "array" else None,
        )


def _octets(values: list[int | bytes] | bytes) -> bytes:
    return values if isinstance(values, bytes) else bytes(map(_number, values))


class Numbers(ArrayKind):
    """Several numbers: an `array.array` in a message, or `bytes` for `uint8`.

    They are decoded late, because numpy can convert most of them at once.
    """

    def __init__(self, element: Number, size: int | None, bound: int | None) -> None:
        super().__init__(element, size, bound)
        self.number = element
        decoded = self.limited(_LIST[element.default])
        if element.code == "B":
            self.words = ("array", "bytes")
            decoded = self.default | decoded
        self._decode = msgspec.msgpack.Decoder(decoded).decode

    def part(self, option: Option, element: Part) -> Part:
        as_bytes = "bytes" in self.words and option.word != "array"
        return Part(msgspec.Raw, self.made, bytes if as_bytes else self._read)

    def _read(self, numbers: Any) -> Any:
        # A default of the field is in a list, which shows no memory.
        is_large = numbers.__class__ is not list and len(numbers) >= LARGE_ARRAY
        if is_large and numpy() is not None:
            # A program may have put an array of another type there, which ROS's classes allow.
            held = memoryview(numbers) if isinstance(numbers, bytes) else numbers
            return pack(numpy().asarray(held).astype(self.number.dtype, copy=False))
        to_list = getattr(numbers, "tolist", None)
        return list(numbers) if to_list is None else to_list()

    def made(self, packed: msgspec.Raw) -> Any:
        """Make what a message has of a payload.

        Raises:
            Unfit: It is not such an array, or a number does not fit.
        """
        numbers = self._converted_at_once(unpack(packed))
        return self._converted_singly(packed) if numbers is None else numbers

    def _converted_at_once(self, numbers: Any) -> Any:
        """Return the numbers for ROS; None if they must be checked one by one."""
        if numbers is None or not self._fits(numbers):
            return None
        with numpy().errstate(all="ignore"):
            converted = numbers.astype(self.number.dtype)
        if self.number.code == "f" and not numpy().isfinite(converted).all():
            return None
        made: array.array[Any] = array.array(self.number.code)
        made.frombytes(memoryview(converted).cast("B"))
        return made

    def _fits(self, numbers: Any) -> bool:
        count = len(numbers)
        if count != (count if self.size is None else self.size):
            return False
        if self.bound is not None and count > self.bound:
            return False
        if self.number.is_float:
            return True
        if numbers.dtype.kind == "f":
            return False
        limits = numpy().iinfo(self.number.dtype)
        return bool(limits.min <= int(numbers.min()) and int(numbers.max()) <= limits.max)

    def _converted_singly(self, packed: msgspec.Raw) -> Any:
        try:
            values = self._decode(packed)
        except msgspec.MsgspecError as exc:
            raise Unfit.like(exc) from None
        made = array.array(self.number.code, values)
        if self.number.code == "f" and any(map(math.isinf, made)):
            _each(_float32, values)
        return made


def array_kind(element: Kind, size: int | None, bound: int | None) -> ArrayKind:
    """Return the kind of an array or a sequence: see `ArrayKind`."""
    if isinstance(element, Number):
        return Numbers(element, size, bound)
    if isinstance(element, Octet):
        return Octets(element, size, bound)
    return ArrayKind(element, size, bound)
