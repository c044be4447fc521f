"""TypeScript declarations of the types of actions, made of their JSON Schemas.

A goal may leave out fields that have defaults; feedback and results arrive with all of them. So a
type that is used in both directions, and that has such fields, is declared twice: as it is sent,
with `Input` after its name, and as it is received.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Set
from itertools import chain, count
from typing import Any, TypeAlias

from fibaction.types.action import ActionInfo
from fibaction.words.plain_data import is_list, is_map

Schema: TypeAlias = Any
"""A JSON Schema: a dict, or True or False."""

MOST_SAFE = 2**53 - 1
"""Largest integer that a JavaScript `number` holds exactly; the client reads larger ones as
`bigint`."""
REFERENCE = "#/$defs/"
SIMPLE = {"string": "string", "number": "number", "boolean": "boolean", "null": "null"}

HEADER = """\
// The types of actions, by `fibaction gen --ts`. For example:
//
//     const connection = new Connection<Actions>("ws://127.0.0.1:8080");
//     const goal = await connection.sendGoal({name}, {{ ... }});
"""


def typescript_source(actions: Iterable[ActionInfo]) -> str:
    """Return a TypeScript module with the types of these actions.

    It has an interface for each type that has a name, one for each action with its `goal`,
    `feedback` and `result`, as the JavaScript client wants it, and `Actions`, which finds that by
    the action's name. A part that no schema describes is `unknown`.

    Raises:
        ValueError: There are no actions.
    """
    chosen = sorted(actions, key=lambda info: info.name)
    if not chosen:
        raise ValueError("there are no actions to write types of")
    module = _Module()
    entries = [(info.name, module.add(info)) for info in chosen]
    index = [f"  {json.dumps(name)}: {interface};" for name, interface in entries]
    actions_text = "\n".join(
        ["/** The types of each action, by its name. */", "export interface Actions {", *index, "}"]
    )
    return "\n".join(
        [HEADER.format(name=json.dumps(chosen[0].name)), *module.texts(), actions_text, ""]
    )


class _Module:
    """The declarations of a module, each under a name of its own."""

    def __init__(self) -> None:
        self._declared: dict[str, str] = {}
        self._owners: dict[str, object] = {"Actions": None}

    def texts(self) -> Iterator[str]:
        for text in self._declared.values():
            yield f"{text}\n"

    def add(self, info: ActionInfo) -> str:
        """Declare the types of an action, and return the name of its interface."""
        stem = _identifier(info.name)
        received = _defs(info.feedback).keys() | _defs(info.result).keys()
        parts = {
            "goal": _Part(self, stem, info.goal, received).type,
            "feedback": _Part(self, stem, info.feedback).type,
            "result": _Part(self, stem, info.result).type,
        }
        fields = [f"  {name}: {text};" for name, text in parts.items()]
        name = self.name(f"{stem}Action", stem, info)
        doc = _comment(f"The action `{info.name}`. {info.description}")
        lines = [f"/** {doc} */", f"export interface {name} {{"]
        self.declare(name, "\n".join([*lines, *fields, "}"]))
        return name

    def name(self, wanted: str, stem: str, owner: object) -> str:
        """Return the name of a type: the one that is wanted, unless another type has it."""
        candidates = chain((wanted, f"{stem}{wanted}"), (f"{stem}{wanted}{n}" for n in count(2)))
        return next(one for one in candidates if self._owners.setdefault(one, owner) == owner)

    def declare(self, name: str, text: str) -> None:
        """Add the declaration of a type."""
        self._declared[name] = text


class _Part:
    """The type of a goal, of feedback or of a result."""

    def __init__(
        self, module: _Module, stem: str, schema: Schema, received: Set[str] | None = None
    ) -> None:
        """Declare what a part needs. `received` is for a goal: the named types of the others."""
        self._module = module
        self._stem = stem
        self._received = received
        self._defs = _defs(schema)
        self._names: dict[str, str] = {}
        self.type = self._type(schema)
        """The type as TypeScript."""

    def _type(self, schema: Schema) -> str:
        if not is_map(schema):
            return "unknown"
        if reference := schema.get("$ref"):
            return self._named(str(reference).removeprefix(REFERENCE))
        if "const" in schema:
            return _literal(schema["const"])
        if "enum" in schema:
            return _union(_literal(value) for value in schema["enum"])
        for key in ("anyOf", "oneOf"):
            if key in schema:
                return _union(self._type(one) for one in schema[key])
        if "allOf" in schema:
            return " & ".join(_grouped(self._type(one)) for one in schema["allOf"])
        kinds = schema.get("type", "object" if "properties" in schema else "")
        if is_list(kinds):
            return _union(self._of_kind(kind, schema) for kind in kinds)
        return self._of_kind(kinds, schema)

    def _of_kind(self, kind: str, schema: dict[str, Any]) -> str:
        if kind == "integer":
            bounds = (schema.get(key, 0) for key in ("minimum", "maximum", "default"))
            return "number" if all(abs(one) <= MOST_SAFE for one in bounds) else "number | bigint"
        if kind == "string" and schema.get("contentEncoding") == "base64":
            return "Uint8Array"
        if kind == "array":
            return self._array(schema)
        if kind == "object":
            return self._object(schema)
        return SIMPLE.get(kind, "unknown")

    def _array(self, schema: dict[str, Any]) -> str:
        if items := schema.get("prefixItems"):
            return f"[{', '.join(self._type(item) for item in items)}]"
        return f"{_grouped(self._type(schema.get('items')))}[]"

    def _object(self, schema: dict[str, Any]) -> str:
        if "properties" not in schema:
            return f"Record<string, {self._type(schema.get('additionalProperties'))}>"
        if not schema["properties"]:
            return "Record<string, never>"
        return "\n".join(["{", *self._fields(schema), "}"])

    def _fields(self, schema: dict[str, Any]) -> Iterator[str]:
        required = schema.get("required", ())
        for name, field in schema["properties"].items():
            described = self._described(field)
            if described:
                yield f"  /** {described} */"
            key = name if re.fullmatch(r"[A-Za-z_$][\w$]*", name) else json.dumps(name)
            mark = "?" if self._received is not None and name not in required else ""
            yield f"  {key}{mark}: {self._type(field)};".replace("\n", "\n  ")

    @staticmethod
    def _described(field: Schema) -> str:
        """Return a field's description, with its unit if it has one."""
        if not is_map(field):
            return ""
        unit = field.get("x-unit", "")
        parts = (str(field.get("description", "")), f"Unit: {unit}." if unit else "")
        return _comment(" ".join(filter(None, parts)))

    def _named(self, reference: str) -> str:
        """Declare the type of a reference, and return its name."""
        if reference in self._names:
            return self._names[reference]
        if not is_map(definition := self._defs.get(reference)):
            return "unknown"
        family: dict[str, Schema] = {reference: definition}
        self._gather(definition, family)
        is_sent = self._received is not None and _has_optional_fields(list(family.values()))
        is_twice = is_sent and reference in (self._received or ())
        name = f"{_identifier(reference)}{'Input' if is_twice else ''}"
        name = self._module.name(name, self._stem, (is_sent, family))
        self._names[reference] = name  # before its own fields: it may contain itself
        text = self._type(definition)
        doc = self._described(definition)
        head = f"/** {doc} */\nexport" if doc else "export"
        is_object = bool(definition.get("properties"))
        body = f"interface {name} {text}" if is_object else f"type {name} = {text};"
        self._module.declare(name, f"{head} {body}")
        return name

    def _gather(self, schema: Schema, family: dict[str, Schema]) -> None:
        """Add all named types that a schema needs."""
        for part in _parts(schema):
            reference = str(part.get("$ref", "")).removeprefix(REFERENCE)
            if reference in self._defs and reference not in family:
                family[reference] = self._defs[reference]
                self._gather(self._defs[reference], family)


