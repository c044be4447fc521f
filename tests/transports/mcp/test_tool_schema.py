"""The input schemas of tools."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fibaction import Action
from fibaction_transports.mcp.tools.tool_schema import tool_input


class Leaf(msgspec.Struct):
    x: int


class Tree(msgspec.Struct):
    """A tree."""

    leaves: list[Leaf]
    left: Tree | None = None


class Flat(msgspec.Struct):
    x: int = 1


class Either(msgspec.Struct, tag="either"):
    x: int


class Other(msgspec.Struct, tag="other"):
    y: int


def schema_of(goal: Any) -> dict[str, Any]:
    return Action("a", goal=goal, feedback=int, result=str).info.goal


def test_a_goal_with_fields_is_the_input_itself_and_may_have_no_others() -> None:
    made = tool_input(schema_of(Flat))
    assert made.schema == {
        "type": "object",
        "title": "Flat",
        "properties": {"x": {"type": "integer", "default": 1}},
        "required": [],
        "additionalProperties": False,
    }
    assert made.goal_in({"x": 2}) == {"x": 2}


def test_only_the_definitions_that_are_used_are_kept() -> None:
    made = tool_input(schema_of(Tree))
    assert made.schema["description"] == "A tree."
    assert set(made.schema["$defs"]) == {"Leaf", "Tree"}
    assert not made.is_wrapped
    unused = tool_input({"type": "object", "$defs": {"No": {"type": "null"}}})
    assert unused.schema == {"type": "object"}


@pytest.mark.parametrize("goal", [int, list[int], Either | Other, Any, int | None])
def test_any_other_goal_is_a_field_of_the_input(goal: Any) -> None:
    made = tool_input(schema_of(goal))
    assert made.schema["type"] == "object"
    assert list(made.schema["properties"]) == made.schema["required"] == ["goal"]
    assert made.goal_in({"goal": 5}) == 5
    assert made.goal_in({}) is None


def test_a_map_takes_any_names() -> None:
    made = tool_input(schema_of(dict[str, int]))
    assert made.schema == {"type": "object", "additionalProperties": {"type": "integer"}}


def test_a_reference_without_an_end_is_any_goal() -> None:
    schema = {"$ref": "#/$defs/A", "$defs": {"A": {"$ref": "#/$defs/A"}}}
    assert tool_input(schema).is_wrapped
    assert tool_input({"$ref": "#/$defs/Gone"}).schema["properties"]["goal"]["$ref"]
