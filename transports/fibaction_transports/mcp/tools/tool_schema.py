"""The schemas of a tool, made from the JSON Schemas of a goal and of a result.

The input of a tool is always an object. A goal that is one is the input itself; any other goal, for
example a number, is the field `goal` of the input. The output tells about the goal, and has the
result as the field `result`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
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


def tool_output(result: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the schema of what a tool answers for an action with results of that schema.

    `names` are those of the statuses. No field is required: a goal that still runs has no result,
    and an answer that is too long has only its beginning.
    """
    definitions = result.get("$defs", {})
    root = {name: part for name, part in result.items() if name != "$defs"}
    used = _used(root, definitions)
    known = {f"{_PREFIX}{name}" for name in used}
    if not known.issuperset(_references([root, used])):
        root, used = {}, {}  # it refers to itself as a whole, or to something outside
    schema: dict[str, Any] = {
        "type": "object",
        "properties": {
            "goal_id": {"type": "string"},
            "action": {"type": "string"},
            "status": {"enum": list(names)},
            "result": _with_nulls(root),
            "reason": {"type": "string"},
            "feedback_count": {"type": "integer"},
            "feedback": {},
        },
    }
    return schema | ({"$defs": _with_nulls(used)} if used else {})


def _with_nulls(part: Any) -> Any:
    """Return a schema that allows null for each number: NaN and infinities are null in JSON."""
    if is_list(part):
        return [_with_nulls(one) for one in part]
    if not is_map(part):
        return part
    made = {name: _with_nulls(one) for name, one in part.items()}
    return made | {"type": ["number", "null"]} if part.get("type") == "number" else made


def _resolved(schema: dict[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema that a chain of references ends with; empty if it has no end."""
    for _ in range(len(definitions) + 1):
        reference = schema.get("$ref")
        if reference is None:
            return schema
        schema = definitions.get(str(reference).removeprefix(_PREFIX), {})
    return {}


def _used(schema: Any, definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the definitions that a schema refers to, even through others."""
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
