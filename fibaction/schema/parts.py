"""The parts of a JSON Schema, prepared for checks: see `fibaction.schema.check`."""

from __future__ import annotations

import base64
from collections.abc import Collection, Sequence
from typing import Any, TypeAlias

from fibaction.schema.check import (
    CONTAINERS,
    MAX_DEPTH,
    MAX_NESTING,
    Check,
    CheckSteps,
    EnoughMismatches,
    Extent,
    JsonSchema,
    Mismatch,
    SchemaError,
    are_equal,
    only_value,
    text_steps,
)
from fibaction.schema.keywords import (
    COMBINATIONS,
    COMPARISONS,
    IN_JSON,
    PYTHON_TYPES,
    Comparison,
    bytes_of,
    false,
    in_json,
    is_of_type,
    size_in_bytes,
)
from fibaction.words.plain_data import is_list, is_map

MAX_LEVELS = 10
"""Alternatives within each other whose types are known before they are visited."""

_NONE: frozenset[type] = frozenset()
_ALTERNATIVES = {"anyOf", "oneOf"}
_OPENING = {"if", "then", "else", "dependentSchemas", "unevaluatedProperties"}
"""Keywords that may describe fields, and are not checked themselves."""
_DESCRIBING = {"properties", "$ref", "allOf", *_ALTERNATIVES, *_OPENING}
"""Keywords that may describe fields; with several of them, none says which fields there are."""

_Test: TypeAlias = tuple[str, Comparison, Any]
"""A keyword, its comparison, and the value of the keyword."""


CHECKED = {
    *("type", "contentEncoding", "required", "properties", "additionalProperties"),
    *("patternProperties", "items", "prefixItems"),
    *(*COMBINATIONS, *_OPENING),
    *(word for words in COMPARISONS.values() for word in words),
}
"""All keywords that have an effect."""


class SchemaParts:
    """The parts of one schema, which are made when they are needed first."""

    def __init__(self, schema: JsonSchema) -> None:
        self._schema = schema
        self._known: dict[int, SchemaPart] = {}
        self.steps = CheckSteps(Extent.of(schema.root).size)
        """The steps of the checks of all defaults together."""
        self.root = self.of(schema.root)

    def of(self, schema: Any, levels: int = 0) -> SchemaPart:
        """Return the part for a schema; `levels` is the number of alternatives around it."""
        while is_map(schema) and schema.keys() & CHECKED == {"$ref"}:
            schema = self._schema.target(schema["$ref"])
        part = self._known.get(id(schema))
        if part is None:
            # It is known before its alternatives are, which may lead back to it.
            part = self._known[id(schema)] = SchemaPart(schema, self)
            if levels < MAX_LEVELS:
                part.learn_types(levels + 1)
        return part

    def target(self, reference: str) -> SchemaPart:
        """Return the part that a reference names."""
        return self.of(self._schema.target(reference))


