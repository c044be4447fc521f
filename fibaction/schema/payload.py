"""JSON data to the payloads of an action and back, by the action's JSON Schemas.

With it, a program that has no Python types of an action can send goals that come from a form, a
file or another protocol. For example, with the description that a server sends of an action:

    from fibaction.schema.payload import JsonCodec

    goals = JsonCodec(info.goal)
    payload = goals.encode({"order": 3})  # defaults are filled in

The schema and the data may be hostile: nothing is fetched, no regular expression of a schema is
run, and the work and the length of errors are limited.
"""

from __future__ import annotations

import base64
import datetime
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import Any, cast

import msgspec

from fibaction._runtime.plain_data import is_list, is_map
from fibaction.schema.check import MAX_MISMATCHES, Check
from fibaction.schema.json_schema import MAX_PARTS, JsonSchema, SchemaError
from fibaction.schema.mismatch_texts import sentences
from fibaction.schema.steps import size_of

__all__ = ["MAX_PARTS", "JsonCodec", "JsonSchema", "PayloadError", "SchemaError", "to_json"]

MAX_PROBLEMS = 5
"""Problems of one message that the text of an error names; later ones often follow from them."""
MAX_DEPTH = 100
"""Levels of nested data in a message that is checked."""


class PayloadError(ValueError):
    """An error for data that is not a message of the expected type.

    The text is one sentence, which names the fields: `goal.order must be a whole number, not "x"`.
    """

    def __init__(self, *problems: str) -> None:
        more = len(problems) - MAX_PROBLEMS
        shown = [*problems[:MAX_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
        super().__init__("; ".join(shown))
        self.problems = problems
        """The problems, one sentence each: all of them, or the first hundred or so."""


class JsonCodec:
    """A converter between JSON data and the payloads of one message type.

    In JSON data, bytes are base64 text, and times and durations are ISO 8601 text. Data that is to
    be sent may have a list of numbers from 0 to 255 in place of base64 text.
    """

    def __init__(self, schema: Mapping[str, Any], name: str = "goal") -> None:
        """Make a codec from a JSON Schema of `ActionInfo`. An empty schema allows any data.

        The schema must not be changed later. `name` is what errors call the message.

        Raises:
            PayloadError: The schema is malformed, too large, or refers to something outside of it.
        """
        self._name = name
        with self._errors():
            self._schema = None if schema == {} else JsonSchema(schema)

    def complete(self, data: Any) -> Any:
        """Return the message as plain data that can be sent, for example by an untyped client.

        Fields that are missing get their defaults, base64 text becomes bytes where the schema asks
        for bytes, and 3.0 becomes 3 where it asks for a whole number. `data` stays as it is; it may
        hold bytes already.

        Raises:
            PayloadError: The data does not match the schema, has a field that it does not name, or
                nests deeper than 100 levels; or msgpack cannot express it; or the schema is so
                complex that the check takes too long.
        """
        return self._message(data)[0]

    def encode(self, data: Any) -> bytes:
        """Return the payload of a message; see `complete`.

        Raises:
            PayloadError: As `complete`.
        """
        return self._message(data)[1]

    def decode(self, payload: bytes) -> Any:
        """Return the message in a payload as JSON data; see `to_json`.

        Raises:
            PayloadError: The payload is not msgpack, or JSON cannot express what it holds.
        """
        return msgspec.json.decode(self.to_text(payload))

    def to_text(self, payload: bytes) -> str:
        """Return the message in a payload as JSON text on one line; see `to_json`.

        Raises:
            PayloadError: As `decode`.
        """
        try:
            message = msgspec.msgpack.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as exc:
            raise PayloadError(f"the {self._name} is not a valid payload: {exc}") from exc
        return to_json(message)

    def _message(self, data: Any) -> tuple[Any, bytes]:
        """Return the message as plain data, and encoded."""
        with self._errors():
            if self._schema is not None:
                # Without tuples and sets, and without parts that are the same object.
                data = msgspec.to_builtins(data, builtin_types=(bytes, datetime.datetime))
                data = self._checked(data, self._schema)
            return data, msgspec.msgpack.encode(data)

    @contextmanager
    def _errors(self) -> Generator[None, None, None]:
        try:
            yield
        except PayloadError:
            raise
        except SchemaError as exc:
            raise PayloadError(f"the schema of the {self._name} {exc}") from exc
        except (TypeError, ValueError, OverflowError, RecursionError) as exc:
            raise PayloadError(f"the {self._name} cannot be encoded: {exc}") from exc

    def _checked(self, data: Any, schema: JsonSchema) -> Any:
        if _is_deeper(data, MAX_DEPTH):
            raise PayloadError(f"the {self._name} nests deeper than {MAX_DEPTH} levels")
        check = Check(schema, size_of(data))
        data = _completed(check, data, schema.root)
        mismatches = islice(check.mismatches(data, schema.root), MAX_MISMATCHES)
        # Each missing field is a mismatch, whose sentences name all of them.
        problems = dict.fromkeys(text for one in mismatches for text in sentences(one, self._name))
        if problems:
            raise PayloadError(*problems)
        return _converted(check, data, schema.root)


def _is_deeper(data: Any, levels: int) -> bool:
    if not (is_map(data) or is_list(data)):
        return False
    inner = data.values() if is_map(data) else data
    return not levels or any(_is_deeper(item, levels - 1) for item in inner)


def _completed(check: Check, value: Any, schema: Any) -> Any:
    """Return the value with the defaults of fields that are missing."""
    if not (is_map(value) or is_list(value)):
        return value
    schema = check.resolved(schema, value)
    if is_map(value):
        return _completed_fields(check, value, schema)
    if schema.get("contentEncoding") == "base64":
        return _bytes_of(value)
    return [_completed(check, *pair) for pair in _items(value, schema)]


def _bytes_of(values: Collection[Any]) -> Any:
    """Return a list of numbers as bytes; the list itself if it is not one."""
    if all(type(value) is int and 0 <= value <= 0xFF for value in values):
        return bytes(values)
    return values


def _completed_fields(
    check: Check, value: dict[Any, Any], schema: dict[str, Any]
) -> dict[Any, Any]:
    known = schema.get("properties", {})
    whole: dict[Any, Any] = {}
    check.steps.spend(len(known))
    for name, part in known.items():
        if name in value:
            whole[name] = _completed(check, value[name], part)
        elif is_map(part) and "default" in part:
            whole[name] = _copied(check, part["default"], MAX_DEPTH)
    rest = _part(schema, "additionalProperties")
    for name in value:
        if name not in whole:
            whole[name] = _completed(check, value[name], rest)
    return whole


def _copied(check: Check, value: Any, levels: int) -> Any:
    """Return a copy of a default, which the message may need many times."""
    check.steps.spend(size_of(value) if isinstance(value, str | bytes) else 1)
    if (is_map(value) or is_list(value)) and not levels:
        raise SchemaError(f"has a default that nests deeper than {MAX_DEPTH} levels")
    if is_map(value):
        return {name: _copied(check, item, levels - 1) for name, item in value.items()}
    if is_list(value):
        return [_copied(check, item, levels - 1) for item in value]
    return value


def _converted(check: Check, value: Any, schema: Any) -> Any:
    """Return a value that matches the schema as it is sent: bytes for base64, and so on."""
    if value is None or isinstance(value, int):
        return value
    schema = check.resolved(schema, value)
    if is_map(value):
        known, rest = schema.get("properties", {}), _part(schema, "additionalProperties")
        return {name: _converted(check, value[name], known.get(str(name), rest)) for name in value}
    if is_list(value):
        return [_converted(check, *pair) for pair in _items(value, schema)]
    if isinstance(value, str) and schema.get("contentEncoding") == "base64":
        return base64.b64decode(value)
    if isinstance(value, float) and schema.get("type") == "integer":
        return int(value)  # JSON Schema accepts 3.0 as a whole number, decoders do not
    return value


def _items(value: Collection[Any], schema: dict[str, Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the items of a list, each with its schema."""
    first, rest = schema.get("prefixItems", []), _part(schema, "items")
    for index, item in enumerate(value):
        yield item, first[index] if index < len(first) else rest


def _part(schema: dict[str, Any], keyword: str) -> dict[str, Any]:
    """Return the schema of further items or fields; empty where the keyword is true or false."""
    part = schema.get(keyword)
    return cast("dict[str, Any]", part) if isinstance(part, dict) else {}


def to_json(value: Any) -> str:
    """Return plain data, as an untyped client receives it, as JSON text on one line.

    Bytes become base64 text, times ISO 8601 text, NaN and infinities null, and an extension of
    msgpack a map of its code and its data.

    Raises:
        PayloadError: JSON cannot express the value.
    """
    try:
        return msgspec.json.encode(value, enc_hook=_without_extension).decode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise PayloadError(f"the value cannot be written as JSON: {exc}") from exc


def _without_extension(value: Any) -> Any:
    if isinstance(value, msgspec.msgpack.Ext):
        return {"ext": value.code, "data": value.data}
    raise TypeError(f"JSON has no {type(value).__name__}")
