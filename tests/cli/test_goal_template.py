"""Templates of goals: a value for each field, and what is known of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from pydantic import BaseModel, Field

from fibaction.cli.arguments.goal_input import read_goal
from fibaction.cli.arguments.goal_template import GoalTemplate
from tests.cli.robot import Pick
from tests.support.fibonacci import Goal

ACTIONS = Path(__file__).parent.parent / "action_files"


class Tree(msgspec.Struct):
    left: Tree


class Model(BaseModel):
    meters: float = Field(gt=0, le=100, description="how far\nand more")
    kind: Literal["a"] = "a"
    photo: bytes
    level: Annotated[int, Field(ge=2)]


def test_each_field_has_its_default_or_an_empty_value_and_what_is_known_of_it() -> None:
    template = GoalTemplate(msgspec.json.schema(Pick))
    assert list(template.lines()) == [
        "object_name: ''  # text",
        "pose:  # optional",
        "  x: 0.0",
        "  y: 0.0",
        "  frame: map",
        "speed: 0.5  # a number, at most 1, more than 0, optional",
        "retries: 3  # a whole number, at least 0, at most 255, optional",
        'mode: careful  # one of "careful", "fast", optional',
        "tool: null  # optional",
        "waypoints: []  # a list, optional",
        "photo: ''  # bytes in base64, optional",
        "start: null  # text, optional",
        "tags: {}  # optional",
        "dry_run: false  # optional",
    ]


@pytest.mark.parametrize(
    ("schema", "line"),
    [
        ({"type": "integer", "minimum": 3}, "3"),
        ({"type": "object"}, "{}"),
        ({"$ref": "#/no"}, "{}"),
    ],
)
def test_a_goal_without_fields_is_one_line(schema: dict[str, Any], line: str) -> None:
    assert list(GoalTemplate(schema).lines()) == [line]


def test_the_template_is_a_goal_that_may_be_sent() -> None:
    for schema in (msgspec.json.schema(Pick), msgspec.json.schema(Goal), Model.model_json_schema()):
        template = GoalTemplate(schema)
        assert read_goal("\n".join(template.lines()), {}) == template.goal
    assert read_goal(GoalTemplate(msgspec.json.schema(Pick)).for_shell(), msgspec.json.schema(Pick))


def test_a_description_and_the_least_value_are_told() -> None:
    assert list(GoalTemplate(Model.model_json_schema()).lines()) == [
        "meters: 1  # a number, at most 100, more than 0: how far",
        "kind: a  # text, optional",
        "photo: ''  # text",
        "level: 2  # a whole number, at least 2",
    ]


def test_a_field_that_only_the_default_of_the_goal_has_is_told_as_it_is() -> None:
    schema = {"type": "object", "default": {"odd": 1}, "properties": {"a": {"type": "integer"}}}
    assert list(GoalTemplate(schema).lines()) == ["odd: 1"]


def test_a_field_with_a_format_or_without_a_schema_is_told_as_it_is() -> None:
    schema = {"properties": {"at": {"type": "string", "format": "date-time"}, "any": True}}
    assert list(GoalTemplate(schema).lines()) == [
        "at: '2026-01-31T12:00:00Z'  # date-time, optional",
        "any: {}",
    ]


def test_a_type_that_contains_itself_has_no_end_and_so_no_template() -> None:
    template = GoalTemplate(msgspec.json.schema(Tree))
    assert template.goal == {}
    assert template.for_shell() == "{}"


@pytest.mark.parametrize(
    "default",
    [
        "it's",
        "`x`",
        "$HOME",
        "a\nb",
        "*",
        "ü",
        "\\",
        "!!",
        "x" * 1000,
        b"x",
        msgspec.msgpack.Ext(1, b""),
    ],
)
def test_what_a_shell_could_change_is_not_completed(default: object) -> None:
    assert GoalTemplate({"properties": {"a": {"default": default}}}).for_shell() == ""
    assert GoalTemplate({"properties": {"it's": {"default": 1}}}).for_shell() == ""


def test_a_default_of_many_levels_is_not_completed() -> None:
    nested: Any = []
    for _ in range(100_000):
        nested = [nested]
    assert GoalTemplate({"properties": {"a": {"default": nested}}}).for_shell() == ""
