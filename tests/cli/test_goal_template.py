"""Templates of goals: a value for each field, and what is known of it."""

from __future__ import annotations

import math
import random
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from pydantic import BaseModel, Field

from fibaction.action_files import load_action
from fibaction.cli.arguments.goal_input import read_goal
from fibaction.cli.arguments.goal_template import MAX_PARTS, GoalTemplate
from fibaction.types.schemas import schema_of
from tests.cli.robot import Pick
from tests.support.fibonacci import Goal

ACTIONS = Path(__file__).parent.parent / "action_files"
_NUMBERS = count()


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


@pytest.mark.parametrize(
    ("schema", "goal"),
    [
        ({}, {}),
        ({"type": "integer"}, 0),
        ({"type": ["boolean", "null"]}, False),
        ({"type": []}, None),
        ({"type": "array", "prefixItems": [{"type": "integer"}, {"type": "string"}]}, [0, ""]),
        ({"type": "string", "format": "date"}, "2026-01-31"),
        ({"type": "string", "format": "unheard-of"}, ""),
        ({"anyOf": [{"type": "null"}, {"type": "integer", "minimum": 3}]}, 3),
        ({"oneOf": [{"type": "null"}]}, None),
        ({"const": 7}, 7),
        ({"type": "array", "items": {"type": "number"}, "minItems": 2}, [0.0, 0.0]),
        ({"type": "array", "prefixItems": [{"const": 1}], "minItems": 2}, [1, {}]),
        ({"type": "array", "minItems": MAX_PARTS}, {}),
        ({"type": "string", "minLength": 2}, "xx"),
        ({"type": "string", "minLength": 10_000}, {}),
        ({"type": "string", "contentEncoding": "base64", "minLength": 4}, "AAAA"),
        ({"type": "number", "exclusiveMinimum": 0, "maximum": 1}, 0.5),
        ({"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 4}, 1),
        ({"type": "integer", "exclusiveMinimum": 0, "maximum": 1}, 1),
        ({"type": "number", "exclusiveMinimum": 3}, 4),
        ({"type": "integer", "maximum": -2}, -2),
        ({"type": "integer", "exclusiveMaximum": 0}, -1),
        ({"$ref": "#/$defs/A", "$defs": {"A": {"enum": ["on", "off"]}}}, "on"),
        ({"$ref": "#/$defs/A", "$defs": {"A": {"default": 5}}}, 5),
        ({"properties": {"a": True, "b": {"default": [1]}}}, {"a": {}, "b": [1]}),
        ({"$ref": "http://evil/schema"}, {}),
        ({"properties": 7}, {}),
    ],
)
def test_a_schema_of_any_form_has_a_template(schema: Any, goal: object) -> None:
    template = GoalTemplate(schema)
    assert template.goal == goal
    assert list(template.lines())


def _random_type(chance: random.Random, depth: int) -> Any:
    """Return a random type: a primitive, with or without limits, or made of other types."""
    simple: list[Any] = [
        int,
        str,
        bool,
        bytes,
        None,
        Literal["a", 3],
        Annotated[int, msgspec.Meta(gt=0)],
        Annotated[int, msgspec.Meta(lt=0)],
        Annotated[float, msgspec.Meta(gt=0, le=1)],
        Annotated[float, msgspec.Meta(ge=2.5)],
        Annotated[str, msgspec.Meta(min_length=3)],
        Annotated[bytes, msgspec.Meta(min_length=3)],
    ]
    if depth == 0 or chance.random() < 0.3:
        return chance.choice(simple)
    inner = _random_type(chance, depth - 1)
    lists: Any = list  # type checkers reject types that are known at run time only
    maps: Any = dict
    tuples: Any = tuple
    sized: Any = Annotated[lists[inner], msgspec.Meta(min_length=2, max_length=3)]
    made: list[Any] = [lists[inner], maps[str, inner], tuples[inner, int], sized]
    if inner is not None:
        made.append(inner | None)
    made.append(_random_struct(chance, depth - 1))
    tagged = [_random_struct(chance, depth - 1, tag=name) for name in ("left", "right")]
    made.append(tagged[0] | tagged[1])
    return chance.choice(made)


def _random_struct(chance: random.Random, depth: int, tag: str | None = None) -> Any:
    fields: list[Any] = []
    for number in range(chance.randint(0, 4)):
        kind = _random_type(chance, depth)
        with_default: list[Any] = [(), (msgspec.field(default_factory=lambda: [1]),)]
        kind, default = chance.choice([(kind, ()), (kind, ()), (list[int], with_default[1])])
        fields.append((f"field{number}", kind, *default))
    return msgspec.defstruct(f"Random{next(_NUMBERS)}", fields, kw_only=True, tag=tag)


@pytest.mark.parametrize("seed", range(100))
def test_the_template_of_a_random_struct_is_a_goal_of_it(seed: int) -> None:
    kind = _random_struct(random.Random(seed), 3)
    template = GoalTemplate(schema_of(kind))
    assert isinstance(msgspec.json.decode(msgspec.json.encode(template.goal), type=kind), kind)


@pytest.mark.parametrize("path", sorted(ACTIONS.rglob("*.action")), ids=lambda path: path.stem)
def test_the_template_of_an_action_file_is_a_goal_of_it(path: Path) -> None:
    kind = load_action(path, search=[ACTIONS]).goal.type
    template = GoalTemplate(schema_of(kind)).goal
    assert msgspec.convert(template, kind, builtin_types=()) == kind()


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


def test_the_work_for_a_hostile_schema_is_limited() -> None:
    part: dict[str, Any] = {"type": "integer"}
    for _ in range(20):
        part = {"anyOf": [part]}
    assert GoalTemplate(part).goal == {}
    wide: dict[str, Any] = {"properties": {f"a{number}": {} for number in range(MAX_PARTS)}}
    assert GoalTemplate(wide).goal == {}


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


@pytest.mark.parametrize(
    "endless", [{"type": "array", "minItems": math.inf}, {"type": "string", "minLength": math.inf}]
)
def test_of_a_goal_of_endless_length_there_is_an_empty_template(endless: dict[str, Any]) -> None:
    assert GoalTemplate(endless).goal == {}
