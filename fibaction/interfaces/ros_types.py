"""The types of fields of ROS 2 messages, as types of msgspec with ROS's limits.

Both sources of structs use them: interface files and ROS's own classes. Needs no ROS.
"""

from __future__ import annotations

import keyword
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, Any, TypeAlias

import msgspec
from msgspec import Meta

Int8: TypeAlias = Annotated[int, Meta(ge=-(2**7), le=2**7 - 1)]
Int16: TypeAlias = Annotated[int, Meta(ge=-(2**15), le=2**15 - 1)]
Int32: TypeAlias = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
Int64: TypeAlias = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
UInt8: TypeAlias = Annotated[int, Meta(ge=0, le=2**8 - 1)]
UInt16: TypeAlias = Annotated[int, Meta(ge=0, le=2**16 - 1)]
UInt32: TypeAlias = Annotated[int, Meta(ge=0, le=2**32 - 1)]
# msgspec has no limits above an int64, and msgpack no integers above a uint64.
UInt64: TypeAlias = Annotated[int, Meta(ge=0)]
Byte: TypeAlias = UInt8
Char: TypeAlias = UInt8

PRIMITIVES: dict[str, Any] = {
    "bool": bool,
    "byte": Byte,
    "char": Char,
    "float32": float,
    "float64": float,
    "int8": Int8,
    "uint8": UInt8,
    "int16": Int16,
    "uint16": UInt16,
    "int32": Int32,
    "uint32": UInt32,
    "int64": Int64,
    "uint64": UInt64,
    "string": str,
    "wstring": str,
}
"""The types of single values, by their names in interface files."""

_LIST: Any = list  # type checkers reject arguments that are known at run time only

_SHOWN = "fibaction.ros_types"

_encode = msgspec.msgpack.Encoder().encode


def string(bound: int | None = None) -> Any:
    """Return the type of a `string` or `wstring` of at most `bound` characters."""
    return str if bound is None else Annotated[str, Meta(max_length=bound)]


def array(element: Any, *, size: int | None = None, bound: int | None = None) -> Any:
    """Return the type of an array of a fixed size, of at most `bound` elements, or of any length.

    Arrays of `byte`, `char` and `uint8` are `bytes`, all others lists.
    """
    return limited(bytes if element == UInt8 else _LIST[element], size=size, bound=bound)


def limited(collection: Any, *, size: int | None = None, bound: int | None = None) -> Any:
    """Return a type of collections with a fixed size, or with at most `bound` elements."""
    most = bound if size is None else size
    if most is None:
        return collection
    return Annotated[collection, Meta(min_length=size, max_length=most)]


def struct(
    name: str,
    fields: Iterable[tuple[str, Any, Any]],
    *,
    module: str,
    doc: str,
    constants: Mapping[str, Any],
    ros_type: str = "",
) -> type[msgspec.Struct]:
    """Make a struct for a message, with its constants as attributes of the class.

    `ros_type` is the ROS 2 type of the message, such as `geometry_msgs/msg/Pose`; empty if it is
    not known. The class is then shown as one of `fibaction.ros_types`, and not of ROS's package,
    which has a class of the same name.

    `fields` are names, types and defaults. A default is plain data; that of a nested struct is a
    dict, and `{}` means the nested struct's own defaults. A field whose name is a keyword of Python
    becomes an attribute with `_` after the name, and keeps its name in payloads.
    """
    return msgspec.defstruct(
        name,
        [(attribute(field), kind, default(field, kind, plain)) for field, kind, plain in fields],
        module=".".join([_SHOWN, *ros_type.split("/")[:-1]]) if ros_type else module,
        namespace={"__doc__": doc, "__ros_type__": ros_type, **constants},
        forbid_unknown_fields=True,
        kw_only=True,
    )


def attribute(field: str) -> str:
    """Return the name of the attribute that holds a field."""
    return f"{field}_" if keyword.iskeyword(field) else field


def default(field: str, kind: Any, plain: Any) -> Any:
    """Return the default of a field for `msgspec.defstruct`; see `struct` for `plain`."""
    name = field if keyword.iskeyword(field) else None
    if isinstance(plain, (bool, int, float, str, bytes)):
        return msgspec.field(default=plain, name=name)
    if plain == []:
        return msgspec.field(default_factory=_LIST, name=name)
    decode = msgspec.msgpack.Decoder(kind).decode
    return msgspec.field(default_factory=partial(decode, _encode(plain)), name=name)
