"""The types of messages: which of them can be sent, and how each is encoded.

Most types are left to msgspec: structs, dataclasses, attrs classes, TypedDicts, builtins. A type
with a pydantic model in it is left to pydantic, which is imported only then: as long as the program
has not imported it, there is no such type.
"""

from __future__ import annotations

import datetime
import decimal
import re
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import PurePath
from typing import Any, cast, get_args, get_origin, get_type_hints

import msgspec
from msgspec import inspect

from fibaction._runtime.text import excerpt
from fibaction.types.base import Encoding
from fibaction.types.ros_classes import is_message_class, message_class
from fibaction.types.schemas import is_path_class, path_of, path_schema, plain_path, schema_of

_encode = msgspec.msgpack.Encoder(enc_hook=plain_path).encode


class MsgspecEncoding(Encoding):
    """A type that msgspec encodes and decodes."""

    may_hold_messages = True

    def __init__(self, message_type: Any) -> None:
        """Check a type.

        Raises:
            TypeError: msgspec cannot encode and decode it.
            NameError: A field has a type that is not defined.
        """
        info = inspect.type_info(message_type)
        hooked: set[type] = set()
        _check_can_be_encoded(info, set(), hooked)
        self._type = message_type
        self.classes = tuple(_classes_of(info))
        self.encode = _encode
        self.decode = msgspec.msgpack.Decoder(message_type).decode
        self._schema: Callable[[Any], dict[str, Any]] = schema_of
        if hooked:
            if all(map(is_path_class, hooked)):
                self.decode = msgspec.msgpack.Decoder(message_type, dec_hook=path_of).decode
                self._schema = partial(schema_of, describe=path_schema)
            else:
                from fibaction.types import ros_messages

                self.decode = ros_messages.decoder(message_type)
                self._schema = ros_messages.schema

    def schema(self) -> dict[str, Any]:
        try:
            return self._schema(self._type)
        except TypeError:
            return {}


def encoding_of(message_type: Any) -> Encoding:
    """Return the encoding of a type.

    Raises:
        TypeError: It cannot be encoded and decoded; the text is one sentence.
    """
    if is_message_class(message_type):
        from fibaction.types.ros_messages import RosEncoding

        return RosEncoding(message_type)
    if "pydantic" in sys.modules and has_pydantic(message_type):
        from fibaction.types.pydantic_codec import PydanticEncoding  # which imports pydantic

        return PydanticEncoding(message_type)
    try:
        return MsgspecEncoding(message_type)
    except NameError as exc:
        name = getattr(message_type, "__qualname__", message_type)
        raise TypeError(f"{name} has a field of a type that is not defined: {exc}") from exc
    except TypeError as exc:
        if (union := _UNION.search(str(exc))) is not None:
            has_classes = "Struct" in str(exc) or "dataclass" in str(exc)
            raise TypeError(
                f"a message does not tell the types of {union[1]} apart: "
                + ("make each a msgspec.Struct with tag=True" if has_classes else "use one of them")
            ) from exc
        if isinstance(message_type, type) or type(message_type).__module__ in _SPECIAL:
            raise
        shown = excerpt(repr(message_type))
    raise TypeError(f"{shown} is a value, and not a type")


_UNION = re.compile(r"type union.* - type `(.*)` is not supported", re.IGNORECASE)
"""The error of msgspec for a union of types that have one form in a message."""


_SPECIAL = {"types", "typing", "typing_extensions"}
"""The modules of the classes of types that are not classes, such as `list[int]`."""


def has_pydantic(kind: Any, seen: set[int] | None = None) -> bool:
    """Return whether a type is a model or a dataclass of pydantic, or has one in it.

    `seen` are the types, by their identity, that need not be looked at again.
    """
    seen = set() if seen is None else seen
    if id(kind) in seen:  # a type may contain itself
        return False
    seen.add(id(kind))
    if isinstance(kind, type) and hasattr(kind, "__pydantic_serializer__"):
        return True
    # A `NewType` and a type alias name another type.
    named = [getattr(kind, name, None) for name in ("__supertype__", "__value__")]
    parts = [get_origin(kind), *named, *get_args(kind)]
    if isinstance(kind, type):
        with suppress(NameError, TypeError):  # the check of the type tells what is wrong
            parts += get_type_hints(kind, include_extras=True).values()
    return any(has_pydantic(part, seen) for part in parts if part is not None)


_CLASSES: dict[type[inspect.Type], tuple[type, ...]] = {
    inspect.NoneType: (type(None),),
    inspect.BoolType: (bool,),
    inspect.IntType: (int,),
    inspect.FloatType: (float, int),  # as for type checkers, an int will do for a float
    inspect.StrType: (str,),
    inspect.BytesType: (bytes,),
    inspect.ByteArrayType: (bytearray,),
    inspect.MemoryViewType: (memoryview,),
    inspect.ListType: (list,),
    inspect.TupleType: (tuple,),
    inspect.VarTupleType: (tuple,),
    inspect.SetType: (set,),
    inspect.FrozenSetType: (frozenset,),
    inspect.DictType: (dict,),
    inspect.TypedDictType: (dict,),
    inspect.DateTimeType: (datetime.datetime,),
    inspect.DateType: (datetime.date,),
    inspect.TimeType: (datetime.time,),
    inspect.TimeDeltaType: (datetime.timedelta,),
    inspect.UUIDType: (uuid.UUID,),
    inspect.DecimalType: (decimal.Decimal,),
    inspect.RawType: (msgspec.Raw,),
    inspect.ExtType: (msgspec.msgpack.Ext,),
}


def _check_can_be_encoded(info: object, seen: set[int], hooked: set[type]) -> None:
    """Check that no class, however deeply nested, is one that msgspec would give to a hook, but for
    those of ROS and of `pathlib`, which are added to `hooked`.

    Raises:
        TypeError: A class is, or a default is one that no schema can have.
    """
    if id(info) in seen:  # a type may contain itself
        return
    seen.add(id(info))
    if isinstance(info, inspect.CustomType):
        if info.cls is object:
            return
        if is_message_class(info.cls):
            message_class(info.cls)  # which checks it
            hooked.add(info.cls)
            return
        if is_path_class(info.cls):
            hooked.add(info.cls)
            return
        raise TypeError(
            f"{info.cls.__qualname__} cannot be encoded: use a msgspec.Struct, a dataclass, an"
            f" attrs class, a pydantic model, a TypedDict or a builtin"
        )
    if isinstance(info, inspect.Field):
        if isinstance(info.default, PurePath):
            raise TypeError(
                f"the default of {info.name!r} is a path: write"
                f" `field(default_factory=lambda: {type(info.default).__name__}(...))`"
            )
        _check_can_be_encoded(info.type, seen, hooked)
    elif isinstance(info, inspect.Type):
        for name in info.__struct_fields__:
            value: object = getattr(info, name)
            parts = cast("tuple[object, ...]", value if isinstance(value, tuple) else (value,))
            for part in parts:
                _check_can_be_encoded(part, seen, hooked)


def _classes_of(info: inspect.Type) -> Iterator[type]:
    """Yield the classes of the values of a type; `object` for a type that allows any value."""
    if isinstance(info, inspect.Metadata):
        yield from _classes_of(info.type)
    elif isinstance(info, inspect.UnionType):
        for part in info.types:
            yield from _classes_of(part)
    elif isinstance(info, inspect.LiteralType):
        yield from {type(value) for value in info.values}
    elif type(info) in _CLASSES:
        yield from _CLASSES[type(info)]
    else:
        cls = getattr(info, "cls", object)
        yield get_origin(cls) or cls  # a generic class comes with its arguments
