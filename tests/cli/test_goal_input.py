from __future__ import annotations

from itertools import pairwise

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fibaction.cli.arguments.goal_input import read_goal
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.robot import Pick, Pose

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
