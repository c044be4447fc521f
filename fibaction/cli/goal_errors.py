"""What is wrong with a goal, in words: from the errors of a JSON Schema validator.

It speaks of fields as `goal.waypoints[2].x`, and knows schemas as msgspec makes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import msgspec

from fibaction.cli.action_names import nearest
from fibaction.cli.output import is_map

Error: TypeAlias = Any
"""A `jsonschema.ValidationError`; to type checkers, each of its attributes may be unset."""

MOST_CHARACTERS = 60
"""Of a wrong value that is quoted."""

_TYPES = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "array": "a list",
    "object": "a map of fields",
    "null": "null",
}


def told(error: Error) -> Iterator[str]:
    """What to tell the user of an error."""
    field, value = _field(error.absolute_path), quoted(error.instance)
    match error.validator:
        case "additionalProperties":
            for name in _unknown_names(error):
                yield _unknown(field, name, error.schema["properties"])
        case "required":
            # A field that is misspelt is not told of as missing, too.
            known = error.schema["properties"]
            meant = {nearest(name, known) for name in _unknown_names(error)}
            for name in error.validator_value:
                if name not in error.instance and name not in meant:
                    yield f"{field}.{name} is missing"
        case "type" | "enum":
            yield f"{field} must be {_wanted(error)}, not {value}"
        case "format":
            yield f"{field}: {value} is no {error.validator_value} as ISO 8601 or RFC 4122 has it"
        case "anyOf":
            yield from _none_of(error)
        case _:
            yield f"{field}: {error.message.replace(repr(error.instance), value)}"


def _none_of(error: Error) -> Iterator[str]:
    """Which of the alternatives was meant is seen by the tag, or by the kind of the value."""
    field = _field(error.absolute_path)
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
        for part in sorted(fewest, key=place_of):
            yield from told(part)
    else:
        yield f"{field} must be {_wanted(error)}, not {quoted(error.instance)}"


def _branches(error: Error) -> list[list[Error]]:
    """What is wrong with each of the alternatives."""
    branches: dict[Any, list[Error]] = {}
    for part in error.context:
        branches.setdefault(part.relative_schema_path[0], []).append(part)
    return list(branches.values())


def _is_other_kind(error: Error) -> bool:
    """Whether the value is of another kind than this alternative, or another struct by its tag."""
    place = list(error.relative_path)
    if error.validator == "anyOf" and not place:
        tagged = "discriminator" in error.schema and is_map(error.instance)
        return not tagged and all(any(map(_is_other_kind, part)) for part in _branches(error))
    tagged = error.validator == "enum" and len(place) == 1 and len(error.validator_value) == 1
    return tagged or (error.validator in ("type", "enum") and not place)


def _wanted(error: Error) -> str:
    """What a value should be."""
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
    if ":" in name:
        return f"{text}; a blank belongs behind the colon"
    if near := nearest(name, known):
        return f"{text}; did you mean {near}?"
    return f"{text}; it has {', '.join(known) or 'none at all'}"


def _field(path: Iterable[str | int]) -> str:
    """The name of a field, from the goal on: `goal.waypoints[2].x`."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "goal" + "".join(parts)


def place_of(error: Error) -> list[tuple[bool, str | int]]:
    """The place of an error in the goal, to sort errors by."""
    return [(isinstance(part, int), part) for part in error.absolute_path]


def _either(texts: Iterable[str]) -> str:
    *others, last = texts
    return f"{', '.join(others)} or {last}" if others else last


def quoted(value: Any) -> str:
    """A value, quoted, on one line."""
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."