def _defs(schema: Schema) -> dict[str, Schema]:
    return schema.get("$defs", {}) if is_map(schema) else {}


def _parts(schema: Schema) -> Iterator[dict[str, Any]]:
    """Yield a schema and all schemas inside of it."""
    if is_map(schema):
        yield schema
        yield from _parts(list(schema.values()))
    elif is_list(schema):
        for one in schema:
            yield from _parts(one)


def _has_optional_fields(schemas: list[Schema]) -> bool:
    return any(
        part.get("properties", {}).keys() - set(part.get("required", ()))
        for part in _parts(schemas)
        if isinstance(part.get("properties", {}), dict)
    )


def _identifier(name: str) -> str:
    """Return a name as TypeScript writes types: `arm/pick_up` is ArmPickUp."""
    words = re.findall(r"[A-Za-z0-9]+", name)
    text = "".join(word[0].upper() + word[1:] for word in words) or "Unnamed"
    return f"_{text}" if text[0].isdigit() else text


def _literal(value: Any) -> str:
    return json.dumps(value)


def _union(types: Iterable[str]) -> str:
    return " | ".join(dict.fromkeys(types))


def _grouped(text: str) -> str:
    is_simple = re.fullmatch(r"[\w$]+|\{[^{}]*\}", text)
    return text if is_simple else f"({text})"


def _comment(text: str) -> str:
    """Return a text for a comment on one line, which it cannot end."""
    return " ".join(text.split()).replace("*/", "* /")
