"""The keywords of JSON Schema that compare one value with something that the schema says."""

from __future__ import annotations

import base64
import datetime
import uuid
from collections.abc import Callable
from typing import Any

import msgspec

from fibaction._runtime.plain_data import is_list, is_map, is_number


def _is_text(value: object) -> bool:
    return isinstance(value, str)


_IS_TYPE: dict[str, Callable[[Any], bool]] = {
    "null": lambda value: value is None,
    "boolean": lambda value: isinstance(value, bool),
    "integer": lambda value: is_number(value) and (isinstance(value, int) or value.is_integer()),
    "number": is_number,
    "string": _is_text,
    "array": is_list,
    "object": is_map,
}

_FORMAT_TYPES: dict[str, Any] = {
    "date-time": datetime.datetime,
    "date": datetime.date,
    "time": datetime.time,
    "duration": datetime.timedelta,
    "uuid": uuid.UUID,
}


def _type(value: Any, expected: Any) -> bool:
    if isinstance(expected, str):
        return expected not in _IS_TYPE or _IS_TYPE[expected](value)
    return any(_type(value, name) for name in expected)


def _multiple_of(value: Any, unit: Any) -> bool:
    if not is_number(value):
        return True
    if isinstance(value, int) and isinstance(unit, int):
        return value % unit == 0
    try:
        return float(value / unit).is_integer()
    except OverflowError:  # a float cannot tell
        return True


def _format(value: Any, expected: Any) -> bool:
    if expected in _FORMAT_TYPES and isinstance(value, str):
        try:
            msgspec.convert(value, _FORMAT_TYPES[expected])
        except (msgspec.ValidationError, ValueError):
            return False
    return True


def _content_encoding(value: Any, expected: Any) -> bool:
    if expected == "base64" and isinstance(value, str):
        try:
            base64.b64decode(value, validate=True)
        except ValueError:
            return False
    return True


def _of(
    kind: Callable[[Any], bool], compare: Callable[[Any, Any], bool]
) -> Callable[[Any, Any], bool]:
    """Return a comparison that holds for all values of another kind."""
    return lambda value, expected: not kind(value) or compare(value, expected)


COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "type": _type,
    # NaN is neither below a limit nor above it.
    "minimum": _of(is_number, lambda value, least: not value < least),
    "maximum": _of(is_number, lambda value, most: not value > most),
    "exclusiveMinimum": _of(is_number, lambda value, bound: not value <= bound),
    "exclusiveMaximum": _of(is_number, lambda value, bound: not value >= bound),
    "multipleOf": _multiple_of,
    "minLength": _of(_is_text, lambda value, least: len(value) >= least),
    "maxLength": _of(_is_text, lambda value, most: len(value) <= most),
    "format": _format,
    "contentEncoding": _content_encoding,
    "minItems": _of(is_list, lambda value, least: len(value) >= least),
    "maxItems": _of(is_list, lambda value, most: len(value) <= most),
    "minProperties": _of(is_map, lambda value, least: len(value) >= least),
    "maxProperties": _of(is_map, lambda value, most: len(value) <= most),
    "required": _of(is_map, lambda value, names: all(name in value for name in names)),
}
"""Returns for each keyword whether a value is as the keyword's value requires."""
