"""From text to a goal: parsed, completed by defaults, checked, and ready to be sent."""

from __future__ import annotations

import datetime
import json
import uuid
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.cli.exit_codes import ExitCode, Failure
from fibaction.cli.goal_text import read_goal
from tests.cli.robot import Gripper, Pick, Pose, Sucker

Aware = Annotated[datetime.datetime, msgspec.Meta(tz=True)]


class Times(msgspec.Struct):
    at: Aware | None = None
    lasting: datetime.timedelta | None = None
    name: str = ""
    number: uuid.UUID | None = None


def goal_of(kind: Any, text: str) -> Any:
    """The goal as a server of that type gets it."""
    payload = msgspec.msgpack.encode(read_goal(text, msgspec.json.schema(kind)))
    return msgspec.msgpack.decode(payload, type=kind)


def failure_of(kind: Any, text: str) -> str:
    with pytest.raises(Failure) as failure:
        read_goal(text, msgspec.json.schema(kind))
    assert failure.value.exit_code == ExitCode.USAGE
    return failure.value.message


@pytest.mark.parametrize(
    ("kind", "text", "goal"),
    [
        (Pick, "object_name: cup", Pick("cup")),
        (Pick, '{"object_name": "cup", "speed": 1e-2}', Pick("cup", speed=0.01)),
        (Pick, "{object_name: cup, pose: {x: 1}}", Pick("cup", pose=Pose(x=1))),
        (Pick, "{object_name: cup, retries: 2.0}", Pick("cup", retries=2)),
        (
            Pick,
            "{object_name: cup, waypoints: [{}, {y: 1}]}",
            Pick("cup", waypoints=[Pose(), Pose(y=1)]),
        ),
        (Pick, "{object_name: cup, photo: aGk=}", Pick("cup", photo=b"hi")),
        (Pick, "{object_name: cup, photo: !!binary aGk=}", Pick("cup", photo=b"hi")),
        (
            Pick,
            "{object_name: cup, start: 2026-01-02T03:04:05}",
            Pick("cup", start=datetime.datetime(2026, 1, 2, 3, 4, 5)),
        ),
        (Pick, "{object_name: cup, tags: {a: 1}}", Pick("cup", tags={"a": 1})),
        (Pick, "{object_name: cup, tool: {type: sucker}}", Pick("cup", tool=Sucker())),
        (Pick, "{object_name: cup, tool: {type: gripper, force: 2}}", Pick("cup", tool=Gripper(2))),
        (Pick, "object_name: füñf 鳥", Pick("füñf 鳥")),
        (Pose, "", Pose()),
        (Pose, " # nothing\n", Pose()),
        (Pose, "{}", Pose()),
        (Times, "{name: 2026-01-02}", Times(name="2026-01-02")),
        (
            Times,
            "{at: 2026-01-02T03:04:05Z, lasting: PT1S}",
            Times(
                datetime.datetime(2026, 1, 2, 3, 4, 5, tzinfo=datetime.UTC),
                datetime.timedelta(seconds=1),
            ),
        ),
        (int, "5", 5),
        (str, "hello", "hello"),
        (int | None, "null", None),
        (list[float], "[1, 2.5, .inf]", [1, 2.5, float("inf")]),
        (tuple[int, bytes], "[1, aGk=]", (1, b"hi")),
        (dict[int, bytes], "{1: aGk=}", {1: b"hi"}),
        (list[Pose | None], "[null, {x: 1}]", [None, Pose(x=1)]),
    ],
)
def test_a_goal_arrives_as_it_was_meant(kind: Any, text: str, goal: object) -> None:
    assert goal_of(kind, text) == goal


def test_what_is_left_out_is_completed_where_there_are_defaults() -> None:
    goal = read_goal("{object_name: cup, tool: {type: sucker}}", msgspec.json.schema(Pick))

    assert list(goal)[:3] == ["object_name", "speed", "retries"]  # as the type has them
    assert goal["retries"] == 3
    assert goal["tool"] == {"type": "sucker", "vacuum": 0.5}


