"""Type hashes, compared with those of ROS."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fibaction.interfaces import read_action
from fibaction.interfaces.files import InterfaceMessage, inside_out
from fibaction_transports.cdr.standard_messages import CANCEL_GOAL, MESSAGES, action_interface
from fibaction_transports.cdr.type_hashes import type_hash
from tests.transports.cdr.definitions import POSES, TESTS, action_of, message_in

FIBONACCI = TESTS.parent / "examples/ros2/arduinobot_msgs/action/Fibonacci.action"
HASHES: dict[str, str] = json.loads(Path(__file__).with_name("hashes.json").read_text())
"""Type hashes that ROS 2 Kilted has in the JSON files beside its interface files."""
TEST_ACTIONS = TESTS / "ros2/fibaction_test_msgs/action"


def known() -> dict[str, InterfaceMessage]:
    """Return the definitions of the types whose hashes are known, by type name."""
    everything = (TEST_ACTIONS / "Everything.action").read_text().rpartition("---\n")[0]
    made = action_of(f"{everything}---\n")
    parts = [
        part._replace(type_name=part.type_name.replace("made_msgs/action/Made", EVERYTHING))
        for part in (made.goal, made.result)
    ]
    found = [
        action_interface(read_action(FIBONACCI)),
        action_interface(read_action(TEST_ACTIONS / "Nothing.action")),
        CANCEL_GOAL,
        *MESSAGES.values(),
        *parts,
        message_in("geometry_msgs/PoseStamped", POSES),
        message_in("std_msgs/Empty", {"std_msgs/Empty": ""}),
    ]
    return {one.type_name: one for message in found for one in inside_out(message)}


EVERYTHING = "fibaction_test_msgs/action/Everything"
KNOWN = known()


@pytest.mark.parametrize("name", HASHES)
def test_the_hash_of_a_type_is_that_of_ros(name: str) -> None:
    assert type_hash(KNOWN[name]) == HASHES[name]


def test_a_type_of_an_unknown_package_has_no_hash() -> None:
    message = action_of("int32 a\n---\n---\n").goal._replace(type_name="")
    with pytest.raises(ValueError, match=r"the goal of `Made` has no type hash, because its pack"):
        type_hash(message)