class SchemaPart:
    """One schema, prepared."""

    plain: frozenset[type] = _NONE
    """The types of which each value is sent as it is."""
    kinds: frozenset[type] | None = None
    """The types of JSON that a value must have to fit; None if they are not known."""

    def __init__(self, schema: Any, parts: SchemaParts) -> None:
        self.schema: dict[str, Any] = schema if is_map(schema) else {}
        self._parts = parts
        words = self.schema.keys() & CHECKED
        self.is_any = not words and schema is not False
        """True if each value is sent as it is."""
        self._compares = bool(words - COMBINATIONS.keys())
        known = self.schema.get("properties", {})
        self._cost = 1 + len(self.schema.get("required", ())) + len(known) // 10
        combines = [combine for word, combine in COMBINATIONS.items() if word in words]
        self._combines = [false] if schema is False else combines
        closed = self.schema.get("unevaluatedProperties") is False
        self._is_open = len(words & _DESCRIBING) - closed > 1
        self._is_base64 = self.schema.get("contentEncoding") == "base64"
        kinds: Any = self.schema.get("type", ())
        self._names: list[str] = list(kinds) if is_list(kinds) or not kinds else [kinds]
        self._is_whole = "integer" in self._names and "number" not in self._names
        values = self.schema.get("enum", ())
        is_texts = bool(values) and {str}.issuperset(map(type, values))
        self.texts = frozenset(values) if is_texts else None
        """The values of `enum`, if they are texts."""
        is_alone = is_texts and words <= {"enum", "type"} and self._names in ([], ["string"])
        self._usual = frozenset(values) if is_alone else frozenset[str]()
        only = ((name, only_value(part)) for name, part in known.items())
        self.tags = {name: one[0] for name, one in only if one is not None}
        """The fields that can have one value only."""
        self._is_special = self._is_whole or self._is_base64
        self._tests: dict[type, list[_Test]] = {}
        self._fields: dict[bool, _Fields] = {}
        self._items: tuple[list[SchemaPart], SchemaPart] | None = None
        self._likely: dict[tuple[str, type], list[SchemaPart]] = {}
        self._by_tag: dict[str, tuple[str, dict[Any, SchemaPart]]] = {}

    def learn_types(self, levels: int) -> None:
        """Find out which values are plain, and which may fit."""
        words = self.schema.keys() & CHECKED
        if "type" in words and PYTHON_TYPES.keys() >= set(self._names):
            kinds = _NONE.union(*(PYTHON_TYPES[name] for name in self._names))
            self.kinds = kinds | ({float} if int in kinds else _NONE)
            if self._is_base64:
                self.kinds |= {list}
            if not self._combines:
                scalars = kinds - CONTAINERS - ({str} if self._is_base64 else _NONE)
                self.plain = frozenset(kind for kind in scalars if not self._tests_of(kind))
        elif len(words) == 1 and words <= _ALTERNATIVES:
            (alternatives,) = (self.schema[word] for word in words)
            parts = [self._parts.of(part, levels) for part in alternatives]
            known = [part.kinds for part in parts if part.kinds is not None]
            if len(known) == len(parts):
                self.kinds = _NONE.union(*known)
                plain = (kind for part in parts for kind in part.plain)
                self.plain = frozenset(
                    kind for kind in plain if sum(kind in kinds for kinds in known) == 1
                )
        elif self.texts is not None:
            self.kinds = PYTHON_TYPES["string"]

    def visit(self, check: Check, value: Any, nesting: int = 0, *, is_open: bool = False) -> Any:
        """Return a value as it is sent, and note where it does not match.

        `nesting` counts the schemas around this one; with `is_open`, others describe more fields.

        Raises:
            EnoughMismatches: There are so many that the rest is not looked for.
            SchemaError: The check takes too many steps, or nests too deeply.
        """
        kind: type[Any] = value.__class__  # an exact type: the data is plain
        if kind is dict:
            if self._combines:
                value = self._combined(check, value, nesting, is_open)
            return self._map(check, value, nesting, is_open) if self._compares else value
        if self.is_any or (kind is str and value in self._usual):
            return value
        if kind is list and self._is_base64:
            check.steps.spend(len(value))
            value = bytes_of(value)
        compared = in_json(value)
        check.steps.spend(self._cost + text_steps(compared))
        kind = compared.__class__
        self._compare(check, compared, self._tests.get(kind) or self._tests_of(kind))
        if self._combines:
            value = self._combined(check, value, nesting, is_open)
        if is_list(value):
            return self._list(check, value, nesting)
        return self._scalar(check, value) if self._is_special else value

    def tried(
        self, check: Check, value: Any, nesting: int = 0, *, is_open: bool = False
    ) -> tuple[Any, list[Mismatch]]:
        """Return a value as it is sent, and its mismatches, which are not noted at the check."""
        outer, depth, count = check.found, len(check.path), len(check.left_out or ())
        check.found = found = list[Mismatch]()
        made = value
        try:
            made = self.visit(check, value, nesting, is_open=is_open)
        except EnoughMismatches:
            del check.path[depth:]
        finally:
            check.found = outer
        if found and check.left_out is not None:
            del check.left_out[count:]
        return made, found

    def _combined(self, check: Check, value: Any, nesting: int, is_open: bool) -> Any:
        if nesting > MAX_NESTING:
            raise SchemaError(f"nests deeper than {MAX_NESTING} levels for one value")
        check.steps.spend(self._cost)
        for combine in self._combines:
            value = combine(self, check, value, nesting + 1, is_open or self._is_open)
        return value

    def _compare(self, check: Check, value: Any, tests: list[_Test]) -> None:
        for word, holds, expected in tests:
            if not holds(value, expected):
                check.note(self.schema, word, value, expected, is_other_kind=word == "type")

    def _tests_of(self, kind: type) -> list[_Test]:
        """Return the comparisons that a value of a type can fail."""
        tests = self._tests.get(kind)
        if tests is None:
            schema, words = self.schema, COMPARISONS.get(kind, {})
            tests = [(one, words[one], schema[one]) for one in words if one in schema]
            if not any(kind in PYTHON_TYPES.get(name, {kind}) for name in self._names):
                tests[:0] = [("type", is_of_type, schema["type"])] if "type" in schema else []
            self._tests[kind] = tests
        return tests

    def _scalar(self, check: Check, value: Any) -> Any:
        if type(value) is float and self._is_whole and value.is_integer():
            return int(value)  # JSON Schema accepts 3.0 as a whole number, decoders do not
        if type(value) is str and self._is_base64:
            try:
                return base64.b64decode(value, validate=True)
            except ValueError:
                check.note(self.schema, "contentEncoding", value, "base64")
        return value

    def _list(self, check: Check, value: Collection[Any], nesting: int) -> Any:
        check.steps.spend(len(value))
        if self._items is None:
            part = self.schema.get("items", True)
            first = [self._parts.of(part) for part in self.schema.get("prefixItems", ())]
            self._items = first, self._parts.of(True if part is False else part)
        first, rest = self._items
        if self.schema.get("items") is False and len(value) > len(first):
            check.note(self.schema, "maxItems", value, len(first))
        if not first and (rest.is_any or rest.plain.issuperset(map(type, value))):
            return value
        made: list[Any] = []
        check.path.append(0)
        for index, item in enumerate(value):
            part = first[index] if index < len(first) else rest
            if type(item) in part.plain:
                made.append(item)
            else:
                check.path[-1] = index
                made.append(part.visit(check, item, nesting + 1))
        check.path.pop()
        return made

    def _map(self, check: Check, value: dict[Any, Any], nesting: int, is_open: bool) -> Any:
        fields = self._fields.get(check.fills)
        if fields is None:
            fields = _Fields(self.schema, self._parts, self._tests_of(dict), fills=check.fills)
            self._fields[check.fills] = fields
        if fields.odd:
            value = fields.with_odd(value)
        check.steps.spend(self._cost + fields.cost + len(value))
        if not value and fields.empty is not None and check.left_out is None:
            check.steps.fill(fields.size)
            return fields.empty
        made = fields.template.copy()
        made.update(value)
        parts, rest = fields.parts, fields.rest
        if len(made) > len(fields.template):
            if not {str}.issuperset(map(type, value)):
                parts = parts | {name: parts[str(name)] for name in value if str(name) in parts}
            is_open = fields.may_be_open and (is_open or self._is_open)
            is_closed = rest is None and not is_open
            if is_closed and not parts.keys() >= value.keys():
                check.note(self.schema, "additionalProperties", value, list(fields.template))
        if fields.needed and not fields.needed <= value.keys():
            defaults = {name: fields.template[name] for name in fields.sizes}
            check.note(self.schema, "required", defaults | value, self.schema["required"])
        filled, sizes, path = fields.size, fields.sizes, check.path
        if check.left_out is not None:
            check.left_out += [(*path, name) for name in fields.bare if name not in value]
        for name, item in value.items():
            part = parts.get(name) or rest
            if name in sizes:
                filled -= sizes[name]
            if part is not None and type(item) not in part.plain:
                path.append(str(name))
                made[name] = part.visit(check, item, nesting + 1)
                path.pop()
        if filled:
            check.steps.fill(filled)
        if len(made) > len(value):  # otherwise no field is missing
            for name in fields.bare:
                if name not in value:
                    del made[name]
        if fields.tests:
            self._compare(check, made, fields.tests)
        if not (value or check.found):
            fields.empty = made
        return made

    # Alternatives

    def likely(self, check: Check, keyword: str, value: Any) -> Sequence[SchemaPart]:
        """Return the alternatives of a keyword that a value may fit, which is fast to tell."""
        kind: type[Any] = value.__class__ if value.__class__ in IN_JSON else str
        likely = self._likely.get((keyword, kind))
        if likely is None:
            parts = self.alternatives(keyword)
            likely = [one for one in parts if one.kinds is None or kind in one.kinds]
            if kind is dict:
                self._by_tag[keyword] = _by_tag(likely)
            self._likely[keyword, kind] = likely
        if kind is dict:
            name, by_tag = self._by_tag[keyword]
            tag = value.get(name)
            if type(tag) is str and tag in by_tag:
                return [by_tag[tag]]
        if kind in (dict, float) and len(likely) > 1:
            check.steps.spend(len(likely))
            likely = [one for one in likely if one.may_fit(check, value)]
        return likely

    def alternatives(self, keyword: str) -> Sequence[SchemaPart]:
        """Return the parts of a keyword with a list of schemas."""
        return [self._parts.of(part) for part in self.schema[keyword]]

    def may_fit(self, check: Check, value: Any) -> bool:
        """Return whether a number, or a map with its tags, may fit."""
        if type(value) is float:
            return not self._is_whole or value.is_integer()
        return all(
            name not in value or are_equal(check.steps, value[name], only)
            for name, only in self.tags.items()
        )

    def inner(self, keyword: str) -> SchemaPart:
        """Return the part of a keyword with a schema."""
        return self._parts.of(self.schema[keyword])

    def target(self) -> SchemaPart:
        """Return the part that the reference names."""
        return self._parts.target(self.schema["$ref"])