def test_what_the_server_does_not_describe_is_sent_as_it_is_written() -> None:
    assert read_goal("{a: [1, b, 2026-01-02]}", {}) == {"a": [1, "b", "2026-01-02"]}


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        (Pick, "", "goal.object_name is missing"),
        (Pick, "object_nam: cup", 'goal has no field "object_nam"; did you mean object_name?'),
        (
            Pick,
            "{object_name: 5, pose: {z: 1}}",
            'goal.object_name must be text, not 5; goal.pose has no field "z"; it has x, y, frame',
        ),
        (
            Pick,
            "{object_name: cup, photo: '???'}",
            'goal.photo: "???" is no base64, which bytes are written in',
        ),
        (Pick, "{object_name: cup, photo: 5}", "goal.photo must be text, not 5"),
        (
            Pick,
            "{object_name: cup, tool: {type: hand}}",
            'goal.tool.type must be "gripper" or "sucker", not "hand"',
        ),
        (
            Times,
            "{at: soon}",
            'goal.at: "soon" is no date-time as ISO 8601 or RFC 4122 has it',
        ),
        (Times, "{lasting: 5}", "goal.lasting must be text or null, not 5"),
        (Pose, "[1, 2]", "goal must be a map of fields, not [1,2]"),
        (Pose, "null", "goal must be a map of fields, not null"),
        (Pose, "{x: 1", "the goal is no YAML (line 1, column 6): while parsing a flow mapping"),
        (Pose, "a: b: c", "the goal is no YAML (line 1, column 5): mapping values are not allowed"),
        (Pose, "x: \x07", "the goal is no YAML: unacceptable character"),
        (Pose, "x: !!python/name:os.system", "the goal is no YAML (line 1, column 4): could not"),
        (Pose, "[" * 100_000, "the goal is no YAML: "),
        (Pose, "x: &a [*a]", "the goal cannot be sent: "),
        (Pose, "{? [1] : 2}", "the goal is no YAML"),
        (Pose, "{x: {? 2026-01-01 : 1, ? !!binary aGk= : 2}}", "goal.x must be a number"),
    ],
)
def test_what_is_wrong_is_one_sentence(kind: Any, text: str, message: str) -> None:
    assert failure_of(kind, text).startswith(message)


def test_of_many_errors_the_first_are_told() -> None:
    text = failure_of(list[int], "[a, b, c, d, e, f, g]")

    assert text.startswith('goal[0] must be a whole number, not "a"; goal[1]')
    assert text.endswith('not "e"; and 2 more')


def test_what_is_wrong_cannot_control_the_terminal() -> None:
    assert failure_of(Pose, '"\\e[2J": 1').isprintable()


class Tree(msgspec.Struct):
    value: int
    children: list[Tree] = []
    by_name: dict[str, Tree] = {}
    pair: tuple[int, Pose] | None = None


leaves = st.builds(Tree, value=st.integers(-(2**63), 2**63 - 1))
trees = st.builds(
    Tree,
    value=st.integers(-9, 9),
    children=st.lists(leaves, max_size=3),
    by_name=st.dictionaries(st.text(max_size=5), leaves, max_size=3),
    pair=st.none() | st.tuples(st.integers(-9, 9), st.builds(Pose, frame=st.text(max_size=5))),
)


@given(trees)
def test_a_goal_in_json_arrives_as_it_is(tree: Tree) -> None:
    assert goal_of(Tree, msgspec.json.encode(tree).decode()) == tree


@given(st.text(max_size=50))
def test_any_text_is_a_goal_or_one_sentence(text: str) -> None:
    failures: list[Failure] = []
    try:
        goal = read_goal(text, msgspec.json.schema(Pick))
    except Failure as failure:
        failures.append(failure)
        goal = {"object_name": None}

    assert "object_name" in goal
    assert all(failure.message.isprintable() for failure in failures)


def test_a_schema_is_left_as_it_is() -> None:
    schema = msgspec.json.schema(Pick)
    before = json.dumps(schema)

    read_goal("object_name: cup", schema)["tags"]["a"] = 1

    assert json.dumps(schema) == before
