"""Checks of plain data by a JSON Schema of a peer, and the values that are sent, in one pass.

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
- `Check` counts steps, by `fibaction.schema.steps`. A step is the visit of one value with one
  schema, one element of a collection of the schema, or some characters of a text. Real types need
  few of them for each value of the data, but alternatives within alternatives may need
  exponentially many. A check may take 20,000 steps, and 50 more for each value of the data.
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

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from fibaction.schema.steps import CheckSteps
from fibaction.words.plain_data import is_map

Path: TypeAlias = tuple[str | int, ...]

MAX_DEPTH = 100
"""Levels of nested data in a message that is checked."""
MAX_NESTING = 200
"""Levels of schemas. Optional types need two for each level of the data."""
MAX_MISMATCHES = 100
"""Mismatches that are kept of a message, and of each alternative."""


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