def _by_tag(parts: list[SchemaPart]) -> tuple[str, dict[Any, SchemaPart]]:
    """Return the field that tells maps apart, with the part for each text of it; empty if none."""
    for name in parts[0].tags if parts else ():
        found = {one.tags[name]: one for one in parts if type(one.tags.get(name)) is str}
        if len(found) == len(parts):
            return name, found
    return "", {}


class _Fields:
    """The fields of a map."""

    def __init__(
        self, schema: dict[str, Any], parts: SchemaParts, tests: list[_Test], *, fills: bool
    ) -> None:
        known: dict[str, Any] = schema.get("properties", {})
        self.tests = tests
        """The comparisons of the map with its defaults."""
        self.parts: dict[Any, SchemaPart] = {name: parts.of(part) for name, part in known.items()}
        # A server may ignore unknown fields, but the author of one expects it to have an effect.
        rest = schema.get("additionalProperties", "properties" not in schema)
        if "patternProperties" in schema:
            rest = True  # the names that it allows are not known
        self.rest = None if rest is False else parts.of(rest)
        """The part for other fields; None if there are no others."""
        self.may_be_open = "additionalProperties" not in schema
        """True if other schemas may allow other fields."""
        self.template: dict[str, Any] = dict.fromkeys(known)
        """The default of each field; None if it has none."""
        self.sizes: dict[str, int] = {}
        """The bytes of each default."""
        self.odd: dict[str, Any] = {}
        """The defaults that are not of their types; they are checked like given values."""
        for name, part in known.items():
            if fills and is_map(part) and "default" in part:
                made = _default(self.parts[name], part["default"], parts.steps)
                if made is None:
                    self.odd[name] = part["default"]
                else:
                    (self.template[name],) = made
                    self.sizes[name] = size_in_bytes({name: part["default"]})
        self.needed = frozenset(schema.get("required", ())) - self.sizes.keys() - self.odd.keys()
        """The fields that a value must have."""
        self.size = sum(self.sizes.values())
        self.bare = [name for name in known if name not in self.sizes]
        """The fields without a default."""
        self.cost = len(self.bare)
        """The steps of each map."""
        self.empty: dict[str, Any] | None = None
        """The map that an empty one is sent as, once there was one."""

    def with_odd(self, value: dict[Any, Any]) -> dict[Any, Any]:
        """Return a map with the odd defaults that it needs.

        Raises:
            SchemaError: One of them nests too deeply.
        """
        missing = {name: default for name, default in self.odd.items() if name not in value}
        if Extent.of(missing).levels > MAX_DEPTH + 1:
            raise SchemaError(f"has a default that nests deeper than {MAX_DEPTH} levels")
        return missing | value


def _default(part: SchemaPart, default: Any, steps: CheckSteps) -> tuple[Any] | None:
    """Return a default as it is sent, in a tuple; None if it is not of its type."""
    extent = Extent.of(default)
    if extent.levels > MAX_DEPTH:
        return None
    check = Check(fills=False)
    check.steps = steps
    try:
        made, found = part.tried(check, default)
    except (SchemaError, TypeError, ValueError, OverflowError):
        return None
    return None if found else (made,)
