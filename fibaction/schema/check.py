"""JSON Schemas of a peer, and checks of plain data by them, which make the values that are sent.

Theory of operation
-------------------

A schema comes from a server, and data may come from a client. Both may be hostile, so this is not
a complete validator. It knows the keywords that msgspec writes and some that it does not, and
ignores all others. The server checks the goal by itself; the check here is earlier and names the
field. These dangers of a complete validator do not exist here:

- A reference is followed only within the schema: `#`, or a path such as `#/$defs/Name`. Any other
  reference is an error. Nothing is ever retrieved.
- Regular expressions (`pattern`, `patternProperties`) are ignored, because a short one can take
  years.
- Of `if`, `dependentSchemas` and `unevaluatedProperties` it is only known that they may describe
  fields, which are let through. `tests/schema/test_official_suite.py` names all differences from
  the official tests of JSON Schema.
- `JsonSchema` reads a schema before its first use, and finds values of the wrong type, references
  to nothing, and references that lead only to themselves.
- `Check` counts steps (`CheckSteps`). A step is the visit of one value with one schema, one element
  of a collection of the schema, or some characters of a text. Real types need few of them for each
  value of the data, but alternatives within alternatives may need exponentially many. A check may
  take 20,000 steps, and 50 more for each value of the data.
- Schemas that are followed for one value may nest to `MAX_NESTING` levels, so that Python's limit
  of recursion is not met.

Each of these ends with a `SchemaError`. Compiled validators cannot replace this one. They do not
count, so a schema of 2 kB with alternatives within alternatives keeps them busy for hours, in which
they hold the interpreter's lock; and data that nests very deeply ends the process.

Each part of a schema becomes a `SchemaPart`, prepared once. Its `visit` returns a value as it is
sent: with defaults for fields that are missing, bytes for base64 text, 3 for 3.0 where a whole
number is wanted. Where the value does not match, it notes a `Mismatch` at the check, and goes on. A
part knows the types of which each value is sent as it is (`plain`), and these are not visited: a
list of numbers is not even copied. It also knows the types and the tags that a value must have to
fit, so that nearly always one of the alternatives is left. Several are tried, each with a list of
mismatches of its own.

The returned value shares parts with the data and with the defaults, so it is only read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple, TypeAlias, cast
from urllib.parse import unquote

from fibaction.words.plain_data import is_list, is_map, is_number, quoted

MAX_PARTS = 20_000
"""Schemas within a schema."""

REFERENCES = ("$ref", "$dynamicRef", "$recursiveRef")
PARTS = ("items", "additionalProperties", "propertyNames", "not")
"""Keywords with a schema."""
LISTS_OF_PARTS = ("anyOf", "allOf", "oneOf", "prefixItems")
"""Keywords with a list of schemas."""


class SchemaError(ValueError):
    """An error for a schema that cannot be used, or with which a check takes too long.

    The text continues a sentence that begins with "the schema of the goal".
    """


def is_text(value: object) -> bool:
    """Return whether a value is a text."""
    return isinstance(value, str)


def _is_count(value: object) -> bool:
    return is_number(value) and cast("float", value) >= 0


def _is_unit(value: object) -> bool:
    return is_number(value) and 0 < cast("float", value) < math.inf


def _is_names(value: object) -> bool:
    return is_list(value) and all(map(is_text, value))


def _is_type(value: object) -> bool:
    return is_text(value) or _is_names(value)


_SHAPES: dict[str, Callable[[object], bool]] = {
    **dict.fromkeys((*REFERENCES, "format", "contentEncoding"), is_text),
    **dict.fromkeys(("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"), is_number),
    **dict.fromkeys(("minLength", "maxLength", "minItems", "maxItems"), _is_count),
    **dict.fromkeys(("minProperties", "maxProperties"), _is_count),
    **dict.fromkeys(("enum", *LISTS_OF_PARTS), is_list),
    "properties": is_map,
    "multipleOf": _is_unit,
    "type": _is_type,
    "required": _is_names,
    "uniqueItems": lambda value: isinstance(value, bool),
}
"""The test that the value of each keyword must pass."""


class JsonSchema:
    """A JSON Schema that is well-formed, not too large, and without references that lead only to
    themselves.

    Definitions that nothing refers to are not read. Reading does not recurse.
    """

    def __init__(self, root: Any) -> None:
        """Read a schema, which must not be changed later.

        Raises:
            SchemaError: It cannot be used.
        """
        self.root = root
        self._targets: dict[str, Any] = {}
        waiting, seen = [root], set[int]()
        while waiting:
            part = waiting.pop()
            if isinstance(part, bool) or id(part) in seen:
                continue
            if not is_map(part):
                raise SchemaError(f"is malformed: {quoted(part)} is not a schema")
            seen.add(id(part))
            waiting.extend(self._parts(part))
            if len(seen) + len(waiting) > MAX_PARTS:
                raise SchemaError(f"has more than {MAX_PARTS:,} parts")

    def target(self, reference: str) -> Any:
        """Return the schema that a reference names.

        Raises:
            SchemaError: The reference leads out of the schema, or to nothing.
        """
        if reference not in self._targets:
            self._targets[reference] = self._found(reference)
        return self._targets[reference]

    def _parts(self, part: dict[Any, Any]) -> Iterator[Any]:
        """Check one schema, and yield those that it contains or refers to."""
        for keyword, is_right in _SHAPES.items():
            if keyword in part and not is_right(part[keyword]):
                raise SchemaError(f'is malformed: "{keyword}" cannot be {quoted(part[keyword])}')
        for keyword in PARTS:
            if keyword in part:
                yield part[keyword]
        for keyword in LISTS_OF_PARTS:
            yield from part.get(keyword, ())
        for name, schema in part.get("properties", {}).items():
            if not isinstance(name, str):
                raise SchemaError(f"is malformed: {quoted(name)} is not the name of a field")
            yield schema
        self._check_end(part)
        for keyword in REFERENCES:
            if keyword in part:
                yield self.target(part[keyword])

    def _found(self, reference: str) -> Any:
        if reference not in ("", "#") and not reference.startswith("#/"):
            raise SchemaError(
                f"refers to {quoted(reference)}, which is outside of it; only references such as"
                f' "#/$defs/Name" are followed, and nothing is fetched'
            )
        found = self.root
        for step in unquote(reference).split("/")[1:]:  # RFC 6901, section 6
            step = step.replace("~1", "/").replace("~0", "~")
            if is_map(found) and step in found:
                found = found[step]
            elif is_list(found) and step.isdecimal() and int(step[:9]) < len(found):
                found = list(found)[int(step[:9])]
            else:
                raise SchemaError(f"refers to {quoted(reference)}, which is not in it")
        return found

    def _check_end(self, part: Any) -> None:
        """Check that the references from a part to the next one have an end."""
        seen = set[int]()
        while is_map(part) and isinstance(part.get("$ref"), str):
            if id(part) in seen:
                raise SchemaError(f"refers to itself without end, by {quoted(part['$ref'])}")
            seen.add(id(part))
            part = self.target(part["$ref"])


STEPS = 20_000
"""Steps of a check, whatever the data is; they take some hundredths of a second."""
STEPS_PER_VALUE = 50
"""More steps for each value of the data, and for each `TEXT_PER_STEP` characters of it."""
TEXT_PER_STEP = 100
FILLED = 2**20
"""Bytes of defaults that a check may fill in, whatever the data is."""
FILLED_PER_VALUE = 32
"""More bytes of defaults for each value of the data."""
TURN = 1000
"""Steps between two pauses: about a millisecond."""

_TEXTS: frozenset[type] = frozenset({str, bytes})
CONTAINERS: frozenset[type] = frozenset({dict, list})
MAX_DEPTH = 100
"""Levels of nested data in a message that is checked."""
MAX_NESTING = 200
"""Levels of schemas. Optional types need two for each level of the data."""
MAX_MISMATCHES = 100
"""Mismatches that are kept of a message, and of each alternative."""


class Extent(NamedTuple):
    """The extent of plain data."""

    size: int
    """The number of values, where text counts by its length as well."""
    levels: int
    """Lists and maps within each other."""

    @classmethod
    def of(cls, value: Any) -> Extent:
        """Return the extent of data. It counts one level after another, which is fast."""
        size, levels = 0, 0
        values: list[Any] = [value]
        while True:
            texts = [one for one in values if type(one) in _TEXTS]
            size += len(values) + sum(map(text_steps, texts))
            parts = [one for one in values if type(one) in CONTAINERS]
            if not parts:
                return cls(size, levels)
            levels += 1
            inner = (chain(one, one.values()) if is_map(one) else one for one in parts)
            values = [*chain.from_iterable(inner)]


def text_steps(value: object) -> int:
    """Return the steps for the characters of a text, or for bytes; 0 for any other value."""
    return len(value) // TEXT_PER_STEP if isinstance(value, (str, bytes)) else 0


class CheckSteps:
    """The steps that are left for the check of one message."""

    __slots__ = ("_granted", "_left", "_limit", "_pause", "_room", "_room_left")

    def __init__(self, size: int, pause: Callable[[], None] | None = None) -> None:
        """Allow as many steps as data of this size may need; see `Extent`.

        `pause` is called after each `TURN` of them.
        """
        self._pause = pause
        self._limit = STEPS + STEPS_PER_VALUE * size
        self._room = self._room_left = FILLED + FILLED_PER_VALUE * size
        self._granted = self._left = 0

    @property
    def spent(self) -> int:
        """The steps so far."""
        return self._granted - self._left

    def spend(self, steps: int = 1) -> None:
        """Count steps.

        Raises:
            SchemaError: They are too many.
        """
        self._left -= steps
        if self._left < 0:
            self._grant()

    def fill(self, size: int) -> None:
        """Count bytes of defaults.

        Raises:
            SchemaError: They are too many.
        """
        self._room_left -= size
        if self._room_left < 0:
            raise SchemaError(
                f"has too many defaults: in this message they take over {self._room:,} bytes"
            )

    def _grant(self) -> None:
        wanted = self._granted - self._left
        if wanted > self._limit:
            raise SchemaError(f"is too complex: a check by it takes over {self._limit:,} steps")
        more = min(TURN, self._limit - wanted)
        self._granted, self._left = wanted + more, more
        if self._pause is not None:
            self._pause()


def are_equal(steps: CheckSteps, one: Any, other: Any) -> bool:
    """Return whether two values are the same in JSON, where true is not 1, but 1.0 is.

    Raises:
        SchemaError: The comparison takes too many steps.
    """
    steps.spend(1 + text_steps(one))
    if is_map(one) and is_map(other):
        return one.keys() == other.keys() and all(
            are_equal(steps, one[key], other[key]) for key in one
        )
    if is_list(one) and is_list(other):
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(are_equal(steps, *pair) for pair in pairs)
    return isinstance(one, bool) == isinstance(other, bool) and bool(one == other)


Path: TypeAlias = tuple[str | int, ...]


class Mismatch(NamedTuple):
    """One reason why data does not match a schema."""

    path: Path
    """The names and indices that lead to the value."""
    keyword: str
    expected: Any
    """The value of the keyword."""
    value: Any
    schema: dict[str, Any]
    alternatives: tuple[list[Mismatch], ...] = ()
    """The mismatches of each alternative, of `anyOf`."""
    is_other_kind: bool = False
    """True if the value is of another type, and not only of a wrong content."""

    def excludes(self, path: Path) -> bool:
        """Return whether the value at `path` is of another kind, or has another tag."""
        if self.path == path:
            return self.is_other_kind
        return only_value(self.schema) is not None and len(self.path) == len(path) + 1


def only_value(schema: Any) -> tuple[Any] | None:
    """Return the only value that a schema allows, as a tuple; None if it may allow several."""
    if not is_map(schema):
        return None
    values = [schema["const"]] if "const" in schema else schema.get("enum", ())
    return (values[0],) if len(values) == 1 else None


class EnoughMismatches(Exception):
    """So many mismatches were found that the rest is not looked for."""


class Check:
    """The check of one message, which counts its steps."""

    def __init__(
        self, size: int = 1, pause: Callable[[], None] | None = None, *, fills: bool = True
    ) -> None:
        """Prepare the check of data of this size; see `CheckSteps`."""
        self.steps = CheckSteps(size, pause)
        self.fills = fills
        """True if fields that are missing get their defaults."""
        self.found: list[Mismatch] = []
        """The mismatches so far."""
        self.left_out: list[Path] | None = None
        """The fields that the value may have and has not; None if they are not wanted."""
        self.path: list[str | int] = []
        """The names and indices that lead to the value that is visited."""

    def note(
        self,
        schema: dict[str, Any],
        keyword: str,
        value: Any,
        expected: Any,
        alternatives: tuple[list[Mismatch], ...] = (),
        *,
        is_other_kind: bool = False,
    ) -> None:
        """Note a mismatch of the value that is visited; see `Mismatch`.

        Raises:
            EnoughMismatches: There are too many.
        """
        self.found.append(
            Mismatch(
                tuple(self.path), keyword, expected, value, schema, alternatives, is_other_kind
            )
        )
        if len(self.found) >= MAX_MISMATCHES:
            raise EnoughMismatches
