"""The keywords of JSON Schema that compare one value with something that the schema says."""

from __future__ import annotations

import math
import re
import uuid
from collections.abc import Callable, Collection
from contextlib import suppress
from datetime import date, datetime, time, timedelta
from typing import Annotated, Any, TypeAlias

import msgspec

from fibaction.words.plain_data import is_list, is_map, is_number


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

PYTHON_TYPES: dict[str, frozenset[type]] = {
    "null": frozenset({type(None)}),
    "boolean": frozenset({bool}),
    "integer": frozenset({int}),
    "number": frozenset({int, float}),
    "string": frozenset({str}),
    "array": frozenset({list}),
    "object": frozenset({dict}),
}
"""The types of Python that each type of a schema has."""
IN_JSON = frozenset[type]().union(*PYTHON_TYPES.values())
"""The types that values have in JSON."""

_STAMP = re.compile(r"[-+]?\d{1,20}(?:\.\d{1,9})?", re.ASCII)
_LASTS = re.compile(
    r"[-+]?P(?=.*\d)(?:\d+(?:[.,]\d*)?[YMWD])*(?:T(?:\d+(?:[.,]\d*)?[HMS])*)?"
    r"|[-+]?(?=.)(?:\d+ ?d(?:ays?)?,? ?)?(?:\d+:\d\d(?::\d\d(?:\.\d+)?)?)?",
    re.ASCII | re.IGNORECASE,
)


def _iso(*kinds: Any) -> tuple[Callable[[str], Any], ...]:
    """Return what reads a text of ISO 8601, or seconds since 1970, as pydantic does."""
    return (*(kind.fromisoformat for kind in kinds), _STAMP.fullmatch)


_READERS: dict[str, tuple[Any, tuple[Callable[[str], Any], ...]]] = {
    "date-time": (datetime, _iso(datetime)),
    "iso-date-time": (datetime, ()),
    "date-time-local": (Annotated[datetime, msgspec.Meta(tz=False)], ()),
    "date": (date, _iso(date, datetime)),
    "time": (time, _iso(time)),
    "iso-time": (time, ()),
    "partial-time": (Annotated[time, msgspec.Meta(tz=False)], ()),
    "duration": (timedelta, (_LASTS.fullmatch,)),
    "uuid": (uuid.UUID, (uuid.UUID,)),
}
"""For each format the type of msgspec whose texts it has, and what reads the texts that servers
with pydantic take as well. A server that does not take one says so.
"""

_NEARLY = 1e-9
"""The difference from a multiple that a number may have, as a part of it: pydantic allows that."""


def is_of_type(value: Any, expected: Any) -> bool:
    """Return whether a value is of a type, or one of several; a type that is not known has all."""
    if isinstance(expected, str):
        return expected not in _IS_TYPE or _IS_TYPE[expected](value)
    return any(is_of_type(value, name) for name in expected)


def is_multiple_of(value: Any, unit: Any) -> bool:
    """Return whether a number is a multiple of another one, as far as floats can tell: 19.99 is one
    of 0.01.
    """
    if isinstance(value, int) and isinstance(unit, int):
        return value % unit == 0
    try:
        number, step = float(value), float(unit)
        nearly = min(_NEARLY * max(1.0, abs(number)), step / 1000)
        return abs(math.remainder(number, step)) <= nearly or (number / step).is_integer()
    except OverflowError:  # a float cannot tell
        return True
    except ValueError:  # infinity
        return False


def _format(value: str, expected: Any) -> bool:
    if expected not in _READERS:
        return True
    kind, readers = _READERS[expected]
    with suppress(msgspec.ValidationError, ValueError):
        msgspec.convert(value, kind)
        return True
    for read in readers:
        with suppress(ValueError, OverflowError):
            if read(value) is not None:
                return True
    return False


def frozen(value: Any) -> Any:
    """Return a key that is the same for all values that are equal in JSON. Numbers are text in it,
    since a stranger can choose many with the same hash.
    """
    value = in_json(value)
    if is_map(value):
        return "{", frozenset((str(name), frozen(one)) for name, one in value.items())
    if is_list(value):
        return "[", *map(frozen, value)
    is_whole = type(value) is float and value.is_integer()
    return repr(int(value) if is_whole else value)


def _is_at_least(value: Any, least: Any) -> bool:
    return bool(len(value) >= least)


def _is_at_most(value: Any, most: Any) -> bool:
    return bool(len(value) <= most)


Comparison: TypeAlias = Callable[[Any, Any], bool]

_OF_NUMBERS: dict[str, Comparison] = {
    # NaN is neither below a limit nor above it.
    "minimum": lambda value, least: not value < least,
    "maximum": lambda value, most: not value > most,
    "exclusiveMinimum": lambda value, bound: not value <= bound,
    "exclusiveMaximum": lambda value, bound: not value >= bound,
    "multipleOf": is_multiple_of,
}
COMPARISONS: dict[type, dict[str, Comparison]] = {
    int: _OF_NUMBERS,
    float: _OF_NUMBERS,
    str: {"minLength": _is_at_least, "maxLength": _is_at_most, "format": _format},
    list: {"minItems": _is_at_least, "maxItems": _is_at_most},
    dict: {"minProperties": _is_at_least, "maxProperties": _is_at_most},
}
"""For each type of values, the keywords that compare them, and whether one is as they require."""


def in_json(value: Any) -> Any:
    """Return a value with text in place of what JSON writes as text."""
    return value if type(value) in IN_JSON else msgspec.to_builtins(value)


def bytes_of(values: Collection[Any]) -> Any:
    """Return a list of numbers as bytes; the list itself if it is not one."""
    if set(map(type, values)) <= {int}:
        try:
            return bytes(values)
        except ValueError:  # a number is not that of a byte
            pass
    return values


def size_in_bytes(value: Any) -> int:
    """Return the bytes that a value takes in a message; 0 if a message cannot have it."""
    try:
        return len(msgspec.msgpack.encode(value))
    except (TypeError, ValueError, OverflowError, RecursionError):
        return 0
