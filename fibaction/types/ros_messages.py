"""ROS messages as values of actions and within them, with their arrays of numbers.

A value is first given to msgspec, which knows nothing of ROS and costs nothing more. If it meets
something that it does not know, the value comes here: messages in it are replaced by plain data in
the form of the type that is declared there. The declared types are known from the fields of
classes, so a message of another type is found before anything is sent.

Arrays of `array` and of numpy become msgpack; large ones make no Python object for each number.
Arrays that do not fit here are left to msgspec, and without numpy, all of them. Numpy is imported
by the first large array.
"""

from __future__ import annotations

import array
import copy
from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, cast

import msgspec
from msgspec import inspect

from fibaction._runtime.text import excerpt
from fibaction.types.base import Encoding
from fibaction.types.ros_classes import is_message, is_message_class, message_class, ros_type_of
from fibaction.types.schemas import path_of, path_schema, plain_path, schema_of
from fibaction.words.errors import ProtocolError
from fibaction.words.plain_data import is_list, is_map

_REMEMBERED = 256
"""Pairs of a declared type and a class of ROS that are kept, and classes whose fields are."""
_ANY = inspect.AnyType()
_REFERENCE = b"#/$defs/"


class RosEncoding(Encoding):
    """A class of ROS itself."""

    def __init__(self, kind: Any) -> None:
        """Describe the class.

        Raises:
            TypeError: ROS itself cannot handle one of its fields in Python.
        """
        made = message_class(kind)
        self._kind = kind
        self._struct = made.struct
        self._read = made.reader({})
        self.classes = (kind,)
        self.encode = self._encode
        self.decode = made.decode

    def schema(self) -> dict[str, Any]:
        return schema_of(self._struct)

    def _encode(self, message: Any) -> bytes:
        if not isinstance(message, self._kind):
            raise _other_type(ros_type_of(self._kind), message)
        return encode(self._read(message))


def plain(value: Any) -> Any:
    """Return a value that msgspec does not know as one that it does.

    Raises:
        TypeError: It is neither a ROS message nor of a library of arrays, and not a path.
    """
    if is_message(value):
        return reader_of(value, Any)(value)
    if isinstance(value, array.array) or hasattr(value, "dtype"):
        return plain_array(value)
    return plain_path(value)


encode = msgspec.msgpack.Encoder(enc_hook=plain).encode
"""Turns a value with ROS messages and arrays in it into bytes."""


def plain_value(value: Any) -> Any:
    """Return a value with ROS messages in it as plain data."""
    return msgspec.msgpack.decode(encode(value))


def encoded(value: Any, declared: Any, ros_type: str, encoding: Encoding) -> bytes | None:
    """Encode a value that its encoding cannot encode; None if it is not one for here.

    Raises:
        TypeError: It has an object in it that cannot be sent, or a ROS message of another type.
    """
    if is_message(value):
        return encode(reader_of(value, declared, ros_type, encoding=encoding)(value))
    if not encoding.may_hold_messages:
        return None
    return encode(_replaced(value, inspect.type_info(declared), "$"))


def decoder(kind: Any) -> Callable[[bytes], Any]:
    """Return what decodes a type that has classes of ROS in its fields."""
    return msgspec.msgpack.Decoder(kind, dec_hook=_made).decode


def _made(kind: Any, data: Any) -> Any:
    """Make a message of plain data.

    Raises:
        ValueError: The data are not such a message; msgspec adds where they are.
    """
    if not is_message_class(kind):
        return path_of(kind, data)
    try:
        return message_class(kind).decode(encode(data))
    except ProtocolError as exc:
        raise ValueError(str(exc).replace(" - at `$", " in `")) from None


