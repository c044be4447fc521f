"""The keywords of JSON Schema: `COMPARISONS` with what the schema says, and `COMBINATIONS`.

The second ones lead to other schemas, or take steps. Each of their functions returns the value, as
far as it is made by then.
"""

from __future__ import annotations

import math
import re
import uuid
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from datetime import date, datetime, time, timedelta
from typing import Annotated, Any, Protocol, TypeAlias

import msgspec

from fibaction.schema.check import Check, Extent, Mismatch, are_equal, is_text
from fibaction.words.plain_data import is_list, is_map, is_number

_IS_TYPE: dict[str, Callable[[Any], bool]] = {
    "null": lambda value: value is None,
    "boolean": lambda value: isinstance(value, bool),
    "integer": lambda value: is_number(value) and (isinstance(value, int) or value.is_integer()),
    "number": is_number,
    "string": is_text,
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


class Visited(Protocol):
    """A part of a schema, as far as these keywords need it."""

    schema: dict[str, Any]
    texts: frozenset[str] | None

    def visit(self, check: Check, value: Any, nesting: int = 0, *, is_open: bool = False) -> Any:
        """Return a value as it is sent."""

    def tried(
        self, check: Check, value: Any, nesting: int = 0, *, is_open: bool = False
    ) -> tuple[Any, list[Mismatch]]:
        """Return a value as it is sent, and its mismatches, which are not noted at the check."""
        ...

    def likely(self, check: Check, keyword: str, value: Any) -> Sequence[Visited]:
        """Return the alternatives of a keyword that a value may fit."""
        ...

    def alternatives(self, keyword: str) -> Sequence[Visited]:
        """Return the parts of a keyword with a list of schemas."""
        ...

    def inner(self, keyword: str) -> Visited:
        """Return the part of a keyword with a schema."""
        ...

    def target(self) -> Visited:
        """Return the part that the reference names."""
        ...


def false(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    """Note that a schema allows no value."""
    check.note(part.schema, "false", value, False)
    return value


def _enum(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    if type(value) is str and part.texts is not None:
        if value in part.texts:
            return value
    elif any(are_equal(check.steps, in_json(value), one) for one in part.schema["enum"]):
        return value
    check.note(part.schema, "enum", value, part.schema["enum"], is_other_kind=True)
    return value


def _const(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    if not are_equal(check.steps, in_json(value), part.schema["const"]):
        check.note(part.schema, "const", value, part.schema["const"], is_other_kind=True)
    return value


def _unique(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    if is_list(value) and part.schema["uniqueItems"]:
        check.steps.spend(Extent.of(value).size)
        if len(set(map(frozen, value))) < len(value):
            check.note(part.schema, "uniqueItems", value, True)
    return value


def _property_names(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    if is_map(value):
        names = part.inner("propertyNames")
        for name in value:
            names.visit(check, str(name), nesting)
    return value


def _any_of(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    likely = part.likely(check, "anyOf", value)
    found: dict[Visited, list[Mismatch]] = {}
    if len(likely) == 1:
        count = len(check.found)
        made = likely[0].visit(check, value, nesting, is_open=is_open)
        if len(check.found) == count:
            return made
        wrong, path = check.found[count:], tuple(check.path)
        if not any(one.excludes(path) for one in wrong):
            return made
        del check.found[count:]
        found[likely[0]], likely = wrong, likely[:0]
    for one in likely:
        made, found[one] = one.tried(check, value, nesting, is_open=is_open)
        if not found[one]:
            return made
    _note_none_fits(part, check, value, nesting, part.alternatives("anyOf"), found)
    return value


def _one_of(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    found: dict[Visited, list[Mismatch]] = {}
    likely = part.likely(check, "oneOf", value)
    fitting: list[Any] = []
    for one in likely:
        made, found[one] = one.tried(check, value, nesting, is_open=is_open)
        if not found[one]:
            fitting.append(made)
    if not fitting:
        _note_none_fits(part, check, value, nesting, part.alternatives("oneOf"), found)
    elif len(fitting) > 1:
        check.note(part.schema, "oneOf", value, part.schema["oneOf"])
    else:
        return fitting[0]
    return value


def _note_none_fits(
    part: Visited,
    check: Check,
    value: Any,
    nesting: int,
    alternatives: Sequence[Visited],
    found: dict[Visited, list[Mismatch]],
) -> None:
    """Note that a value fits no alternative; some may be tried already."""
    every = tuple(
        found[one] if one in found else one.tried(check, value, nesting, is_open=True)[1]
        for one in alternatives
    )
    path = tuple(check.path)
    is_tagged = "discriminator" in part.schema and is_map(value)
    is_other = not is_tagged and all(any(one.excludes(path) for one in some) for some in every)
    check.note(part.schema, "anyOf", value, None, every, is_other_kind=is_other)


def _all_of(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    for one in part.alternatives("allOf"):
        value = one.visit(check, value, nesting, is_open=True)
    return value


def _not(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    if not part.inner("not").tried(check, value, nesting, is_open=True)[1]:
        check.note(part.schema, "not", value, part.schema["not"])
    return value


def _reference(part: Visited, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
    return part.target().visit(check, value, nesting, is_open=is_open)


COMBINATIONS: dict[str, Callable[[Visited, Check, Any, int, bool], Any]] = {
    "enum": _enum,
    "const": _const,
    "uniqueItems": _unique,
    "propertyNames": _property_names,
    "anyOf": _any_of,
    "oneOf": _one_of,
    "allOf": _all_of,
    "not": _not,
    "$ref": _reference,
}
