"""Checks of plain data by a JSON Schema of a peer: nothing is fetched, and the work is bounded.

Theory of operation

A schema comes from a server, and data may come from a client. Both may be hostile, so this is not
a complete validator. It knows the keywords that msgspec writes and some that it does not, and
ignores all others. The server checks the goal by itself; the check here is earlier and names the
field. These dangers of a complete validator do not exist here:

- A reference is followed only within the schema: `#`, or a path such as `#/$defs/Name`. Any other
  reference is an error. Nothing is ever retrieved.
- Regular expressions (`pattern`, `patternProperties`) are ignored, because a short one can take
  years.
- `JsonSchema` reads a schema before its first use, and finds values of the wrong type, references
  to nothing, and references that lead only to themselves.
- `Check` counts steps, by `fibaction.schema.steps`. A step is the visit of one value with one
  schema, one element of a collection of the schema, or some characters of a text. Real types need
  few of them for each value of the data, but alternatives within alternatives may need
  exponentially many. A check may take 20,000 steps, and 50 more for each value of the data.
- Schemas that are followed for one value may nest to `MAX_NESTING` levels, so that Python's limit
  of recursion is not met.

Each of these ends with a `SchemaError`. Where the data does not match, a `Mismatch` is yielded for
each reason, of which `fibaction.schema.mismatch_texts` makes sentences.

Compiled validators cannot replace this one. They do not count, so a schema of 2 kB with
alternatives within alternatives keeps them busy for hours, in which they hold the interpreter's
lock; and data that nests very deeply ends the process.

A visit has a path, a nesting and a generator of mismatches. `Check.passes` finds without these that
a scalar matches, so that a long list of numbers needs no visit for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, islice, repeat
from typing import Any, NamedTuple, cast

import msgspec

from fibaction._runtime.plain_data import is_map
from fibaction.schema.json_schema import JsonSchema, SchemaError
from fibaction.schema.keywords import COMPARISONS
from fibaction.schema.mismatch import Mismatch, Path, only_value
from fibaction.schema.steps import CheckSteps, are_equal, text_steps

MAX_NESTING = 200
"""Levels of schemas. Optional types need two for each level of the data."""
MAX_MISMATCHES = 100
"""Mismatches that are kept of a message, and of each alternative."""

_SCALARS = (str, int, float)
_IN_JSON = (*_SCALARS, dict, list)


class Check:
    """The check of one message, which counts its steps."""

    def __init__(
        self, schema: JsonSchema, size: int, pause: Callable[[], None] | None = None
    ) -> None:
        """Prepare the check of data of this size; see `CheckSteps`."""
        self.steps = CheckSteps(size, pause)
        self._schema = schema
        self._plans: dict[int, _Plan] = {}

    def mismatches(self, value: Any, schema: Any) -> Iterator[Mismatch]:
        """Yield the reasons why a value does not match a part of the schema.

        Raises:
            SchemaError: The check takes too many steps, or nests too deeply.
        """
        return _mismatches(_Visit(self, _as_in_json(value), schema))

    def resolved(self, schema: Any, value: Any) -> dict[str, Any]:
        """Return the schema of a value, behind references and alternatives; `{}` if none fits.

        Raises:
            SchemaError: The search takes too many steps, or nests too deeply.
        """
        while is_map(schema):
            self.steps.spend()
            if "$ref" in schema:
                schema = self.target(schema["$ref"])
            elif "anyOf" in schema or "oneOf" in schema:
                schema = self._chosen(schema["anyOf" if "anyOf" in schema else "oneOf"], value)
            else:
                return schema
        return {}

    def target(self, reference: str) -> Any:
        """Return the schema that a reference names."""
        return self._schema.target(reference)

    def passes(self, value: Any, schema: Any) -> bool:
        """Return True for a scalar that matches the schema; False if only a visit can tell.

        Raises:
            SchemaError: The check takes too many steps.
        """
        if not (value is None or isinstance(value, _SCALARS)) or not is_map(schema):
            return False
        plan = self.plan(schema)
        self.steps.spend(plan.cost + text_steps(value))
        if not plan.is_final:
            return False
        return all(holds(value, expected) for _, holds, expected in plan.comparisons)

    def plan(self, schema: dict[str, Any]) -> _Plan:
        """Return the plan for a part of the schema."""
        plan = self._plans.get(id(schema))
        if plan is None:
            plan = self._plans[id(schema)] = _Plan.of(schema)
        return plan

    def _chosen(self, parts: list[Any], value: Any) -> Any:
        value = _as_in_json(value)
        likely = [part for part in parts if _may_fit(_Visit(self, value, part))]
        if len(likely) == 1:  # nearly always, and then it does not matter how large the value is
            return likely[0]
        fitting = (part for part in likely if _fits(_Visit(self, value, part)))
        return next(fitting, cast("Any", {}))


class _Visit(NamedTuple):
    """One value, and the schema by which it is checked."""

    check: Check
    value: Any
    schema: Any
    path: Path = ()
    nesting: int = 0
    is_open: bool = False
    """True if the schema describes only some of the fields."""

    def inside(self, key: str | int, value: Any, schema: Any) -> _Visit:
        """Return the visit of a field or item."""
        path, nesting = (*self.path, key), self.nesting + 1
        return _Visit(self.check, _as_in_json(value), schema, path, nesting)

    def by(self, schema: Any, *, is_open: bool = False) -> _Visit:
        """Return the visit of the same value with another schema."""
        nesting, is_open = self.nesting + 1, is_open or self.is_open
        return _Visit(self.check, self.value, schema, self.path, nesting, is_open)

    def wrong(self, keyword: str, *, is_other_kind: bool = False) -> Mismatch:
        """Return the mismatch for a keyword."""
        expected = self.schema[keyword]
        return Mismatch(self.path, keyword, expected, self.value, self.schema, (), is_other_kind)


def _as_in_json(value: Any) -> Any:
    """Return a value with text in place of what JSON writes as text."""
    if value is None or isinstance(value, _IN_JSON):
        return cast("Any", value)
    return msgspec.to_builtins(value)


def _fits(visit: _Visit) -> bool:
    return not any(True for _ in _mismatches(visit))


def _may_fit(visit: _Visit) -> bool:
    """Return whether a value has the type and the tag of a schema, which is fast to tell."""
    check, value, schema = visit.check, visit.value, visit.schema
    check.steps.spend()
    _check_nesting(visit)
    if not is_map(schema):
        return schema is True
    if "$ref" in schema:
        return _may_fit(visit.by(check.target(schema["$ref"])))
    if "anyOf" in schema:
        return any(_may_fit(visit.by(part)) for part in schema["anyOf"])
    if "type" in schema and not COMPARISONS["type"](value, schema["type"]):
        return False
    known: dict[str, Any] = schema.get("properties", {}) if is_map(value) else {}
    check.steps.spend(len(known))
    only = ((name, only_value(part)) for name, part in known.items() if name in value)
    return all(tag is None or are_equal(check.steps, value[name], tag[0]) for name, tag in only)


def _check_nesting(visit: _Visit) -> None:
    if visit.nesting > MAX_NESTING:
        raise SchemaError(f"nests deeper than {MAX_NESTING} levels for one value")


class _Plan(NamedTuple):
    """The keywords of one schema that are checked."""

    comparisons: list[tuple[str, Callable[[Any, Any], bool], Any]]
    combinations: list[Callable[[_Visit], Iterator[Mismatch]]]
    is_open: bool
    """True if others may describe more fields."""
    is_final: bool
    """True if the comparisons alone decide about a scalar."""
    cost: int

    @classmethod
    def of(cls, schema: dict[str, Any]) -> _Plan:
        """Return the plan for a schema."""
        combinations = [search for word, search in COMBINATIONS.items() if word in schema]
        return cls(
            [(word, test, schema[word]) for word, test in COMPARISONS.items() if word in schema],
            combinations,
            "properties" in schema and any(word in schema for word in _COMBINING),
            not combinations and "$ref" not in schema,
            1 + len(schema.get("required", ())),
        )


def _mismatches(visit: _Visit) -> Iterator[Mismatch]:
    _check_nesting(visit)
    check, value = visit.check, visit.value
    steps = text_steps(value)
    while is_map(visit.schema):
        schema = visit.schema
        plan = check.plan(schema)
        check.steps.spend(plan.cost + steps)
        if plan.is_open and not visit.is_open:
            visit = visit._replace(is_open=True)
        for keyword, holds, expected in plan.comparisons:
            if not holds(value, expected):
                yield visit.wrong(keyword, is_other_kind=keyword == "type")
        for mismatches in plan.combinations:
            yield from mismatches(visit)
        if isinstance(value, dict):
            yield from _fields(visit)
        elif isinstance(value, list):
            yield from _items(visit)
        if "$ref" not in schema:
            return
        visit = visit._replace(schema=check.target(schema["$ref"]))
    if visit.schema is False:
        yield Mismatch(visit.path, "false", False, value, {})


def _fields(visit: _Visit) -> Iterator[Mismatch]:
    value, schema = visit.value, visit.schema
    known = schema.get("properties", {})
    # A server may ignore unknown fields, but the author of one expects it to have an effect.
    rest = schema.get("additionalProperties", visit.is_open or "properties" not in schema)
    if "patternProperties" in schema:
        rest = True  # the names that it allows are not known
    visit.check.steps.spend(len(value))
    if rest is False and any(str(key) not in known for key in value):
        yield Mismatch(visit.path, "additionalProperties", list(known), value, schema)
    for key, item in value.items():
        part = known.get(str(key), True if rest is False else rest)
        if part is not True and not visit.check.passes(item, part):
            yield from _mismatches(visit.inside(str(key), item, part))


def _items(visit: _Visit) -> Iterator[Mismatch]:
    value, schema = visit.value, visit.schema
    first, rest = schema.get("prefixItems", []), schema.get("items", True)
    if rest is False and len(value) > len(first):
        yield Mismatch(visit.path, "maxItems", len(first), value, schema)
    parts = chain(first, repeat(rest, 0 if isinstance(rest, bool) else len(value)))
    for index, (item, part) in enumerate(zip(value, parts, strict=False)):
        if part is not True and not visit.check.passes(item, part):
            yield from _mismatches(visit.inside(index, item, part))


# The keywords that lead to other schemas

_COMBINING = ("$ref", "allOf", "anyOf", "oneOf")
"""Keywords of a schema that may allow more fields than its own."""


def _enum(visit: _Visit) -> Iterator[Mismatch]:
    if not any(are_equal(visit.check.steps, visit.value, one) for one in visit.schema["enum"]):
        yield visit.wrong("enum", is_other_kind=True)


def _const(visit: _Visit) -> Iterator[Mismatch]:
    if not are_equal(visit.check.steps, visit.value, visit.schema["const"]):
        yield visit.wrong("const", is_other_kind=True)


def _any_of(visit: _Visit) -> Iterator[Mismatch]:
    alternatives: list[list[Mismatch]] = []
    for part in visit.schema["anyOf"]:
        alternatives.append(_some_mismatches(visit.by(part)))
        if not alternatives[-1]:
            return
    yield _none_fits(visit, alternatives)


def _one_of(visit: _Visit) -> Iterator[Mismatch]:
    alternatives = [_some_mismatches(visit.by(part)) for part in visit.schema["oneOf"]]
    fitting = alternatives.count([])
    if not fitting:
        yield _none_fits(visit, alternatives)
    elif fitting > 1:
        yield visit.wrong("oneOf")


def _some_mismatches(visit: _Visit) -> list[Mismatch]:
    return list(islice(_mismatches(visit), MAX_MISMATCHES))


def _none_fits(visit: _Visit, alternatives: list[list[Mismatch]]) -> Mismatch:
    is_tagged = "discriminator" in visit.schema and is_map(visit.value)
    is_other = not is_tagged and all(
        any(mismatch.excludes(visit.path) for mismatch in found) for found in alternatives
    )
    return Mismatch(
        visit.path, "anyOf", None, visit.value, visit.schema, tuple(alternatives), is_other
    )


def _all_of(visit: _Visit) -> Iterator[Mismatch]:
    for part in visit.schema["allOf"]:
        yield from _mismatches(visit.by(part, is_open=True))


def _not(visit: _Visit) -> Iterator[Mismatch]:
    if _fits(visit.by(visit.schema["not"], is_open=True)):
        yield visit.wrong("not")


def _property_names(visit: _Visit) -> Iterator[Mismatch]:
    if is_map(visit.value):
        names = visit.by(visit.schema["propertyNames"])
        for name in visit.value:
            yield from _mismatches(names._replace(value=str(name)))


COMBINATIONS: dict[str, Callable[[_Visit], Iterator[Mismatch]]] = {
    "enum": _enum,
    "const": _const,
    "propertyNames": _property_names,
    "anyOf": _any_of,
    "oneOf": _one_of,
    "allOf": _all_of,
    "not": _not,
}
