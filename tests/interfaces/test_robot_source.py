"""The module of a robot's actions: classes are shared, and names are unique."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import pytest

from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.robot_source import RobotSource

PICK = "arm_msgs/action/Pick"
PLACE = "arm_msgs/action/Place"
OTHER_PICK = "fruit_msgs/action/Pick"
SPOT, OTHER_SPOT = "arm_msgs/msg/Spot", "fruit_msgs/msg/Spot"
SPOT_TEXT = "# A spot.\nint32 x 7\n"


def texts_of(type_name: str, spot: str = SPOT, spot_text: str = SPOT_TEXT) -> dict[str, str]:
    return {type_name: "Spot at\n---\n---\n# So far.\nint32 done\n", spot: spot_text}


def module_of(*actions: tuple[str, str, Mapping[str, str]]) -> Any:
    source = RobotSource()
    for name, type_name, texts in actions:
        source.add(name, type_name, texts)
    assert len(source) == len(actions)
    module = ModuleType("robot")
    exec(compile(source.source(), "robot.py", "exec", dont_inherit=True), module.__dict__)
    return module


def test_actions_share_the_classes_of_their_messages() -> None:
    robot = module_of(("pick", PICK, texts_of(PICK)), ("place", PLACE, texts_of(PLACE)))
    assert robot.PICK.type_name == PICK
    assert (robot.PICK.goal.type, robot.PLACE.goal.type) == (robot.Pick_Goal, robot.Place_Goal)
    assert robot.Pick_Goal().at == robot.Place_Goal().at == robot.Spot(x=7)
    assert robot.Spot.__doc__ == "A spot."
    assert "fibaction gen --from-robot" in robot.__doc__


def test_classes_of_one_name_have_the_packages_in_front() -> None:
    robot = module_of(
        ("pick", PICK, texts_of(PICK)),
        ("fruit", OTHER_PICK, texts_of(OTHER_PICK, OTHER_SPOT, "string where\n")),
        ("place", PLACE, texts_of(PLACE)),
    )
    assert robot.PICK.goal.type is robot.arm_msgs_Pick_Goal
    assert robot.FRUIT.goal.type is robot.fruit_msgs_Pick_Goal
    assert robot.arm_msgs_Pick_Goal().at == robot.Place_Goal().at == robot.arm_msgs_Spot(x=7)
    assert robot.fruit_msgs_Pick_Goal().at == robot.fruit_msgs_Spot(where="")


def test_several_actions_of_one_type_define_it_once_and_have_names_of_their_own() -> None:
    texts = texts_of(PICK)
    source = RobotSource()
    for name in ("arm/pick", "arm_pick", "/arm/pick"):
        source.add(name, PICK, texts)
    text = source.source()
    assert text.count("define_action(\n") == 1
    module = ModuleType("robot")
    exec(compile(text, "robot.py", "exec", dont_inherit=True), module.__dict__)
    names = [module.ARM_PICK.name, module.ARM_PICK_.name, module.ARM_PICK__.name]
    assert names == ["arm/pick", "arm_pick", "/arm/pick"]


def test_another_version_of_a_message_is_an_error_that_names_it_and_is_not_added() -> None:
    source = RobotSource()
    source.add("pick", PICK, texts_of(PICK))
    with pytest.raises(InterfaceError, match=f"expected {SPOT} as in the other actions, found ano"):
        source.add("place", PLACE, texts_of(PLACE, spot_text="int32 y\n"))
    same_but_for_the_default = texts_of(PLACE, spot_text="int32 x\n")
    source.add("place", PLACE, same_but_for_the_default)
    assert len(source) == 2


def test_a_malformed_text_is_an_error() -> None:
    with pytest.raises(InterfaceError, match="expected two lines '---'"):
        RobotSource().add("pick", PICK, {PICK: ""})
