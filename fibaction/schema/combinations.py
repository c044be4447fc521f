"""The keywords of a schema that lead to other schemas, or compare with values that take steps.

Each function returns the value, as far as it is made by then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from fibaction.schema.check import Check, Extent, Mismatch, are_equal
from fibaction.schema.keywords import frozen, in_json
from fibaction.words.plain_data import is_list, is_map


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
