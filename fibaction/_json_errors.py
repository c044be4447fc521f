"""Sentences for the errors of a JSON Schema validator.

They name fields as `goal.waypoints[2].x`, and expect schemas as msgspec makes them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import msgspec

from fibaction._plain_data import is_map

Error: TypeAlias = Any
"""A `jsonschema.ValidationError`. The stub says of each attribute that it may be unset."""

MAX_QUOTED = 60
"""Characters of a wrong value that an error quotes."""

_TYPES = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "array": "a list",
    "object": "a map of fields",
    "null": "null",
}
_FORMATS = {
    "date-time": "a date and time in ISO 8601",
    "date": "a date in ISO 8601",
    "time": "a time in ISO 8601",
    "duration": "a duration in ISO 8601",
    "uuid": "a UUID",
}


def sentences(error: Error, name: str) -> Iterator[str]:
    """Yield what is wrong with a message that is called `name`."""
    field, value = _field(name, error.absolute_path), quoted(error.instance)
    match error.validator:
        case "additionalProperties":
            for unknown in _unknown_names(error):
                yield _unknown(field, unknown, error.schema["properties"])
        case "required":
            # A misspelled field is reported as unknown, and not as missing as well.
            known = error.schema["properties"]
            meant = {_nearest(unknown, known) for unknown in _unknown_names(error)}
            for required in error.validator_value:
                if required not in error.instance and required not in meant:
                    yield f"{field}.{required} is missing"
        case "type" | "enum":
            yield f"{field} must be {_expected(error)}, not {value}"
        case "format":
            yield f"{field} must be {_FORMATS[error.validator_value]}, not {value}"
        case "contentEncoding":
            yield f"{field} must be bytes in base64, not {value}"
        case "anyOf":
            yield from _none_of(error, name)
        case _:
            yield f"{field}: {error.message.replace(repr(error.instance), value)}"


def place(error: Error) -> list[tuple[bool, str | int]]:
    """Return a key that sorts errors by their fields."""
    return [(isinstance(part, int), part) for part in error.absolute_path]


def quoted(value: Any) -> str:
    """Return a value as JSON on one line, shortened to `MAX_QUOTED` characters."""
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


def _none_of(error: Error, name: str) -> Iterator[str]:
    """Yield what is wrong with a value that fits no alternative.

    The alternative that was meant is known from the tag, or from the kind of the value.
    """
    field = _field(name, error.absolute_path)
    choice = error.schema.get("discriminator")
    if choice is not None and is_map(error.instance):
        value = error.instance
        tag, known = choice["propertyName"], choice["mapping"]
        if tag not in value:
            yield f"{field}.{tag} is missing: {_either(map(quoted, known))}"
            return
        if value[tag] not in known:
            found = quoted(value[tag])
            yield f"{field}.{tag} must be {_either(map(quoted, known))}, not {found}"
            return
    meant = [errors for errors in _branches(error) if not any(map(_is_other_kind, errors))]
    if meant:
        fewest = min(meant, key=len)
        for part in sorted(fewest, key=place):
            yield from sentences(part, name)
    else:
        yield f"{field} must be {_expected(error)}, not {quoted(error.instance)}"


def _branches(error: Error) -> list[list[Error]]:
    """Return the errors of each alternative."""
    branches: dict[Any, list[Error]] = {}
    for part in error.context:
        branches.setdefault(part.relative_schema_path[0], []).append(part)
    return list(branches.values())


def _is_other_kind(error: Error) -> bool:
    """Return whether the value is of another kind than this alternative, or has another tag."""
    path = list(error.relative_path)
    if error.validator == "anyOf" and not path:
        tagged = "discriminator" in error.schema and is_map(error.instance)
        return not tagged and all(any(map(_is_other_kind, part)) for part in _branches(error))
    tagged = error.validator == "enum" and len(path) == 1 and len(error.validator_value) == 1
    return tagged or (error.validator in ("type", "enum") and not path)


def _expected(error: Error) -> str:
    return _either(dict.fromkeys(_kinds(error)))


def _kinds(error: Error) -> Iterator[str]:
    if error.validator == "type":
        names = error.validator_value
        yield from (_TYPES[name] for name in ([names] if isinstance(names, str) else names))
    elif error.validator == "enum":
        yield from map(quoted, error.validator_value)
    for part in error.context:
        yield from _kinds(part)


def _unknown_names(error: Error) -> list[str]:
    return [name for name in error.instance if name not in error.schema["properties"]]


def _unknown(field: str, name: str, known: Iterable[str]) -> str:
    text = f"{field} has no field {quoted(name)}"
    if near := _nearest(name, known):
        return f"{text}; did you mean {near}?"
    return f"{text}; it has {', '.join(known) or 'no fields'}"


def _nearest(word: str, known: Iterable[str]) -> str:
    """Return the known word that was probably meant; empty if none is near."""
    return next(iter(difflib.get_close_matches(word, list(known), n=1)), "")


def _field(name: str, path: Iterable[str | int]) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return name + "".join(parts)


def _either(texts: Iterable[str]) -> str:
    *others, last = texts
    return f"{', '.join(others)} or {last}" if others else last
