"""Types of actions as TypeScript; tests/javascript shows that its compiler takes them."""

from __future__ import annotations

import enum
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest

from fibaction import Action, ActionInfo
from fibaction.action_files import load_action
from fibaction.schema.typescript import typescript_source
from tests.support.fibonacci import FIBONACCI

PICK_UP = Path(__file__).parents[1] / "action_files" / "robot_msgs" / "action" / "PickUp.action"


def declarations(*actions: ActionInfo) -> dict[str, str]:
    """The declarations of a module by their names, each on one line."""
    found = {}
    for text in typescript_source(actions).split("\n\n"):
        lines = [line.strip() for line in text.splitlines() if not line.strip().startswith("/")]
        if lines:
            found[lines[0].split()[2]] = " ".join(lines)
    return found


def type_of(schema: Any) -> str:
    """The type that a schema becomes, as a goal."""
    info = ActionInfo("a", goal=schema)
    return declarations(info)["AAction"].split("goal: ", 1)[1].split("; feedback")[0]


def test_an_action_is_an_interface_that_its_name_finds() -> None:
    assert declarations(FIBONACCI.info) == {
        "Goal": "export interface Goal { order: number; }",
        "Feedback": "export interface Feedback { partial_sequence: number[]; }",
        "Result": "export interface Result { sequence: number[]; }",
        "FibonacciAction": (
            "export interface FibonacciAction { goal: Goal; feedback: Feedback; result: Result; }"
        ),
        "Actions": 'export interface Actions { "fibonacci": FibonacciAction; }',
    }
    source = typescript_source([FIBONACCI.info])
    assert 'connection = new Connection<Actions>("ws://127.0.0.1:8080");' in source
    assert 'await connection.sendGoal("fibonacci", { ... });' in source


class Color(enum.Enum):
    RED = "red"
    BLUE = "blue"


@pytest.mark.parametrize(
    ("schema", "expected"),
    [
        (int, "number"),
        (float, "number"),
        (bool, "boolean"),
        (str, "string"),
        (None, "null"),
        (bytes, "Uint8Array"),
        (datetime, "string"),
        (Any, "unknown"),
        (list[int], "number[]"),
        (list[int | str], "(number | string)[]"),
        (tuple[int, str], "[number, string]"),
        (dict[str, float], "Record<string, number>"),
        (Literal[1, "q"], '1 | "q"'),
        (Color, "Color"),
        (int | None, "number | null"),
        (Annotated[int, msgspec.Meta(ge=0, le=2**53)], "number | bigint"),
        (Annotated[int, msgspec.Meta(ge=0, le=2**53 - 1)], "number"),
    ],
)
def test_each_type_of_python_has_one_of_typescript(schema: Any, expected: str) -> None:
    assert type_of(Action("a", goal=int, feedback=int, result=schema).info.result) == expected


@pytest.mark.parametrize(
    ("schema", "expected"),
    [
        (True, "unknown"),
        ({}, "unknown"),
        ({"type": "ghost"}, "unknown"),
        ({"$ref": "#/$defs/Ghost"}, "unknown"),
        ({"const": "a"}, '"a"'),
        ({"type": ["string", "null"]}, "string | null"),
        ({"oneOf": [{"type": "string"}, {"type": "string"}]}, "string"),
        ({"allOf": [{"type": "string"}, {"enum": ["a", None]}]}, 'string & ("a" | null)'),
        (
            {"properties": {"a b": {}, "c": True}, "required": ["c"]},
            '{ "a b"?: unknown; c: unknown; }',
        ),
        ({"type": "array"}, "unknown[]"),
    ],
)
def test_each_schema_of_others_has_a_type(schema: Any, expected: str) -> None:
    assert type_of(schema) == expected


class Pose(msgspec.Struct):
    x: float
    speed: Annotated[
        float, msgspec.Meta(description="How fast.", extra_json_schema={"x-unit": "m/s"})
    ] = 1.0


class Tree(msgspec.Struct):
    """Ends no comment: */."""

    pose: Pose
    inner: Tree | None = None


def test_fields_with_defaults_may_be_left_out_where_they_are_sent() -> None:
    found = declarations(Action("a", goal=Tree, feedback=Tree, result=str).info)

    assert found["PoseInput"] == "export interface PoseInput { x: number; speed?: number; }"
    assert found["Pose"] == "export interface Pose { x: number; speed: number; }"
    assert found["TreeInput"] == (
        "export interface TreeInput { pose: PoseInput; inner?: TreeInput | null; }"
    )
    assert "goal: TreeInput; feedback: Tree;" in found["AAction"]

    sent_only = declarations(Action("a", goal=Pose, feedback=int, result=str).info)
    assert sent_only["Pose"] == "export interface Pose { x: number; speed?: number; }"


def test_descriptions_and_units_are_comments() -> None:
    text = typescript_source([Action("a", goal=int, feedback=Tree, result=str).info])

    assert "  /** How fast. Unit: m/s. */\n  speed: number;\n" in text
    assert "/** Ends no comment: * /. */\nexport interface Tree {\n" in text


def test_types_of_one_name_stay_apart_and_equal_ones_are_declared_once() -> None:
    def action(name: str, **fields: Any) -> ActionInfo:
        part = msgspec.defstruct("Part", fields.items())
        return Action(name, goal=part, feedback=int, result=str).info

    found = declarations(
        action("arm/pick", a=int), action("b", a=int), action("c", a=str), action("c_", a=bool)
    )
    assert found["Part"] == "export interface Part { a: number; }"
    assert found["CPart"] == "export interface CPart { a: string; }"
    assert found["CPart2"] == "export interface CPart2 { a: boolean; }"
    assert "goal: Part;" in found["ArmPickAction"]
    assert "goal: Part;" in found["BAction"]
    assert (
        'Actions { "arm/pick": ArmPickAction; "b": BAction; "c": CAction; "c_": CCAction; }'
        in (found["Actions"])
    )


@pytest.mark.parametrize(("name", "stem"), [("3d_scan", "_3dScan"), ("鳥", "Unnamed")])
def test_a_name_that_typescript_does_not_take_is_changed(name: str, stem: str) -> None:
    found = declarations(ActionInfo(name))

    assert f"{stem}Action" in found


def test_a_file_of_ros_has_all_its_messages() -> None:
    found = declarations(load_action(PICK_UP).info)

    assert "large?: number | bigint;" in found["PickUpGoal"]
    assert "gripper?: RobotMsgsGripper;" in found["PickUpGoal"]
    assert "progress: number;" in found["PickUpFeedback"]


def test_without_actions_nothing_can_be_written() -> None:
    with pytest.raises(ValueError, match="there are no actions"):
        typescript_source([])
