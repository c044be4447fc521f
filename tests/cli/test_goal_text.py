"""Goals as text: read, and as templates with what is known of each field."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import BaseModel, Field

from fibaction.cli.arguments.goal_text import GoalTemplate, read_goal
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.robot import Pick, Pose
from tests.support.fibonacci import Goal

PICK = msgspec.json.schema(Pick)
POSE = msgspec.json.schema(Pose)


@pytest.mark.parametrize(
    ("text", "goal"),
    [
        ("object_name: cup", {"object_name": "cup"}),
        ('{"object_name": "cup", "speed": 1e-2}', {"object_name": "cup", "speed": 0.01}),
        ("{speed: 1e-2, photo: !!binary aGk=}", {"speed": 0.01, "photo": b"hi"}),
        ("name: füñf 鳥", {"name": "füñf 鳥"}),
        (
            "{at: 2026-01-02T03:04:05Z, day: 2026-01-02}",
            {"at": "2026-01-02T03:04:05Z", "day": "2026-01-02"},
        ),
        ("", {}),
        (" # nothing\n", {}),
        ("null", None),
        ("[1, 2.5, .inf]", [1, 2.5, float("inf")]),
        ("hello", "hello"),
        ("{1: a}", {1: "a"}),
        ("[0x1F, 1_000, 1:30, -7, 1e3, 1.5]", [31, 1000, 90, -7, 1e3, 1.5]),
    ],
)
def test_yaml_and_json_text_is_read(text: str, goal: object) -> None:
    assert read_goal(text, {}) == goal


def test_no_text_is_the_goal_of_an_action_without_one() -> None:
    assert read_goal(" ", {"type": "null"}) is None


@pytest.mark.parametrize(
    ("pairs", "goal"),
    [
        (("object_name=cup", "pose.x=1", "pose.frame=7"), {"x": 1.0, "y": 0.0, "frame": "7"}),
        (("object_name=cup", 'pose={"x": 2}'), {"x": 2.0, "y": 0.0, "frame": "map"}),
        (("object_name=a=b", "pose.frame="), {"x": 0.0, "y": 0.0, "frame": ""}),
    ],
)
def test_pairs_are_fields_whose_text_is_text_and_whose_rest_is_yaml(
    pairs: tuple[str, ...], goal: object
) -> None:
    assert read_goal(pairs, PICK)["pose"] == goal
    assert read_goal(("a=1", "b.c:=[x]"), {}) == {"a": 1, "b": {"c": ["x"]}}
    assert read_goal(("a=1",), {"type": "string"}) == "a=1"


def test_a_goal_is_checked_and_completed_by_the_schema() -> None:
    assert read_goal("x: 1", POSE) == {"x": 1, "y": 0.0, "frame": "map"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x: a", 'goal.x must be a number, not "a"'),
        ("{x: 1", "the goal is not valid YAML (line 1, column 6): while parsing a flow mapping"),
        ("a: b: c", "the goal is not valid YAML (line 1, column 5): mapping values are not"),
        ("x: \x07", "the goal is not valid YAML: unacceptable character"),
        ("x: !!python/name:os.system", "the goal is not valid YAML (line 1, column 4): could not"),
        ("[" * 100_000, "the goal is not valid YAML: "),
        ("x: &a [*a]", "the goal is not valid YAML (line 1, column 8): aliases such as *name"),
        (
            "a: &a [0]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in pairwise("abcdefgh")),
            "the goal is not valid YAML (line 2, column 8): aliases such as *name are",
        ),
        ("x: " + "9" * 101, "the goal is not valid YAML (line 1, column 4): a number with more"),
        ("x: 1" + ":59" * 100_000, "the goal is not valid YAML (line 1, column 4): a number with"),
        ("x: " + "9" * 101 + ".5", "the goal is not valid YAML (line 1, column 4): a number with"),
        ("x: !!int ''", "the goal is not valid YAML: "),
        ("x: !!bool x", "the goal is not valid YAML: "),
        ("x: !!timestamp x", "the goal is not valid YAML: "),
        (r'{"frame": "\ud800"}', "the goal cannot be encoded: text with half a character"),
        ("frame: \udc80", "the goal is not valid YAML: unacceptable character"),
        ("{? [1] : 2}", "the goal is not valid YAML"),
        ("{x: {? 2026-01-01 : 1, ? !!binary aGk= : 2}}", "goal.x must be a number"),
    ],
)
def test_an_unusable_goal_is_an_error_of_usage_in_one_sentence(text: str, message: str) -> None:
    with pytest.raises(Failure) as failure:
        read_goal(text, POSE)

    assert failure.value.message.startswith(message)
    assert failure.value.exit_code == ExitCode.USAGE


def test_a_missing_space_after_a_colon_is_pointed_out() -> None:
    with pytest.raises(Failure, match=r'no field "x:1"; .*; in YAML, a space follows'):
        read_goal("{x:1}", POSE)


@given(st.text(max_size=50))
@example('"\\e[2J": 1')
def test_any_text_is_a_goal_or_a_sentence_that_cannot_control_the_terminal(text: str) -> None:
    try:
        goal = read_goal(text, PICK)
    except Failure as failure:
        assert failure.message.isprintable()  # noqa: PT017 - no error is as good
    else:
        assert "object_name" in goal


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
