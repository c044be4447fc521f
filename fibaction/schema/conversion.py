"""Values by any JSON Schema: with the defaults that are missing, and in the form that is sent."""

from __future__ import annotations

import base64
from collections.abc import Collection, Iterator
from typing import Any, cast

import msgspec

from fibaction._runtime.plain_data import is_list, is_map
from fibaction.schema.check import Check
from fibaction.schema.json_schema import SchemaError
from fibaction.schema.mismatch import Mismatch
from fibaction.schema.steps import text_steps

MAX_DEPTH = 100
"""Levels of nested data in a message that is checked."""


class NoMatch(Exception):
    """A value that does not match its schema."""

    def __init__(self, mismatch: Mismatch) -> None:
        super().__init__()
        self.mismatch = mismatch
        self.way: list[str | int] = []
        """The names and indices that lead to the value, the innermost first."""


def converted(check: Check, value: Any, schema: Any) -> Any:
    """Return a value as it is sent, with the defaults of fields that are missing.

    Raises:
        NoMatch: The value does not match.
        SchemaError: The check takes too many steps.
    """
    value = completed(check, value, schema)
    mismatch = next(check.mismatches(value, schema), None)
    if mismatch is not None:
        raise NoMatch(mismatch)
    return as_sent(check, value, schema)


def completed(check: Check, value: Any, schema: Any) -> Any:
    """Return the value with the defaults of fields that are missing."""
    if not (is_map(value) or is_list(value)):
        return value
    schema = check.resolved(schema, value)
    if is_map(value):
        return _completed_fields(check, value, schema)
    if schema.get("contentEncoding") == "base64":
        return bytes_of(value)
    return [completed(check, *pair) for pair in _items(value, schema)]


def bytes_of(values: Collection[Any]) -> Any:
    """Return a list of numbers as bytes; the list itself if it is not one."""
    if set(map(type, values)) <= {int}:
        try:
            return bytes(values)
        except ValueError:  # a number is not that of a byte
            pass
    return values


def _completed_fields(
    check: Check, value: dict[Any, Any], schema: dict[str, Any]
) -> dict[Any, Any]:
    known = schema.get("properties", {})
    whole: dict[Any, Any] = {}
    check.steps.spend(len(known))
    for name, part in known.items():
        if name in value:
            whole[name] = completed(check, value[name], part)
        elif is_map(part) and "default" in part:
            check.steps.fill(size_in_bytes({name: part["default"]}))
            whole[name] = copied(check, part["default"])
    rest = part_of(schema, "additionalProperties")
    for name in value:
        if name not in whole:
            whole[name] = completed(check, value[name], rest)
    return whole


def left_out(check: Check, value: Any, schema: Any) -> Iterator[str]:
    """Yield the names of the fields that a complete value does not have, such as `.stops[0].id`.

    Raises:
        SchemaError: The search takes too many steps.
    """
    if is_map(value):
        schema = check.resolved(schema, value)
        known, rest = schema.get("properties", {}), part_of(schema, "additionalProperties")
        check.steps.spend(len(known))
        yield from (f".{name}" for name in known if name not in value)
        for name, item in value.items():
            part = known.get(name, rest)
            yield from (f".{name}{inner}" for inner in left_out(check, item, part))
    elif is_list(value):
        for index, pair in enumerate(_items(value, check.resolved(schema, value))):
            yield from (f"[{index}]{inner}" for inner in left_out(check, *pair))


def converted_default(check: Check, schema: dict[str, Any]) -> Any:
    """Return the default of a field as it is sent.

    Raises:
        NoMatch: It is not of its type.
        SchemaError: It nests too deeply, or the check takes too many steps.
    """
    default = copied(check, schema["default"])
    mismatch = next(check.mismatches(default, schema), None)
    if mismatch is not None:
        raise NoMatch(mismatch)
    return as_sent(check, default, schema)


def size_in_bytes(value: Any) -> int:
    """Return the bytes that a value takes in a message; 0 if a message cannot have it."""
    try:
        return len(msgspec.msgpack.encode(value))
    except (TypeError, ValueError, OverflowError, RecursionError):
        return 0


def copied(check: Check, value: Any, levels: int = MAX_DEPTH) -> Any:
    """Return a copy of a default, which the message may need many times.

    Raises:
        SchemaError: It nests too deeply, or the check takes too many steps.
    """
    check.steps.spend(1 + text_steps(value))
    if (is_map(value) or is_list(value)) and not levels:
        raise SchemaError(f"has a default that nests deeper than {MAX_DEPTH} levels")
    if is_map(value):
        return {name: copied(check, item, levels - 1) for name, item in value.items()}
    if is_list(value):
        return [copied(check, item, levels - 1) for item in value]
    return value


def as_sent(check: Check, value: Any, schema: Any) -> Any:
    """Return a value that matches the schema as it is sent: bytes for base64, and so on."""
    if value is None or isinstance(value, int):
        return value
    schema = check.resolved(schema, value)
    if is_map(value):
        known, rest = schema.get("properties", {}), part_of(schema, "additionalProperties")
        return {name: as_sent(check, value[name], known.get(str(name), rest)) for name in value}
    if is_list(value):
        return [as_sent(check, *pair) for pair in _items(value, schema)]
    if isinstance(value, str) and schema.get("contentEncoding") == "base64":
        return base64.b64decode(value)
    if isinstance(value, float) and schema.get("type") == "integer":
        return int(value)  # JSON Schema accepts 3.0 as a whole number, decoders do not
    return value


def _items(value: Collection[Any], schema: dict[str, Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the items of a list, each with its schema."""
    first, rest = schema.get("prefixItems", []), part_of(schema, "items")
    for index, item in enumerate(value):
        yield item, first[index] if index < len(first) else rest


def part_of(schema: dict[str, Any], keyword: str) -> dict[str, Any]:
    """Return the schema of further items or fields; empty where the keyword is true or false."""
    part = schema.get(keyword)
    return cast("dict[str, Any]", part) if isinstance(part, dict) else {}
