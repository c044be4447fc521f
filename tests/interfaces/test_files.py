from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from fibaction.interfaces import packages
from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import (
    inside_out,
    read_action,
    read_action_texts,
    read_message,
    read_message_texts,
    read_service,
)
from fibaction.interfaces.packages import SearchPath
from tests.support.interface_files import write

FILES = Path(__file__).parent.parent / "action_files"


@pytest.fixture(autouse=True)
def no_messages(no_ros: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the library have no messages."""
    monkeypatch.setattr(packages, "_store", lambda: SimpleNamespace(fielddefs={}))


def with_goal(path: Path, fields: str) -> Path:
    """Write an action whose goal has these fields."""
    return write(path, f"{fields}\n---\n---\n")


def found(path: Path, *search: Path) -> Path:
    """Return the file of the first message in the goal of an action."""
    (nested, *_) = read_action(path, search=search).goal.nested.values()
    return nested.definition.path


def error(path: Path, *search: Path) -> str:
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
def test_an_action_has_the_name_of_its_file(stem: str, name: str, tmp_path: Path) -> None:
    action = read_action(with_goal(tmp_path / f"{stem}.action", ""))

    assert (action.name, action.type_name) == (name, "")


def test_the_first_folder_on_the_search_path_counts(tmp_path: Path) -> None:
    path = with_goal(tmp_path / "here" / "Lift.action", "Step step")
    first = write(tmp_path / "first" / "Step.msg", "")

    assert found(path, first.parent, FILES / "plain") == first


def test_a_message_of_another_package_is_not_used(lift: Path) -> None:
    path = with_goal(lift, "more_msgs/Gripper gripper")
    elsewhere = FILES / "other_msgs"

    assert error(path, elsewhere, elsewhere / "msg") == (
        f"{path}:1: expected 'more_msgs/Gripper' on the search path, found no"
        f" more_msgs/msg/Gripper.msg and no Gripper.msg in {lift.parent}, {elsewhere},"
        f" {elsewhere / 'msg'}"
    )


def test_a_missing_message_is_reported_with_the_file_that_nests_it(lift: Path) -> None:
    path = with_goal(lift, "\nStep step")
    assert error(path) == (
        f"{path}:2: expected 'Step' on the search path, found no msg/Step.msg and no"
        f" Step.msg in {lift.parent}"
    )

    step = write(lift.with_name("Step.msg"), "int32 a\nFoot foot\n")
    assert error(path).startswith(f"{step}:2: expected 'Foot' on the search path")


def test_the_interfaces_of_an_installed_ros_come_before_those_of_wheels(
    lift: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = with_goal(lift, "geometry_msgs/Point point")
    share = lift.parent / "venv/share"
    of_wheels = write(share / "geometry_msgs/msg/Point.msg", "float64 x\n")
    # Without ROS, `share` of the environment is not searched.
    assert error(path).endswith(f"Point.msg in {lift.parent}")
    (share / "ament_index").mkdir()
    assert found(path) == of_wheels

    installed = write(lift.parent / "ros/share/geometry_msgs/msg/Point.msg", "float64 x\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f":{lift.parent / 'other'}:{lift.parent / 'ros'}")
    assert found(path) == installed


@pytest.mark.parametrize("name", ["Time", "Duration"])
def test_the_builtin_interfaces_need_no_file(name: str, lift: Path) -> None:
    path = with_goal(lift, f"builtin_interfaces/{name} it")
    fields = read_action(path).goal.nested["it"].definition.fields

    assert [(field.type.base, field.name) for field in fields] == [
        ("int32", "sec"),
        ("uint32", "nanosec"),
    ]


def test_a_file_comes_before_a_builtin_interface(lift: Path) -> None:
    path = with_goal(lift, "builtin_interfaces/Time it")
    time = write(lift.parent / "builtin_interfaces/msg/Time.msg", "int64 ticks\n")

    assert found(path) == time


def test_a_common_message_of_ros_needs_no_file_if_the_library_is_installed(
    lift: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = SimpleNamespace(
        fielddefs=["std_msgs/msg/Header"],
        generate_msgdef=lambda name, ros_version: ("string frame_id\n" + "=" * 80 + "\nMSG: x", ""),
    )
    monkeypatch.setattr(packages, "_store", lambda: library)
    header = read_action(with_goal(lift, "std_msgs/Header header")).goal.nested["header"]
    assert header.definition.text == "string frame_id\n"
    assert header.type_name == "std_msgs/msg/Header"


def test_a_message_that_contains_itself_is_rejected(lift: Path) -> None:
    path = with_goal(lift, "Tree tree")
    write(lift.with_name("Tree.msg"), "Branch[] branches\n")
    branch = write(lift.with_name("Branch.msg"), "int32 a\nTree[] trees\n")

    assert error(path) == (
        f"{branch}:2: expected a message that does not contain itself, found 'Tree'"
    )


def chain(folder: Path, length: int, *fields: str) -> str:
    """Write messages, each of which nests the next one in these fields. Return the first name."""
    for level in range(length):
        nested = "".join(f"M{level + 1}{field}\n" for field in fields)
        write(folder / f"M{level}.msg", nested if level < length - 1 else "int32 x\n")
    return "M0"


def test_messages_that_are_nested_in_two_ways_are_read_once(lift: Path) -> None:
    first = chain(lift.parent, 16, " a", " b")
    action = read_action(with_goal(lift, f"{first} a"))

    assert [message.class_name for message in action.messages()][:2] == ["M15", "M14"]
    assert len(action.messages()) == 16 + 3


@pytest.mark.parametrize("fields", [(" a", " b"), ("[2] a",)])
def test_a_message_of_too_many_messages_is_an_error(fields: tuple[str, ...], lift: Path) -> None:
    first = chain(lift.parent, 90, *fields)
    with_goal(lift, f"{first} a")

    assert error(lift) == (
        f"{lift.parent / 'M73.msg'}:{len(fields)}:"
        f" expected at most 100,000 messages in one, found 131,071"
    )


def test_arrays_that_are_empty_by_default_have_no_size(lift: Path) -> None:
    first = chain(lift.parent, 90, "[] a", "[<=5] b")

    assert len(read_action(with_goal(lift, f"{first} a")).messages()) == 90 + 3


def test_messages_that_nest_too_deeply_are_an_error(lift: Path) -> None:
    first = chain(lift.parent, 600, " a")
    with_goal(lift, f"# deep\n{first} a")

    text = "expected at most 100 levels of messages, found more"
    assert error(lift) == f"{lift.parent / 'M99.msg'}:1: {text}"
    with_goal(lift, "M560 b\nM520 b2\nM490 c\n")
    assert error(lift) == f"{lift.parent / 'M498.msg'}:1: {text}"


def test_a_hundred_levels_of_messages_are_allowed(lift: Path) -> None:
    first = chain(lift.parent, 100, " a")

    assert len(read_action(with_goal(lift, f"{first} a")).messages()) == 103


def test_a_message_is_read_once(lift: Path) -> None:
    write(lift.with_name("Step.msg"), "")
    action = read_action(write(lift, "Step a\nStep b\n---\nStep c\n---\n"))

    assert action.goal.nested["a"] is action.goal.nested["b"] is action.result.nested["c"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("# c\n" * 20_000, "expected at most 65,536 characters, found more"),
        ("string[] a [" + "'x'," * 70_000 + "]\n", "expected at most 65,536 characters"),
        ("".join(f"byte f{n}\n" for n in range(1001)), "at most 1,000 fields or constants"),
        ("# 語語\n" * 40_000, "expected at most 65,536 characters, found more"),
    ],
)
def test_a_file_is_of_a_size_that_is_read_in_a_moment(text: str, problem: str, lift: Path) -> None:
    lift.write_text(f"{text}---\n---\n")

    with pytest.raises(InterfaceError, match=problem):
        read_action(lift)


@pytest.mark.skipif(sys.platform == "win32", reason="it has no such files")
def test_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "action").mkdir()
    pipe, manifest = tmp_path / "action" / "Lift.action", tmp_path / "package.xml"
    os.mkfifo(pipe)
    manifest.symlink_to("/dev/zero")

    with pytest.raises(OSError, match="it is not a file"):
        read_action(pipe)
    pipe.unlink()
    pipe.write_text("---\n---\n")
    assert read_action(pipe).type_name == f"{tmp_path.name}/action/Lift"


def test_a_file_name_that_ros_does_not_allow_is_rejected(lift: Path) -> None:
    path = with_goal(lift.with_name("my-lift.action"), "")

    assert error(path) == (
        f"{path}:1: expected a file name like 'Fibonacci.action', found 'my-lift.action'"
    )


def test_a_file_that_is_not_utf_8_is_rejected(lift: Path) -> None:
    lift.write_bytes(b"int32 a\n\n# gr\xf6\xdfe\n")

    assert error(lift).startswith(f"{lift}:3: expected text in UTF-8, found ")


def test_a_byte_order_mark_is_an_error(lift: Path) -> None:
    lift.write_bytes(b"\xef\xbb\xbfint32 a\n---\n---\n")

    assert error(lift) == f"{lift}:1: expected text without a byte order mark, found one"


def test_the_header_of_ros_1_gets_a_hint(lift: Path) -> None:
    assert error(with_goal(lift, "Header header")).endswith("; in ROS 2 it is 'std_msgs/Header'")


def test_namesakes_keep_their_type_names(tmp_path: Path) -> None:
    for package in ("arm_msgs", "leg_msgs"):
        write(tmp_path / package / "msg/Joint.msg", "int32 number")
    path = with_goal(tmp_path / "arm_msgs/action/Lift.action", "Joint a\nleg_msgs/Joint b")

    nested = read_action(path).goal.nested

    assert [(one.class_name, one.type_name) for one in nested.values()] == [
        ("arm_msgs_Joint", "arm_msgs/msg/Joint"),
        ("leg_msgs_Joint", "leg_msgs/msg/Joint"),
    ]


LIFT = "lift_msgs/action/Lift"


def test_an_action_is_read_from_the_texts_that_another_one_gives(tmp_path: Path) -> None:
    write(tmp_path / "other_msgs/msg/Load.msg", "# What is lifted.\nfloat32 mass 1.5  # in kg\n")
    path = write(
        tmp_path / f"{LIFT}.action", "other_msgs/Load load\nbuiltin_interfaces/Time at\n---\n---\n"
    )
    action = read_action(path, search=[tmp_path])
    texts = action.texts()
    assert list(texts) == [LIFT, "other_msgs/msg/Load", "builtin_interfaces/msg/Time"]
    again = read_action_texts(LIFT, texts, name="hoist")
    assert (again.name, again.type_name, again.texts()) == ("hoist", LIFT, texts)
    (mass,) = again.goal.nested["load"].definition.fields
    assert (mass.default, mass.comment) == (1.5, "in kg")


@pytest.mark.parametrize(
    ("type_name", "problem"),
    [
        (LIFT, "expected 'other_msgs/Load' on the search path"),
        ("lift_msgs/action/Lower", "expected a type like"),
        ("Lift", "expected a type like"),
        ("lift_msgs/msg/Lift", "expected a type like"),
    ],
)
def test_texts_without_what_is_needed_are_an_error(type_name: str, problem: str) -> None:
    texts = dict.fromkeys((LIFT, "Lift", "lift_msgs/msg/Lift"), "other_msgs/Load load\n---\n---\n")
    with pytest.raises(InterfaceError, match=problem):
        read_action_texts(type_name, texts)


def test_a_message_is_read_by_its_type_with_all_that_it_nests(tmp_path: Path) -> None:
    write(tmp_path / "near_msgs/msg/Outer.msg", "Inner inner\nbuiltin_interfaces/Time stamp\n")
    write(tmp_path / "near_msgs/msg/Inner.msg", "int32 x 5\n")
    search = SearchPath((), [tmp_path])

    outer = read_message("near_msgs/msg/Outer", search)

    assert (outer.type_name, outer.class_name) == ("near_msgs/msg/Outer", "Outer")
    assert [one.type_name for one in inside_out(outer)] == [
        "near_msgs/msg/Inner",
        "builtin_interfaces/msg/Time",
        "near_msgs/msg/Outer",
    ]
    texts = {"near_msgs/msg/Outer": "Inner inner\n", "near_msgs/msg/Inner": "int32 x 5\n"}
    told = read_message_texts("near_msgs/msg/Outer", texts)
    assert told.nested["inner"].definition.fields[0].default == 5
    with pytest.raises(InterfaceError, match="expected 'near_msgs/Inner' on the search path"):
        read_message_texts("near_msgs/msg/Outer", {"near_msgs/msg/Outer": "Inner inner\n"})


def test_a_service_is_read_by_its_type_and_some_need_no_file(tmp_path: Path) -> None:
    write(tmp_path / "near_msgs/srv/Count.srv", "int32 to\n---\nInner[] found\n")
    write(tmp_path / "near_msgs/msg/Inner.msg", "int32 x\n")
    search = SearchPath((), [tmp_path])

    count = read_service("near_msgs/srv/Count", search)
    trigger = read_service("std_srvs/srv/Trigger", search)

    assert (count.request.type_name, count.response.type_name) == (
        "near_msgs/srv/Count_Request",
        "near_msgs/srv/Count_Response",
    )
    assert count.response.nested["found"].type_name == "near_msgs/msg/Inner"
    assert [field.name for field in trigger.response.definition.fields] == ["success", "message"]


@pytest.mark.parametrize(
    ("type_name", "text"),
    [
        ("near_msgs/srv/Nothing", "expected near_msgs/srv/Nothing.srv in .*, found none"),
        ("near_msgs/Nothing", "expected a type like 'std_srvs/srv/Trigger'"),
        ("near_msgs/srv/Cut", "expected one line '---', between request and response, found 0"),
    ],
)
def test_a_service_that_cannot_be_read_is_told(tmp_path: Path, type_name: str, text: str) -> None:
    write(tmp_path / "near_msgs/srv/Cut.srv", "int32 to\n")
    with pytest.raises(InterfaceError, match=text):
        read_service(type_name, SearchPath((), [tmp_path]))


@pytest.mark.parametrize("type_name", ["near_msgs/Outer", "Near/msg/Outer", "near_msgs/srv/Outer"])
def test_another_name_is_not_that_of_a_message(type_name: str) -> None:
    with pytest.raises(InterfaceError, match="expected a type like 'std_msgs/msg/String'"):
        read_message(type_name, SearchPath((), ()))
