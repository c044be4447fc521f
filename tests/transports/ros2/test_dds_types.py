"""The types of actions over our own DDS: where they are found, and which values they take."""

from __future__ import annotations

import array
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction import Action, ActionInfo, ProtocolError, TransportError
from fibaction.action_files import action_source, define_action, load_action
from fibaction.interfaces.ros_types import Int32
from fibaction.types import ros_messages
from fibaction.types.ros_messages import LARGE_ARRAY
from fibaction_transports.ros2.convert import fields
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes, InterfaceFiles

FIBONACCI = "arduinobot_msgs/action/Fibonacci"
EXAMPLES = Path(__file__).parents[3] / "examples/ros2"


@pytest.fixture
def types(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FileTypes:
    """Types that are searched for in a folder of this test only."""
    monkeypatch.delenv("FIBACTION_SEARCH")
    return FileTypes([tmp_path])


def write(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_a_type_is_found_in_the_folders_of_the_environment() -> None:
    found = FileTypes().find(FIBONACCI)
    assert found.type_name == FIBONACCI
    assert found.impl.FeedbackMessage.dds_name == (
        "arduinobot_msgs::action::dds_::Fibonacci_FeedbackMessage_"
    )
    assert found.impl.FeedbackMessage.user_data.startswith(b"typehash=RIHS01_")


def test_a_type_that_this_program_has_loaded_needs_no_folder(
    types: FileTypes, tmp_path: Path
) -> None:
    write(tmp_path, "elsewhere/loaded_msgs/action/Go.action", "int32 x\n---\n---\n")
    load_action(tmp_path / "elsewhere/loaded_msgs/action/Go.action")
    assert types.find("loaded_msgs/action/Go").types[0](x=3).x == 3


@pytest.mark.parametrize("place", ["Go.action", "ros/near_msgs/action/Go.action"])
def test_a_file_beside_the_program_needs_no_folder(
    types: FileTypes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    write(tmp_path, f"program/{place}", "Part part\n---\n---\n")
    write(tmp_path, "program/near_msgs/msg/Part.msg", "int32 x 3\n")
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path / "program")
        assert types.find("near_msgs/action/Go").types[0]().part.x == 3
    monkeypatch.chdir(tmp_path / "program")
    assert FileTypes().find("near_msgs/action/Go").types[0]().part.x == 3


def test_a_module_that_was_written_from_a_file_needs_no_folder(
    types: FileTypes, tmp_path: Path
) -> None:
    go = "written_msgs/action/Go"
    write(tmp_path, f"elsewhere/{go}.action", "Part part  # which\nstring say no\n---\n---\n")
    write(tmp_path, "elsewhere/written_msgs/msg/Part.msg", "# A part.\nint32 x 3\n")
    source = action_source(tmp_path / f"elsewhere/{go}.action")
    with pytest.raises(TransportError, match="is not known here"):
        types.find(go)
    module: dict[str, Any] = {}
    exec(compile(source, "go_types.py", "exec", dont_inherit=True), module)
    found = types.find(go)
    codecs = found.codecs(module["GO"].info)
    assert codecs.goal.to_ros(msgspec.msgpack.encode({})).part.x == 3


def test_a_module_with_broken_definitions_is_an_error(types: FileTypes) -> None:
    define_action("torn_msgs/action/Go", {"torn_msgs/action/Go": "int32\n---\n---\n"})
    with pytest.raises(TransportError, match=r"torn_msgs/action/Go cannot be used: .*int32"):
        types.find("torn_msgs/action/Go")


def test_a_type_that_is_nowhere_says_where_to_put_it(types: FileTypes, tmp_path: Path) -> None:
    with pytest.raises(TransportError) as caught:
        types.find("far_msgs/action/Go")
    assert str(caught.value).startswith(
        "far_msgs/action/Go is not known here: put far_msgs/action/Go.action beside your"
        " program, or into a folder, and name that folder with search=FOLDER or in"
        " FIBACTION_SEARCH (searched:"
    )
    assert str(tmp_path) in str(caught.value)


def test_a_broken_file_is_named_with_its_line(types: FileTypes, tmp_path: Path) -> None:
    write(tmp_path, "bad_msgs/action/Go.action", "int33 x\n---\n---\n")
    with pytest.raises(TransportError, match=r"bad_msgs/action/Go cannot be used: .*Go\.action"):
        types.find("bad_msgs/action/Go")


@pytest.mark.parametrize(("action", "which"), [("", ""), ("go", " 'go'")])
def test_a_name_that_is_not_a_type_of_an_action_is_an_error(
    types: FileTypes, action: str, which: str
) -> None:
    with pytest.raises(TransportError, match=f"give the Action{which} a type_name"):
        types.find("std_msgs/msg/String", action)


EVERYTHING = """
bool flag
byte raw
char letter
uint8 small
int8 tiny
float32 single
float64 double
uint64 large
string<=3 short
string text
wstring wide
byte[] raws
uint8[<=4] octets
char[2] letters
int16[] numbers
float32[3] singles
bool[] flags
string[<=2] texts
float32[] waves
builtin_interfaces/Time stamp
builtin_interfaces/Duration[] spans
Part part
Part[] parts
---
---
"""


@pytest.fixture(params=["with numpy", "without numpy"])
def numpy_or_not(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Convert large arrays by numpy, or as where it is not installed."""
    if request.param == "without numpy":
        for module in (ros_messages, fields):
            monkeypatch.setattr(module, "numpy", lambda: None)


@pytest.fixture
def everything(types: FileTypes, tmp_path: Path) -> Any:
    """The codec of a goal with all kinds of fields, for a user without types of his own."""
    write(tmp_path, "all_msgs/action/All.action", EVERYTHING)
    write(tmp_path, "all_msgs/msg/Part.msg", "int32 x 7\nstring from\n")
    found = types.find("all_msgs/action/All")
    return found.codecs(found.info("all")).goal, found.types[0]


@pytest.mark.usefixtures("numpy_or_not")
def test_values_of_all_kinds_go_through_a_message_and_back(everything: Any) -> None:
    codec, goal = everything
    value = {
        "flag": True,
        "raw": 200,
        "letter": 65,
        "small": 255,
        "tiny": -128,
        "single": 0.5,
        "double": -0.25,
        "large": 2**64 - 1,
        "short": "abc",
        "text": "ä",
        "wide": "ö",
        "raws": b"\1\2",
        "octets": b"\3",
        "letters": b"ab",
        "numbers": [1, -2],
        "singles": [0.5, 1.5, -2.0],
        "flags": [True, False],
        "texts": ["x\0y", ""],
        "waves": [0.5] * LARGE_ARRAY,
        "stamp": {"sec": 3, "nanosec": 4},
        "spans": [{"sec": 1, "nanosec": 2}],
        "part": {"x": 1, "from": "here"},
        "parts": [{"x": 2, "from": "there"}],
    }
    message = codec.to_ros(msgspec.msgpack.encode(value))
    assert message.raws == b"\1\2"
    assert message.numbers == array.array("h", [1, -2])
    assert message.part.from_ == "here"
    assert msgspec.msgpack.decode(codec.from_ros(message)) == value
    assert codec.from_ros(goal()) == msgspec.msgpack.encode(goal())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("raw", b"\7"),
        ("raws", [1, b"\2"]),
        ("octets", [3]),
        ("numbers", [0] * LARGE_ARRAY),
        ("stamp", "1970-01-01T00:00:05Z"),
    ],
)
def test_a_value_may_have_another_form(everything: Any, field: str, value: Any) -> None:
    codec, _ = everything
    codec.to_ros(msgspec.msgpack.encode({field: value}))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("raw", 256),
        ("octets", b"12345"),
        ("octets", [1, 256]),
        ("letters", b"1"),
        ("numbers", [2**15]),
        ("numbers", [-(2**15) - 1] * LARGE_ARRAY),
        ("single", -1e39),
        ("singles", [0.0, 1e300, 0.0]),
        ("texts", ["a"] * 3),
        ("waves", [1e39] * LARGE_ARRAY),
        ("waves", [0.5] * LARGE_ARRAY + ["a"]),
        ("short", "abcd"),
        ("tiny", "text"),
        ("strange", 1),
    ],
)
@pytest.mark.usefixtures("numpy_or_not")
def test_a_value_that_does_not_fit_is_an_error_that_names_its_field(
    everything: Any, field: str, value: Any
) -> None:
    codec, _ = everything
    with pytest.raises(ProtocolError, match=field):
        codec.to_ros(msgspec.msgpack.encode({field: value}))


class Octets(msgspec.Struct):
    """A user's type for octets as numbers, and for each `byte` as bytes."""

    raw: bytes
    raws: list[int]
    singly: list[bytes]
    smalls: list[int]


@pytest.mark.usefixtures("numpy_or_not")
@pytest.mark.parametrize("count", [2, LARGE_ARRAY])
def test_a_user_may_have_octets_as_numbers_or_singly(
    types: FileTypes, tmp_path: Path, count: int
) -> None:
    write(
        tmp_path,
        "oct_msgs/action/Octets.action",
        "byte raw\nbyte[] raws\nbyte[] singly\nuint8[] smalls\n---\n---\n",
    )
    info = ActionInfo(
        "octets",
        "oct_msgs/action/Octets",
        msgspec.json.schema(Octets),
        {"type": "object"},
        {"type": "object"},
    )
    codec = types.find(info.type_name).codecs(info).goal
    value = Octets(b"\7", [200] * count, [b"\1", b"\2"], [200] * count)
    message = codec.to_ros(msgspec.msgpack.encode(value))
    assert (message.raw, message.raws) == (7, bytes([200] * count))
    assert message.singly == b"\1\2"
    message.smalls = bytes(message.smalls)  # as it may be, too
    assert msgspec.msgpack.decode(codec.from_ros(message), type=Octets) == value


class Goal(msgspec.Struct):
    order: Int32
    speed: float = 1.0


class Items(msgspec.Struct):
    partial_sequence: list[int]


class Other(msgspec.Struct):
    partial_sequence: list[int]


def test_a_type_that_differs_from_its_file_is_an_error_that_names_the_fields() -> None:
    action = Action("f", goal=Goal, feedback=Items, result=Other, type_name=FIBONACCI)
    with pytest.raises(TransportError) as caught:
        FileTypes().find(FIBONACCI).codecs(action.info)
    assert "goal.speed: the ROS type has no such field" in str(caught.value)
    assert "result.sequence (int32[]): the action has no such field" in str(caught.value)


def test_a_definition_that_was_loaded_is_one_of_the_versions_and_a_broken_one_is_none(
    types: FileTypes, tmp_path: Path
) -> None:
    write(tmp_path, "two_msgs/action/Go.action", "int32 y\n---\n---\n")
    define_action("two_msgs/action/Go", {"two_msgs/action/Go": "int32 x\n---\n---\n"})
    files = InterfaceFiles([tmp_path])
    texts = [file.goal.definition.text for file in files.versions("two_msgs/action/Go")]
    assert texts == ["int32 x\n", "int32 y\n"]
    define_action("two_msgs/action/Go", {"two_msgs/action/Go": "int33\n---\n---\n"})
    texts = [file.goal.definition.text for file in files.versions("two_msgs/action/Go")]
    assert texts == ["int32 y\n"]


def test_an_action_is_served_with_types_of_others_that_are_known_whole(types: FileTypes) -> None:
    whole = FileTypes([EXAMPLES]).find(FIBONACCI)
    assert types.can_serve(whole)
    assert not types.can_serve(types.find_to_follow("near_msgs/action/Unknown"))
