"""The names of tools."""

from __future__ import annotations

import re

import pytest

from fibaction_transports._agents.robot_actions import LONGEST, action_name

VALID = re.compile(r"[A-Za-z0-9_-]{1,64}")


@pytest.mark.parametrize(
    ("server", "action", "name"),
    [
        ("", "drive", "drive"),
        ("", "/arm/pick_up", "arm-pick_up"),
        ("", "~/pick", "pick"),
        ("left", "arm/pick", "left-arm-pick"),
        ("", "drïve!", "dr_ve_"),
    ],
)
def test_a_tool_has_the_name_of_its_action(server: str, action: str, name: str) -> None:
    assert action_name(server, action, ()) == name


@pytest.mark.parametrize("action", ["x" * (LONGEST + 1), "send_goal", "", "/"])
def test_a_name_that_cannot_be_taken_ends_with_digits_that_are_always_the_same(action: str) -> None:
    name = action_name("", action, {"send_goal"})
    assert VALID.fullmatch(name)
    assert name != action
    assert name == action_name("", action, {"send_goal", "other"})
    assert name != action_name("", f"{action}y", {"send_goal"})
