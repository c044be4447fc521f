from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import ActionFile, read_action

FILES = Path(__file__).parent.parent / "action_files"


@pytest.fixture(autouse=True)
def no_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def nested(action: ActionFile, field: str) -> Path:
    """The file that the message in a field of the goal was found in."""
    return action.goal.nested[field].definition.path


def refusal(path: Path, *search: Path) -> str:
    with pytest.raises(InterfaceError) as caught:
        read_action(path, search=search)
    return str(caught.value)


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ("Fibonacci", "fibonacci"),
        ("NavigateToPose", "navigate_to_pose"),
        ("ReadHTTPPage", "read_http_page"),
        ("Lift2Floors", "lift2_floors"),
    ],
)
def test_an_action_is_called_like_its_file(stem: str, name: str, tmp_path: Path) -> None:
    action = read_action(write(tmp_path / f"{stem}.action", "---\n---\n"))

    assert action.name == name
    assert action.type_name == ""


def test_the_name_and_the_type_may_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "---\n---\n")
    action = read_action(str(path), name="arm/lift", type_name="robot_msgs/action/Lift")

    assert (action.name, action.type_name) == ("arm/lift", "robot_msgs/action/Lift")
    assert action.goal.package == "robot_msgs"


def test_the_type_is_known_from_the_folders() -> None:
    assert read_action(FILES / "robot_msgs/action/PickUp.action").type_name == (
        "robot_msgs/action/PickUp"
    )


def test_a_folder_that_cannot_be_a_package_makes_no_type(tmp_path: Path) -> None:
    path = write(tmp_path / "My Robot" / "action" / "Lift.action", "---\n---\n")

    assert read_action(path).type_name == ""


def test_messages_are_found_in_the_package_and_beside_it() -> None:
    action = read_action(FILES / "robot_msgs/action/PickUp.action")

    assert nested(action, "gripper") == FILES / "robot_msgs/msg/Gripper.msg"
    assert nested(action, "spare") == FILES / "other_msgs/msg/Gripper.msg"


def test_messages_are_found_beside_the_file() -> None:
    action = read_action(FILES / "plain/Count.action", search=[FILES])

    assert nested(action, "step") == FILES / "plain/Step.msg"


@pytest.mark.parametrize("root", [".", "robot_msgs", "robot_msgs/msg"])
def test_the_search_path_has_packages_a_package_or_its_messages(root: str, tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "robot_msgs/Gripper gripper\n---\n---\n")

    assert nested(read_action(path, search=[FILES / root]), "gripper") == (
        FILES / root / "robot_msgs/msg/Gripper.msg"
        if root == "."
        else FILES / "robot_msgs/msg/Gripper.msg"
    )


def test_a_message_without_a_package_is_found_in_any_folder(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "Gripper gripper\n---\n---\n")

    for root in (FILES / "robot_msgs", FILES / "robot_msgs" / "msg"):
        assert nested(read_action(path, search=[root]), "gripper") == (
            FILES / "robot_msgs/msg/Gripper.msg"
        )


def test_the_first_folder_counts(tmp_path: Path) -> None:
    path = write(tmp_path / "here" / "Lift.action", "Step step\n---\n---\n")
    first = write(tmp_path / "first" / "Step.msg", "")

    assert nested(read_action(path, search=[first.parent, FILES / "plain"]), "step") == first


def test_a_message_of_another_package_is_not_taken(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "more_msgs/Gripper gripper\n---\n---\n")
    elsewhere = FILES / "other_msgs"

    assert refusal(path, elsewhere, elsewhere / "msg") == (
        f"{path}:1: expected 'more_msgs/Gripper' on the search path, found no"
        f" more_msgs/msg/Gripper.msg and no Gripper.msg in {tmp_path}, {elsewhere},"
        f" {elsewhere / 'msg'}"
    )


def test_a_missing_message_without_a_package_is_told_of(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "---\n\nGripper gripper\n---\n")

    assert refusal(path) == (
        f"{path}:3: expected 'Gripper' on the search path, found no msg/Gripper.msg and no"
        f" Gripper.msg in {tmp_path}"
    )


