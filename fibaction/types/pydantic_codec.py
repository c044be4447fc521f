"""Types with pydantic models in them, which pydantic dumps and validates.

A value is dumped to plain data, and this is encoded as for any other type: bytes stay bytes. So a
peer may use another kind of class with the same fields. Received data is validated by the rules of
the models. A strict model takes a UUID or a tuple from JSON only, and msgpack has neither; so data
that JSON can express is valid, too, if it is valid as JSON.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from pydantic import BaseModel, PydanticUserError, TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from fibaction.types.base import Encoding
from fibaction.types.schemas import constant_of
from fibaction.words.plain_data import is_list, is_map

MAX_VALIDATION_ERRORS = 3
"""Problems of one message that the text of an error names."""


class PydanticEncoding(Encoding):
    """A type that pydantic validates and dumps."""

    def __init__(self, message_type: Any) -> None:
        """Check a type.

        Raises:
            TypeError: pydantic cannot validate it, or has no JSON Schema for it.
        """
        self.classes = tuple(_classes_of(message_type))
        try:
            self._adapter: TypeAdapter[Any] = TypeAdapter(message_type)
            self._schema = self._adapter.json_schema(schema_generator=_Schemas)
        except PydanticUserError as exc:
            # The first sentence says what is wrong, the others how to get around it in pydantic.
            text = str(exc).partition("\n")[0].partition(". ")[0].rstrip(".")
            if isinstance(message_type, type) and issubclass(message_type, msgspec.Struct):
                text = f"{text}: a msgspec.Struct cannot hold models"
            raise TypeError(f"a type with pydantic models cannot be encoded: {text}") from exc
        self.encode = self._encode
        self.decode = self._decode

    def schema(self) -> dict[str, Any]:
        return self._schema

    def _encode(self, value: Any) -> bytes:
        plain = self._adapter.dump_python(value, by_alias=True, round_trip=True, warnings="error")
        return _encode(plain)

    def _decode(self, payload: bytes) -> Any:
        data = msgspec.msgpack.decode(payload)
        try:
            return self._adapter.validate_python(data)
        except ValidationError as exc:
            text = _text_of(exc)
        if not _has_bytes(data):
            try:
                return self._adapter.validate_json(msgspec.json.encode(data))
            except ValidationError as exc:
                text = _text_of(exc)
        # Raised here, so that it does not keep pydantic's error, which holds the data.
        raise msgspec.ValidationError(text)


class _Schemas(GenerateJsonSchema):
    """JSON Schemas in the form of those of msgspec, which clients know."""

    def bytes_schema(self, schema: core_schema.BytesSchema) -> JsonSchemaValue:
        return {"type": "string", "contentEncoding": "base64"}

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        union = super().tagged_union_schema(schema)
        union["anyOf"] = union.pop("oneOf")
        return union

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        if "default_factory" in schema and not schema.get("default_factory_takes_data"):
            default = constant_of(schema["default_factory"], _plain)
            if default is not msgspec.NODEFAULT:
                schema = {**schema, "default": default}
        return super().default_schema(schema)

    def encode_default(self, dft: Any) -> Any:
        return msgspec.to_builtins(dft, enc_hook=_plain)


def _classes_of(kind: Any) -> Iterator[type]:
    """Yield the classes of the values of a type; `object` for a type that allows any value."""
    origin = get_origin(kind)
    if origin is Annotated:
        yield from _classes_of(get_args(kind)[0])
    elif origin in (Union, UnionType):
        for part in get_args(kind):
            yield from _classes_of(part)
    elif origin is Literal:
        yield from {type(value) for value in get_args(kind)}
    elif isinstance(origin, type):
        yield origin
    elif hasattr(kind, "__supertype__"):  # a `NewType`
        yield from _classes_of(kind.__supertype__)
    elif hasattr(kind, "__value__"):  # a type alias
        yield from _classes_of(kind.__value__)
    elif kind is Any or not isinstance(kind, type):
        yield object
    elif hasattr(kind, "__total__"):
        yield dict  # as it is no class at run time
    else:
        yield from (float, int) if kind is float else (kind,)


def _plain(value: Any) -> Any:
    """Return a value that pydantic knows, and msgspec does not, as plain data."""
    if hasattr(value, "get_secret_value"):
        # Pydantic would write asterisks.
        raise TypeError(f"a {type(value).__name__} is not sent: give its field a serializer")
    if isinstance(value, BaseModel):  # a default
        return value.model_dump(by_alias=True, round_trip=True)
    return _adapter(type(value)).dump_python(value, mode="json")


_adapter: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)


_encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode


def _has_bytes(data: Any) -> bool:
    """Return whether plain data has bytes in it, which JSON does not express."""
    if is_map(data):
        return any(_has_bytes(item) for item in data.values())
    if is_list(data):
        return any(_has_bytes(item) for item in data)
    return isinstance(data, (bytes, msgspec.msgpack.Ext))


def _text_of(error: ValidationError) -> str:
    """Return what is wrong as one sentence, in the form of msgspec's."""
    problems = error.errors(include_url=False, include_context=False, include_input=False)
    texts: list[str] = []
    for problem in problems[:MAX_VALIDATION_ERRORS]:
        path = "".join(f"[{one}]" if isinstance(one, int) else f".{one}" for one in problem["loc"])
        texts.append(f"{problem['msg']} - at `${path}`" if path else problem["msg"])
    more = len(problems) - MAX_VALIDATION_ERRORS
    return "; ".join([*texts, *([f"and {more} more"] if more > 0 else [])])