def schema(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a type that has classes of ROS in its fields.

    Raises:
        TypeError: There is none for it.
    """
    definitions: dict[str, Any] = {}
    made = schema_of(kind, partial(_described, definitions))
    return {**made, "$defs": {**made.get("$defs", {}), **definitions}}


def _described(definitions: dict[str, Any], kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a class of ROS.

    What it refers to is put into `definitions`, under names that no other type has.
    """
    if not is_message_class(kind):
        return path_schema(kind)
    text = msgspec.json.encode(schema_of(message_class(kind).struct))
    prefix = ros_type_of(kind).replace("/", ".") + "."
    made: dict[str, Any] = msgspec.json.decode(
        text.replace(_REFERENCE, _REFERENCE + prefix.encode())
    )
    definitions.update({f"{prefix}{name}": one for name, one in made.pop("$defs").items()})
    return made


def reader_of(
    message: object,
    declared: Any,
    ros_type: str = "",
    path: str = "",
    encoding: Encoding | None = None,
) -> Callable[[Any], Any]:
    """Return what makes plain data of a message for a place with this declared type.

    `ros_type` is the ROS 2 type of what is declared, if the type itself does not say it, and
    `encoding` that of the type; None if it is the type of a field.

    Raises:
        TypeError: The message is of another type.
    """
    expected = ros_type or ros_type_of(declared)
    if expected and expected != ros_type_of(type(message)):
        raise _other_type(expected, message, path)
    try:
        return _reader(cast("Any", type(message)), declared, encoding)
    except TypeError as exc:
        name = declared.__qualname__ if isinstance(declared, type) else excerpt(str(declared))
        raise TypeError(f"{_other_type(name, message, path)}: {exc}") from None


def _other_type(expected: str, value: object, path: str = "") -> TypeError:
    got = ros_type_of(type(value)) or type(value).__qualname__
    where = f" - at `{path}`" if path else ""
    return TypeError(f"Expected `{expected}`, got `{got}`{where}")


@lru_cache(_REMEMBERED)
def _reader(kind: Any, declared: Any, encoding: Encoding | None) -> Callable[[Any], Any]:
    if declared is Any:
        return message_class(kind).reader({})
    return message_class(kind).reader(schema(declared) if encoding is None else encoding.schema())


def _replaced(value: Any, info: inspect.Type, path: str) -> Any:
    """Return a value with the ROS messages in it replaced by plain data; the same one if it has
    none. `info` is the type that is declared at its place, and `path` leads there.
    """
    if is_message(value):
        return reader_of(value, _declared(value, info), path=path)(value)
    if is_map(value):
        new = {key: _replaced(one, _item(info, key), f"{path}.{key}") for key, one in value.items()}
        return new if any(new[key] is not one for key, one in value.items()) else value
    if is_list(value) or isinstance(value, tuple):
        listed = cast("list[Any]", value)
        items = [_replaced(one, _item(info), f"{path}[{at}]") for at, one in enumerate(listed)]
        is_same = all(new is old for new, old in zip(items, listed, strict=True))
        return listed if is_same else items
    return _with_fields_replaced(value, path)


def _with_fields_replaced(value: object, path: str) -> Any:
    changed: dict[str, Any] = {}
    for name, kind in _fields(cast("Any", type(value))).items():
        old = getattr(value, name, None)
        new = _replaced(old, kind, f"{path}.{name}")
        if new is not old:
            changed[name] = new
    if not changed:
        return value
    made = copy.copy(value)
    is_struct = isinstance(made, msgspec.Struct)
    put: Any = msgspec.structs.force_setattr if is_struct else object.__setattr__
    for name, new in changed.items():
        put(made, name, new)
    return made


@lru_cache(_REMEMBERED)
def _fields(kind: type[Any]) -> Mapping[str, inspect.Type]:
    """Return the types of the fields of a class; of one without fields, nothing."""
    if not any(hasattr(kind, name) for name in _MARKS_OF_FIELDS):
        return {}
    fields: tuple[inspect.Field, ...] = getattr(inspect.type_info(kind), "fields", ())
    return {field.name: field.type for field in fields}


_MARKS_OF_FIELDS = ("__struct_fields__", "__dataclass_fields__", "__attrs_attrs__")


def _options(info: inspect.Type) -> list[inspect.Type]:
    """Return the types that a declared type allows."""
    if isinstance(info, inspect.Metadata):
        return _options(info.type)
    if isinstance(info, inspect.UnionType):
        return [option for one in info.types for option in _options(one)]
    return [info]


def _item(info: inspect.Type, key: str = "") -> inspect.Type:
    """Return the type of the items of a list or a dict; of a `TypedDict`, that of one key."""
    for option in _options(info):
        for field in getattr(option, "fields", ()):
            if field.encode_name == key:
                return cast("inspect.Type", field.type)
        found = getattr(option, "item_type", getattr(option, "value_type", None))
        if found is not None:
            return cast("inspect.Type", found)
    return _ANY


def _declared(message: object, info: inspect.Type) -> Any:
    """Return the class that is declared at the place of a message; of several, that of its type."""
    classes = [kind for one in _options(info) if (kind := getattr(one, "cls", None)) is not None]
    name = ros_type_of(type(message))
    same = [kind for kind in classes if ros_type_of(kind) == name]
    return (same or classes or [Any])[0]


LARGE_ARRAY = 256
"""Numbers of an array from which on it is packed here. With fewer, msgspec is as fast."""

# In msgpack, a number is a byte for its type, and then the number itself, big-endian. Integers from
# -32 to 127 are one byte in all (github.com/msgpack/msgpack/blob/master/spec.md).
_TYPES = {
    0xCA: ">f4",
    0xCB: ">f8",
    0xCC: "u1",
    0xCD: ">u2",
    0xCE: ">u4",
    0xCF: ">u8",
    0xD0: "i1",
    0xD1: ">i2",
    0xD2: ">i4",
    0xD3: ">i8",
}
_INLINE = "i1"
_LEAST_INLINE, _MOST_INLINE = -32, 127
_FLOATS = {4: 0xCA, 8: 0xCB}
_INTEGERS = (0xD0, 0xCC, 0xD1, 0xCD, 0xD2, 0xCE, 0xD3, 0xCF)

_OCTETS = ("B", "u1")
_PACKED = (*"bhHiIlLqQfd", "i1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
"""The types of `array`, and those of numpy in either byte order, that can be packed."""

_ARRAY_16, _ARRAY_32 = 0xDC, 0xDD
_HEAD = 5  # the length of the head of a large array: its type, and the count


@cache
def numpy() -> Any:
    """Return numpy; None if it is not installed.

    It is imported for the first large array, since that takes longer than to import all else here.
    """
    return import_module("numpy") if find_spec("numpy") else None


@cache
def _cells(tag: int) -> Any:
    """Return the type of a number after its tag; None if there is no such tag."""
    kind = _TYPES.get(tag)
    return None if kind is None else numpy().dtype([("tag", "u1"), ("number", kind)])


def pack(numbers: Any) -> msgspec.Raw:
    """Return a numpy array with at least one number as msgpack. Floats keep their width."""
    count: int = len(numbers)
    tag = _tag_for(numbers)
    cells = numpy().dtype(_INLINE) if tag is None else _cells(tag)
    packed = bytearray(_HEAD + count * cells.itemsize)
    packed[:_HEAD] = bytes([_ARRAY_32]) + count.to_bytes(4, "big")
    body = numpy().frombuffer(packed, cells, offset=_HEAD)
    if tag is None:
        body[:] = numbers
    else:
        body["tag"] = tag
        body["number"] = numbers
    return msgspec.Raw(packed)


def _tag_for(numbers: Any) -> int | None:
    """Return the narrowest type for all the numbers; None if each is one byte."""
    if numbers.dtype.kind == "f":
        return _FLOATS[numbers.dtype.itemsize]
    least, most = int(numbers.min()), int(numbers.max())
    if least >= _LEAST_INLINE and most <= _MOST_INLINE:
        return None
    limits = ((tag, numpy().iinfo(_TYPES[tag])) for tag in _INTEGERS)
    return next(tag for tag, one in limits if one.min <= least and most <= one.max)


def plain_array(numbers: Any) -> Any:
    """Return an array of `array` or of numpy, or a number of numpy, as msgspec can encode it.

    One dimension of numbers of 8 bits without a sign is bytes, as in ROS's messages.
    """
    code, dimensions = getattr(numbers, "typecode", ""), getattr(numbers, "ndim", 1)
    kind = code or numbers.dtype.str[1:]
    if dimensions == 1 and kind in _OCTETS:
        view = memoryview(numbers)
        return view if view.c_contiguous else view.tobytes()
    if dimensions == 1 and kind in _PACKED and len(numbers) >= LARGE_ARRAY and numpy() is not None:
        return pack(numpy().asarray(numbers))
    if kind.startswith("f") and kind not in _PACKED:  # of 16 bits, or more than 64
        numbers = numbers.astype("f8")
    return numbers.tolist()


def unpack(packed: msgspec.Raw) -> Any:
    """Return the numbers of a large array in msgpack; None if they are not all of one type, or
    without numpy.
    """
    view = memoryview(packed)
    if view[0] == _ARRAY_16:
        count, body = int.from_bytes(view[1:3], "big"), view[3:]
    elif view[0] == _ARRAY_32:
        count, body = int.from_bytes(view[1:5], "big"), view[5:]
    else:
        return None
    if count < LARGE_ARRAY or numpy() is None:
        return None
    if len(body) == count:
        numbers = numpy().frombuffer(body, _INLINE)
        return numbers if (numbers >= _LEAST_INLINE).all() else None
    cells = _cells(body[0])
    # The length is not enough: several short numbers and a long one may add up to it, too.
    if cells is None or len(body) != count * cells.itemsize:
        return None
    found = numpy().frombuffer(body, cells)
    return found["number"] if (found["tag"] == body[0]).all() else None
