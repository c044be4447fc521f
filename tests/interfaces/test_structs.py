from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction.interfaces.files import read_action
from fibaction.interfaces.structs import make_structs

FILES = Path(__file__).parent.parent / "action_files"
PICK_UP = read_action(FILES / "robot_msgs/action/PickUp.action")


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    return make_structs(PICK_UP)


def properties(kind: Any) -> dict[str, Any]:
    """Return the JSON Schemas of a struct's fields."""
    schema = msgspec.json.schema(kind)
    found: dict[str, Any] = schema["$defs"][kind.__name__]["properties"]
    return found


def test_fields_have_the_defaults_of_the_file_or_of_ros(made: dict[str, Any]) -> None:
    gripper = {"width": 0.1, "pads": [{"wear": 0, "pressure": []}] * 2}

    assert msgspec.to_builtins(made["PickUp_Goal"](), builtin_types=(bytes,)) == {
        "manner": 1,
        "thing": 'a "box"',
        "gripper": gripper,
        "spare": [{"name": ""}, {"name": ""}],
        "where": [0.5, -0.5, 0.0],
        "speeds": [1.5],
        "ports": [0, 0],
        "names": ["one", "two, and three"],
        "address": bytes(4),
        "token": b"\x01\x02\xff",
        "labels": [],
        "start": {"sec": 0, "nanosec": 0},
        "pauses": [],
        "large": 2**64 - 1,
    }


def test_constants_are_attributes_of_the_class(made: dict[str, Any]) -> None:
    goal = made["PickUp_Goal"]

    assert (goal.CAREFUL, goal.HASTY, goal.GREETING, goal.HALF) == (1, 2, "hello", 0.5)
    assert goal.ALWAYS is True
    assert made["robot_msgs_Gripper"].FINGERS == 2


@pytest.mark.parametrize(
    ("goal", "where"),
    [
        ({"manner": 128}, "$.manner"),
        ({"thing": "x" * 21}, "$.thing"),
        ({"spare": [{}]}, "$.spare"),
        ({"spare": [{}, {"name": 1}]}, r"$.spare[1].name"),
        ({"gripper": {"pads": [{}, {"wear": 256}]}}, r"$.gripper.pads[1].wear"),
        ({"where": [1.0, 2.0]}, "$.where"),
        ({"speeds": [1.0] * 5}, "$.speeds"),
        ({"ports": [1, 65536]}, "$.ports[1]"),
        ({"address": b"123"}, "$.address"),
        ({"labels": ["long enough"]}, "$.labels[0]"),
        ({"labels": ["a"] * 4}, "$.labels"),
        ({"start": {"nanosec": -1}}, "$.start.nanosec"),
        ({"thin": "a"}, "thin"),
    ],
)
def test_a_value_out_of_its_limits_is_rejected_with_the_name_of_its_field(
    goal: dict[str, Any], where: str, made: dict[str, Any]
) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(goal, made["PickUp_Goal"])

    assert f"`{where}`" in str(caught.value)


def test_comments_are_descriptions_in_the_schema(made: dict[str, Any]) -> None:
    goal = msgspec.json.schema(made["PickUp_Goal"])["$defs"]
    feedback = msgspec.json.schema(made["PickUp_Feedback"])["$defs"]["PickUp_Feedback"]

    assert goal["PickUp_Goal"]["description"] == "Pick something up, and bring it somewhere."
    assert properties(made["PickUp_Goal"])["manner"]["description"] == (
        "How to do it: CAREFUL or HASTY."
    )
    assert goal["robot_msgs_Gripper"]["description"] == "What it holds things with."
    assert feedback["properties"]["progress"]["description"] == (
        "It may go back\nwhen something falls."
    )


def test_a_message_without_a_comment_is_described_by_its_name(made: dict[str, Any]) -> None:
    assert made["PickUp_Result"].__doc__ == "The result of `PickUp`."
    assert made["other_msgs_Gripper"].__doc__ == "`other_msgs/Gripper`."
    assert "description" not in properties(made["PickUp_Goal"])["where"]


def test_the_module_of_a_struct_is_its_package(made: dict[str, Any]) -> None:
    assert made["other_msgs_Gripper"].__module__ == "other_msgs"
    assert made["PickUp_Goal"].__module__ == "robot_msgs"
