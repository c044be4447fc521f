"""The input schema of a tool, made from the JSON Schema of a goal.

The input of a tool is always an object. A goal that is one is the input itself; any other goal, for
example a number, is the field `goal` of the input.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from fibaction.border.plain_values import is_list, is_map

GOAL = "goal"
"""The field of the input that a goal has which is not an object."""
_PREFIX = "#/$defs/"
_CHOICES = ("anyOf", "oneOf", "allOf")
"""Keywords that language models' interfaces do not take at the root of an input schema."""


class ToolInput(NamedTuple):
    """The input of a tool."""

    schema: dict[str, Any]
    is_wrapped: bool
    """True if the goal is the field `goal` of the input."""

    def goal_in(self, arguments: Mapping[str, Any]) -> Any:
        """Return the goal that the arguments of a call contain; None if it is missing."""
        return arguments.get(GOAL) if self.is_wrapped else dict(arguments)


def tool_input(goal: Mapping[str, Any]) -> ToolInput:
    """Return the input of a tool that sends goals of that schema."""
    definitions = goal.get("$defs", {})
    root = {name: part for name, part in goal.items() if name != "$defs"}
    body = _resolved(root, definitions)
    is_wrapped = body.get("type") != "object" or any(name in body for name in _CHOICES)
    schema: dict[str, Any]
    if is_wrapped:
        schema = {"type": "object", "properties": {GOAL: root}, "required": [GOAL]}
    else:
        schema = dict(body)
    if "properties" in schema:
        schema.setdefault("additionalProperties", False)
    if used := _used(schema, definitions):
        schema["$defs"] = used
    return ToolInput(schema, is_wrapped)


def _resolved(schema: dict[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema that a chain of references ends with; empty if it has no end."""
    for _ in range(len(definitions) + 1):
        reference = schema.get("$ref")
        if reference is None:
            return schema
        schema = definitions.get(str(reference).removeprefix(_PREFIX), {})
    return {}


def _used(schema: Any, definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the definitions that a schema refers to, also through others."""
    used: dict[str, Any] = {}
    todo = [schema]
    while todo:
        for reference in _references(todo.pop()):
            name = reference.removeprefix(_PREFIX)
            if name in definitions and name not in used:
                used[name] = definitions[name]
                todo.append(definitions[name])
    return {name: part for name, part in definitions.items() if name in used}


def _references(schema: Any) -> Iterator[str]:
    todo = [schema]
    while todo:
        part = todo.pop()
        if is_map(part):
            if isinstance(reference := part.get("$ref"), str):
                yield reference
            todo.extend(part.values())
        elif is_list(part):
            todo.extend(part)
