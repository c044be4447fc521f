"""Limits of values. For names, defaults, constants and comments, `test_source` compares the structs
with the modules in `tests/action_files`.
"""

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


def test_a_struct_is_not_shown_as_the_class_of_ros(made: dict[str, Any]) -> None:
    gripper, goal = made["other_msgs_Gripper"], made["PickUp_Goal"]
    assert repr(gripper) == "<class 'fibaction.ros_types.other_msgs.msg.other_msgs_Gripper'>"
    assert repr(goal) == "<class 'fibaction.ros_types.robot_msgs.action.PickUp_Goal'>"
    assert (gripper.__ros_type__, goal.__ros_type__) == (
        "other_msgs/msg/Gripper",
        "robot_msgs/action/PickUp_Goal",
    )
