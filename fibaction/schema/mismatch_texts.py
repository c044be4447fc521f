"""Sentences for the mismatches of data and a JSON Schema.

They name fields as `goal.waypoints[2].x`, and expect schemas as msgspec makes them. The length of a
sentence is limited, whatever the data and the schema are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

from fibaction._runtime.text import excerpt, nearest
from fibaction.schema.check import Mismatch, Path
from fibaction.words.plain_data import is_map, quoted

MAX_NAME = 60
"""Characters of a field's name that a sentence shows."""
MAX_PATH = 400
"""Characters of the way to a field that a sentence shows."""
MAX_NAMED = 20
"""Fields or values that a sentence lists."""
MAX_COMPARED = 1000
"""Fields among which a similar name is looked for, and kinds among which those are found that
differ."""

_TYPES = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "array": "a list",
    "object": "a map of fields",
    "null": "null",
}
_FORMAT_NAMES = {
    "date-time": "a date and time in ISO 8601",
    "iso-date-time": "a date and time with seconds, such as 2026-01-31T12:00:00Z",
    "date-time-local": "a date and time in ISO 8601 without an offset from UTC",
    "date": "a date in ISO 8601",
    "time": "a time in ISO 8601",
    "iso-time": "a time with seconds, such as 12:00:00",
    "partial-time": "a time in ISO 8601 without an offset from UTC",
    "duration": "a duration in ISO 8601",
    "uuid": "a UUID",
}
_LIMITS = {
    "minimum": "is less than the minimum of {}",
    "maximum": "is greater than the maximum of {}",
    "exclusiveMinimum": "is less than or equal to the minimum of {}",
    "exclusiveMaximum": "is greater than or equal to the maximum of {}",
    "multipleOf": "is not a multiple of {}",
    "minLength": "is shorter than {} characters",
    "maxLength": "is longer than {} characters",
    "minItems": "has fewer than {} items",
    "maxItems": "has more than {} items",
    "minProperties": "has fewer than {} fields",
    "maxProperties": "has more than {} fields",
    "uniqueItems": "has an item twice",
    "oneOf": "fits more than one alternative",
    "not": "is a value that the schema excludes",
    "false": "is a value where the schema allows none",
}


def sentences(mismatch: Mismatch, name: str) -> Iterator[str]:
    """Yield what is wrong with a message that is called `name`."""
    field, value = field_name(name, mismatch.path), quoted(mismatch.value)
    match mismatch.keyword:
        case "additionalProperties":
            for unknown in islice(_unknown_names(mismatch), MAX_NAMED):
                yield _unknown(field, unknown, mismatch.expected)
        case "required":
            # A misspelled field is reported as unknown, and not as missing as well.
            known = mismatch.schema.get("properties", {})
            meant = {
                nearest(unknown, known, MAX_NAME)
                for unknown in islice(_names_beside(mismatch.value, known), MAX_NAMED)
            }
            missing = (one for one in mismatch.expected if one not in (*mismatch.value, *meant))
            named = [excerpt(one, MAX_NAME) for one in islice(missing, MAX_NAMED + 1)]
            if len(named) == 1:
                yield f"{field}.{named[0]} is missing"
            elif named:
                yield f"{field}: {_all_of(named)} are missing"
        case "type" | "enum" | "const":
            yield f"{field} must be {_expected(mismatch)}, not {value}"
        case "format":
            yield f"{field} must be {_FORMAT_NAMES[mismatch.expected]}, not {value}"
        case "contentEncoding":
            yield f"{field} must be bytes in base64, not {value}"
        case "anyOf":
            yield from _none_of(mismatch, name)
        case keyword:
            yield f"{field}: {value} {_LIMITS[keyword].format(quoted(mismatch.expected))}"


def _none_of(mismatch: Mismatch, name: str) -> Iterator[str]:
    """Yield what is wrong with a value that fits no alternative.

    The alternative that was meant is known from the tag, or from the kind of the value.
    """
    field, value = field_name(name, mismatch.path), mismatch.value
    tag, known = _tag(mismatch)
    if tag and tag not in value:
        yield f"{field}.{excerpt(tag, MAX_NAME)} is missing: {_either(map(quoted, known))}"
        return
    if tag and value[tag] not in known:
        found = quoted(value[tag])
        yield f"{field}.{excerpt(tag, MAX_NAME)} must be {_either(map(quoted, known))}, not {found}"
        return
    meant = [
        found
        for found in mismatch.alternatives
        if not any(one.excludes(mismatch.path) for one in found)
    ]
    if meant:
        for part in min(meant, key=len):
            yield from sentences(part, name)
    else:
        yield f"{field} must be {_expected(mismatch)}, not {quoted(value)}"


def _tag(mismatch: Mismatch) -> tuple[str, list[str]]:
    """Return the name of the field that tells alternatives apart, and its values; or nothing."""
    choice = mismatch.schema.get("discriminator")
    if not (is_map(choice) and is_map(mismatch.value)):
        return "", []
    tag, known = choice.get("propertyName"), choice.get("mapping")
    return (tag, list(known)) if isinstance(tag, str) and is_map(known) else ("", [])


def _expected(mismatch: Mismatch) -> str:
    return _either(dict.fromkeys(islice(_kinds(mismatch), MAX_COMPARED)))


def _kinds(mismatch: Mismatch) -> Iterator[str]:
    match mismatch.keyword, mismatch.expected:
        case "type", str(name):
            yield _TYPES.get(name, quoted(name))
        case "type", names:
            yield from (_TYPES.get(name, quoted(name)) for name in names)
        case "enum", values:
            yield from map(quoted, values)
        case "const", value:
            yield quoted(value)
        case _:
            pass
    for alternative in mismatch.alternatives:
        for part in alternative:
            yield from _kinds(part)


def _unknown_names(mismatch: Mismatch) -> Iterator[str]:
    return _names_beside(mismatch.value, frozenset(mismatch.expected))


def _names_beside(value: Iterable[object], known: Iterable[str]) -> Iterator[str]:
    return (name for name in map(str, value) if name not in known)


def _unknown(field: str, name: str, known: Iterable[str]) -> str:
    text = f"{field} has no field {quoted(name)}"
    if near := nearest(name, known, MAX_NAME):
        return f"{text}; did you mean {near}?"
    return f"{text}; it has {_listed(known) or 'no fields'}"


def _listed(names: Iterable[str]) -> str:
    shown = [excerpt(name, MAX_NAME) for name in islice(names, MAX_NAMED + 1)]
    return ", ".join(shown[:MAX_NAMED]) + (", ..." if len(shown) > MAX_NAMED else "")


def field_name(name: str, path: Path) -> str:
    """Return the name of a field of a message."""
    parts = (
        f"[{part}]" if isinstance(part, int) else f".{excerpt(part, MAX_NAME)}" for part in path
    )
    return excerpt(name + "".join(parts), MAX_PATH)


def _all_of(texts: list[str]) -> str:
    if len(texts) > MAX_NAMED:
        return f"{', '.join(texts[:MAX_NAMED])} and others"
    *others, last = texts
    return f"{', '.join(others)} and {last}"


def _either(texts: Iterable[str]) -> str:
    shown = list(islice(texts, MAX_NAMED + 1))
    if len(shown) > MAX_NAMED:
        return f"{', '.join(shown[:MAX_NAMED])} or another"
    *others, last = shown or ["another value"]
    return f"{', '.join(others)} or {last}" if others else last
