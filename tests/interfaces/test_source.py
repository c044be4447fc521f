"""Classes made from files, as structs and as the source of modules, which agree.

The modules in `tests/action_files` are generated, so that type checkers and linters see some.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings, strategies

from fibaction.action_files import load_action
from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import ServiceFile, read_action, read_interface, read_service
from fibaction.interfaces.packages import SearchPath
from fibaction.interfaces.source import RobotSource, python_source, types_source
from fibaction.interfaces.structs import make_structs
from fibaction.types.action import Action
from tests.action_files import awkward_types, count_types, pick_up_types
from tests.support.interface_files import write

FILES = Path(__file__).parent.parent / "action_files"
GENERATED = {
    "robot_msgs/action/PickUp.action": pick_up_types,
    "plain/Count.action": count_types,
    "plain/Awkward.action": awkward_types,
}

every_file = pytest.mark.parametrize("name", GENERATED)


def source_of(path: Path) -> str:
    return python_source(read_action(path, search=[FILES]))


def run(source: str) -> ModuleType:
    module = ModuleType("generated_types")
    exec(compile(source, "generated_types.py", "exec", dont_inherit=True), module.__dict__)
    return module


def action_in(module: ModuleType) -> Action[Any, Any, Any]:
    (found,) = [thing for thing in vars(module).values() if isinstance(thing, Action)]
    return found


def constants(kind: type) -> dict[str, Any]:
    return {name: value for name, value in vars(kind).items() if name.isupper()}


def assert_equal_actions(one: Action[Any, Any, Any], other: Action[Any, Any, Any]) -> None:
    assert one.info == other.info
    for part in ("goal", "feedback", "result"):
        left, right = getattr(one, part).type, getattr(other, part).type
        assert left.__struct_fields__ == right.__struct_fields__
        assert left.__struct_encode_fields__ == right.__struct_encode_fields__
        assert left.__struct_config__.forbid_unknown_fields
        assert right.__struct_config__.forbid_unknown_fields
        assert msgspec.to_builtins(left()) == msgspec.to_builtins(right())
        assert constants(left) == constants(right)


@every_file
def test_the_source_is_the_checked_module(name: str) -> None:
    file = GENERATED[name].__file__
    assert file is not None

    assert source_of(FILES / name) == Path(file).read_text(encoding="utf-8")


@every_file
def test_the_module_and_the_loaded_action_agree(name: str) -> None:
    assert_equal_actions(action_in(GENERATED[name]), load_action(FILES / name, search=[FILES]))


def test_values_of_a_generated_module_are_typed() -> None:
    goal: pick_up_types.PickUp_Goal = pick_up_types.PICK_UP.goal.decode(b"\x80")

    assert goal.gripper.pads[1].wear == 0
    assert pick_up_types.PickUp_Goal.HASTY == 2


def test_the_constant_and_a_class_never_share_a_name(tmp_path: Path) -> None:
    path = write(tmp_path / "Imu.action", "IMU imu\n---\n---\n")
    write(tmp_path / "IMU.msg", "")

    module = run(source_of(path))

    assert isinstance(module.IMU_, Action)
    assert module.IMU_.goal.type().imu == module.IMU()


@pytest.mark.parametrize("array", ["", "[]", "[2]"])
def test_a_constant_with_the_name_of_a_message_does_not_hide_it(tmp_path: Path, array: str) -> None:
    write(tmp_path / "RPY.msg", "float64 roll\n")
    path = write(tmp_path / "RPY.action", f"int32 RPY=1\nRPY{array} rpy\n---\n---\n")

    module = run(source_of(path))

    assert module.RPY_Goal.RPY == 1
    assert_equal_actions(module.RPY__, load_action(path))


def test_a_comment_with_an_indented_line_is_the_same_in_the_module(tmp_path: Path) -> None:
    text = "# The weight:\n#     in grams\n#     of the whole\nint32 weight\n---\n---\n"
    path = write(tmp_path / "Weigh.action", text)
    source = source_of(path)

    assert "in grams" in source
    assert_equal_actions(action_in(run(source)), load_action(path))


names = strategies.from_regex(r"[a-z](_?[a-z0-9]){0,8}", fullmatch=True) | strategies.sampled_from(
    ["int", "str", "bytes", "list", "field", "from", "class", "range", "msgspec", "self", "cls"]
)
# A line of a file; `splitlines` has more line ends than `\n`.
texts = strategies.text(max_size=200).map(lambda text: " ".join(text.split()))
integers = ["int8", "uint8", "int32", "uint64", "byte", "char"]
bases = [*integers, "bool", "float32", "float64", "string", "wstring<=5", "Step", "string<=1000"]
lengths = ["", "[]", "[2]", "[<=300]"]


@strategies.composite
def lines(draw: strategies.DrawFn) -> str:
    base, length = draw(strategies.sampled_from(bases)), draw(strategies.sampled_from(lengths))
    default = ""
    if not length and draw(strategies.booleans()):
        if base in integers:
            default = f" {draw(strategies.integers(0, 127))}"
        elif base == "float64":
            default = f" {draw(strategies.floats(allow_nan=False, allow_infinity=False))}"
        elif base.endswith("1000"):
            text = draw(texts).replace("#", "").replace("=", "").replace("\\", "\\ ")
            default = ' "' + text.replace('"', '\\"') + '"'
    above = "".join(f"# {comment}\n" for comment in draw(strategies.lists(texts, max_size=3)))
    return f"{above}{base}{length} {{name}}{default}\n"


@strategies.composite
def parts(draw: strategies.DrawFn) -> str:
    about = "".join(f"# {comment}\n" for comment in draw(strategies.lists(texts, max_size=3)))
    unique = draw(strategies.lists(names, unique=True, max_size=4))
    fields = [draw(lines()).replace("{name}", name) for name in unique]
    return "\n".join([about, f'string TEXT="{draw(names)}"\n', *fields])


@settings(max_examples=min(60, settings().max_examples))
@given(strategies.lists(parts(), min_size=3, max_size=3).map("---\n".join))
def test_any_module_agrees_with_the_loaded_action(text: str) -> None:
    with TemporaryDirectory() as folder:
        path = write(Path(folder) / "Lift.action", text)
        loaded = load_action(path, search=[FILES / "plain"])
        module = run(python_source(read_action(path, search=[FILES / "plain"])))
    assert_equal_actions(module.LIFT, loaded)


def test_messages_and_services_are_written_as_typed_classes(tmp_path: Path) -> None:
    folder = tmp_path / "near_msgs"
    texts = {"msg/Near.msg": "int32 x 5\n", "srv/CountUp.srv": "int32 to\n---\nNear[] found\n"}
    found = [read_interface(write(folder / name, text), []) for name, text in texts.items()]
    module = run(types_source(found))
    assert module.Near().x == 5
    assert module.Near.__ros_type__ == "near_msgs/msg/Near"
    service = module.COUNT_UP
    assert (service.type_name, service.response().found) == ("near_msgs/srv/CountUp", [])
    again, read = read_service("near_msgs/srv/CountUp", SearchPath((), ())), found[1]
    assert isinstance(read, ServiceFile)
    assert again.text == read.text  # defined by the module: no file is needed


# Limits of values


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    return make_structs(read_action(FILES / "robot_msgs/action/PickUp.action"))


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


# All actions of a robot: classes are shared, and names are unique


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
    return run(source.source())


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
    module: Any = run(text)
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
