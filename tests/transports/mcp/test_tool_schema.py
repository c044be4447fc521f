"""The schemas of tools."""

from __future__ import annotations

from typing import Any

import jsonschema
import msgspec
import pytest

from fibaction import Action
from fibaction_transports.mcp.tool_list import tool_input, tool_output


class Leaf(msgspec.Struct):
    x: int


class Tree(msgspec.Struct):
    """A tree."""

    leaves: list[Leaf]
    left: Tree | None = None


class Empty(msgspec.Struct):
    """Go home."""


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
    assert made.goal_in({}) == {}


@pytest.mark.parametrize("goal", [None, Empty])
def test_an_action_without_a_goal_has_an_input_without_fields(goal: Any) -> None:
    made = tool_input(schema_of(goal))
    assert made.schema == {"type": "object", "additionalProperties": False}
    assert made.goal_in({}) == {}


def test_a_map_takes_any_names() -> None:
    made = tool_input(schema_of(dict[str, int]))
    assert made.schema == {"type": "object", "additionalProperties": {"type": "integer"}}


def test_a_reference_without_an_end_is_any_goal() -> None:
    schema = {"$ref": "#/$defs/A", "$defs": {"A": {"$ref": "#/$defs/A"}}}
    assert tool_input(schema).is_wrapped
    assert tool_input({"$ref": "#/$defs/Gone"}).schema["properties"]["goal"]["$ref"]


# The output


def output_of(result: Any) -> dict[str, Any]:
    made = tool_output(schema_of(result), ["SUCCEEDED", "ABORTED"])
    jsonschema.Draft202012Validator.check_schema(made)
    return made


def test_the_output_tells_about_the_goal_and_has_the_result() -> None:
    made = output_of(Tree)
    validator = jsonschema.Draft202012Validator(made)
    result = {"leaves": [{"x": 1}], "left": {"leaves": []}}
    assert validator.is_valid({"goal_id": "a", "status": "SUCCEEDED", "result": result})
    assert validator.is_valid({"goal_id": "a", "status": "ABORTED", "reason": "why"})
    assert validator.is_valid({"error": "JSON cannot express it"})
    assert not validator.is_valid({"result": {"leaves": [{"x": "1"}]}})
    assert not validator.is_valid({"status": "RUNNING"})
    assert set(made["$defs"]) == {"Leaf", "Tree"}
    assert "$defs" not in output_of(int)


def test_a_number_may_be_null_which_json_has_in_place_of_nan() -> None:
    made = output_of(dict[str, list[float]])
    assert jsonschema.Draft202012Validator(made).is_valid({"result": {"a": [1.5, None]}})
    assert not jsonschema.Draft202012Validator(made).is_valid({"result": {"a": ["1"]}})


@pytest.mark.parametrize("reference", ["#", "#/properties/a", "https://else/where", "#/$defs/No"])
def test_a_schema_that_refers_to_something_outside_of_it_allows_everything(reference: str) -> None:
    part = {"type": "object", "properties": {"a": {"$ref": reference}}}
    made = tool_output(part, ["SUCCEEDED"])
    assert made["properties"]["result"] == {}
    nested = tool_output({"$ref": "#/$defs/A", "$defs": {"A": part}}, ["SUCCEEDED"])
    assert nested["properties"]["result"] == {}
    assert "$defs" not in nested