def test_a_message_that_a_message_misses_is_told_of_with_that_file(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "Step step\n---\n---\n")
    step = write(tmp_path / "Step.msg", "int32 a\nFoot foot\n")

    assert refusal(path).startswith(f"{step}:2: expected 'Foot' on the search path")


def test_the_interfaces_of_an_installed_ros_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "Lift.action", "geometry_msgs/Point point\n---\n---\n")
    point = write(tmp_path / "ros/share/geometry_msgs/msg/Point.msg", "float64 x\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f":{tmp_path / 'other'}:{tmp_path / 'ros'}")

    assert nested(read_action(path), "point") == point


def test_the_interfaces_of_ros_from_wheels_are_found_behind_those_of_an_installed_ros(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "Lift.action", "geometry_msgs/Point point\n---\n---\n")
    share = tmp_path / "venv/share"
    of_wheels = write(share / "geometry_msgs/msg/Point.msg", "float64 x\n")
    (share / "ament_index").mkdir()

    assert nested(read_action(path), "point") == of_wheels
    installed = write(tmp_path / "ros/share/geometry_msgs/msg/Point.msg", "float64 x\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros"))
    assert nested(read_action(path), "point") == installed


def test_what_is_beside_a_python_without_ros_is_no_place_to_look(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "geometry_msgs/Point point\n---\n---\n")
    write(tmp_path / "venv/share/geometry_msgs/msg/Point.msg", "float64 x\n")

    assert refusal(path).endswith(f"Point.msg in {tmp_path}")


@pytest.mark.parametrize("name", ["Time", "Duration"])
def test_the_builtin_interfaces_need_no_file(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", f"builtin_interfaces/{name} it\n---\n---\n")
    fields = read_action(path).goal.nested["it"].definition.fields

    assert [(field.type.base, field.name) for field in fields] == [
        ("int32", "sec"),
        ("uint32", "nanosec"),
    ]


def test_a_file_of_the_builtin_interfaces_counts_for_more(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "builtin_interfaces/Time it\n---\n---\n")
    time = write(tmp_path / "builtin_interfaces/msg/Time.msg", "int64 ticks\n")

    assert nested(read_action(path), "it") == time


def test_there_are_no_other_builtin_interfaces(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "builtin_interfaces/Date it\n---\n---\n")

    assert "expected 'builtin_interfaces/Date' on the search path" in refusal(path)


def test_a_message_that_is_nested_in_itself_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "Tree tree\n---\n---\n")
    write(tmp_path / "Tree.msg", "Branch[] branches\n")
    branch = write(tmp_path / "Branch.msg", "int32 a\nTree[] trees\n")

    assert refusal(path) == (
        f"{branch}:2: expected no message that is nested in itself, found 'Tree'"
    )


def test_messages_of_one_name_are_called_by_their_packages_too() -> None:
    action = read_action(FILES / "robot_msgs/action/PickUp.action")

    assert [message.class_name for message in action.messages()] == [
        "Pad",
        "robot_msgs_Gripper",
        "other_msgs_Gripper",
        "Time",
        "Duration",
        "PickUp_Goal",
        "PickUp_Result",
        "PickUp_Feedback",
    ]


def test_a_message_is_read_once(tmp_path: Path) -> None:
    path = write(tmp_path / "Lift.action", "Step a\nStep b\n---\nStep c\n---\n")
    write(tmp_path / "Step.msg", "")
    action = read_action(path)

    assert action.goal.nested["a"] is action.goal.nested["b"]
    assert action.goal.nested["a"] is action.result.nested["c"]


def test_a_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_action(tmp_path / "Lift.action")


def test_a_file_that_ros_would_not_take_by_its_name_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "my-lift.action", "---\n---\n")

    assert refusal(path) == (
        f"{path}:1: expected a file that is called like 'Fibonacci.action', found 'my-lift.action'"
    )


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "Lift.action"
    path.write_bytes(b"int32 a\n\n# gr\xf6\xdfe\n")

    assert refusal(path).startswith(f"{path}:3: expected text in UTF-8, found ")


def test_a_mark_of_the_byte_order_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "Lift.action"
    path.write_bytes(b"\xef\xbb\xbfint32 a\n---\n---\n")

    assert read_action(path).goal.definition.fields[0].name == "a"
