"""`CdrCodec`: where each value is, what is accepted, and round trips of any definition."""

from __future__ import annotations

import math
import struct
from array import array
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.interfaces import make_structs
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.streams import HEADER, CdrError
from tests.transports.cdr.definitions import POSES, TESTS, Goal, action_of
from tests.transports.cdr.generated import GeneratedGoal, goals
from tests.transports.cdr.recorded import recorded

EVERYTHING = TESTS / "ros2/fibaction_test_msgs/action/Everything.action"


# The places of values


@pytest.mark.parametrize(
    ("text", "fields", "body"),
    [
        ("bool a\nbool b", {"a": True}, "01000000"),
        ("byte a\nchar b\nuint8 c\nint8 d", {"a": 1, "b": 2, "c": 3, "d": -1}, "010203ff"),
        ("int8 a\nint16 b", {"a": 1, "b": 2}, "01000200"),
        ("int8 a\nint32 b", {"a": 1, "b": 2}, "0100000002000000"),
        ("int32 a\nfloat64 b", {"a": 1, "b": 1.0}, "0100000000000000000000000000f03f"),
        ("int8 a\nuint64 b", {"a": 1, "b": 2}, "01000000000000000200000000000000"),
        ("float32 a", {"a": 0.5}, "0000003f"),
        ("string a", {"a": "map"}, "040000006d617000"),
        ("string a", {"a": ""}, "0100000000000000"),
        ("string a\nint8 b", {"a": "é", "b": 7}, "03000000c3a90007"),
        ("wstring a", {"a": "é"}, "01000000e9000000"),
        ("wstring a", {"a": "😀"}, "020000003dd8000000de0000"),
        ("int16[] a", {"a": [1, -1]}, "020000000100ffff"),
        ("float64[] a", {"a": [1.0]}, "0100000000000000000000000000f03f"),
        ("float64[] a\nint8 b", {"a": [], "b": 1}, "0000000001000000"),
        ("int16[2] a\nint8 b", {"a": [1, 2], "b": 3}, "0100020003000000"),
        ("bool[] a", {"a": [True, False]}, "0200000001000000"),
        ("uint8[] a", {"a": b"\1\2"}, "0200000001020000"),
        ("uint8[3] a\nint8 b", {"a": b"\1\2\3", "b": 4}, "01020304"),
        ("string[] a", {"a": ["a", "b"]}, "02000000020000006100000002000000" + "62000000"),
        ("string[2] a", {"a": ["", ""]}, "01000000000000000100000000000000"),
        ("", {}, "00000000"),
        ("int8 a\nint8 class", {"a": 1, "class_": 2}, "01020000"),
    ],
)
def test_each_kind_of_field_has_its_place(text: str, fields: dict[str, Any], body: str) -> None:
    goal = Goal(text)
    assert goal.body(**fields) == body
    assert goal.decoded(body) == goal.type(**fields)


def test_the_header_counts_the_bytes_that_pad_the_payload() -> None:
    goal = Goal("uint8[] data")
    lengths = {}
    for length in range(5):
        payload = goal.encoded(data=bytes(length))
        assert payload[:3] == HEADER[:3]
        lengths[length] = (payload[3], len(payload))
    assert lengths == {0: (0, 8), 1: (3, 12), 2: (2, 12), 3: (1, 12), 4: (0, 12)}


def test_padding_and_what_lies_behind_the_message_are_left_alone() -> None:
    goal = Goal("uint8[] data")
    for header, behind in [("00010003", "ffffff"), ("00010000", "ffffff"), ("00010000", "ff" * 9)]:
        assert goal.decoded("0100000007" + behind, header).data == b"\x07"


@pytest.mark.parametrize(
    "fields",
    [
        "float64 a\nfloat64 b",  # no gaps between elements
        "int32 a\nint8 b",  # a gap before all but the first
        "int8 a\nint64 b",
        "int8 a\nfloat64 b\nint8 c",
        "uint8[3] a\nint16 b",
        "bool a",
        "string a",
    ],
)
@pytest.mark.parametrize("count", [0, 1, 2, 3, 7])
@pytest.mark.parametrize("before", ["", "x", "xxxx"])
def test_elements_lie_where_they_would_one_by_one(fields: str, count: int, before: str) -> None:
    def goal_with(elements: str) -> Goal:
        return Goal(f"string before\n{elements}", {"made_msgs/Element": fields})

    many = goal_with("Element[] all")
    # The same elements, as fields after their number.
    singly = goal_with("uint32 count\n" + "\n".join(f"Element e{n}" for n in range(count)))
    value = many.structs["Element"]()
    body = many.body(before=before, all=[value] * count)
    assert body == singly.body(before=before, count=count, **{f"e{n}": value for n in range(count)})
    assert many.decoded(body).all == [value] * count


# The bytes of ROS


def codec_of_recorded(name: str) -> CdrCodec:
    if name == "PoseStamped":
        goal = Goal("geometry_msgs/PoseStamped pose", POSES)
        return CdrCodec(goal.message.nested["pose"], goal.structs)
    file = EVERYTHING if name.startswith("Everything") else EVERYTHING.with_name("Nothing.action")
    # Its feedback nests messages of ROS, and its goal and its result do not.
    text = file.read_text().rpartition("---\n")[0] + "---\n"
    action = action_of(text)
    part = action.result if name.endswith("Result") else action.goal
    return CdrCodec(part, make_structs(action))


RECORDED_TYPES = ["PoseStamped", "Nothing_Goal", "Everything_Goal", "Everything_Result"]


@pytest.mark.parametrize("name", RECORDED_TYPES)
def test_messages_of_ros_are_read_and_written_as_ros_does(name: str) -> None:
    codec = codec_of_recorded(name)
    value = codec.decode(recorded(name))
    assert codec.decode(recorded(name, gap="ff")) == value
    encoded = codec.encode(value)
    assert encoded[4:].startswith(recorded(name)[4:])
    assert not encoded[len(recorded(name)) :].strip(b"\0")


def test_the_values_of_a_recorded_message_are_those_that_ros_was_given() -> None:
    pose = codec_of_recorded("PoseStamped").decode(recorded("PoseStamped"))
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (1, 2)
    assert pose.header.frame_id == "map"
    assert (pose.pose.position.x, pose.pose.orientation.w) == (1.5, 1.0)
    goal = codec_of_recorded("Everything_Goal").decode(recorded("Everything_Goal"))
    assert (goal.a_bool, goal.a_byte, goal.a_char, goal.a_string) == (True, 2, 65, "é")
    assert (goal.a_float64, goal.an_int8, goal.a_wstring) == (-2.25, -1, "aé😀")
    assert (goal.default_bytes, goal.default_strings) == (b"\1\2\xff", ["one", "two"])


# Big-endian payloads


def test_a_payload_of_the_other_byte_order_is_read() -> None:
    goal = Goal("int8 a\nint32 b\nfloat64[] c\nstring d\nint16[2] e\nwstring f\nbool g")
    body = (
        "01000000" + "00000002" + "00000001" + "00000000" + "3ff0000000000000"  # a, b, c
        "000000046d617000" + "00030004" + "00000001000000e9" + "01"  # d, e, f, g
    )
    value = goal.type(a=1, b=2, c=[1.0], d="map", e=[3, 4], f="é", g=True)
    assert goal.decoded(body, "00000000") == value
    assert goal.decoded(goal.body(**{n: getattr(value, n) for n in "abcdefg"})) == value


def test_arrays_of_the_other_byte_order_are_swapped_as_arrays_too() -> None:
    goal = Goal("float32[] a", as_arrays=True)
    assert goal.decoded("000000013f000000", "00000000").a == array("f", [0.5])


# Arrays of numbers


def test_arrays_may_be_decoded_as_arrays() -> None:
    goal = Goal(
        "int16[] a\nfloat64[2] b\nbool[] c\nuint8[] d\nint8[] e\nstring[] f", as_arrays=True
    )
    value = goal.decoded(goal.body(a=[1, -1], b=[0.5, 1.5], c=[True], d=b"1", f=["x"]))
    assert value.a == array("h", [1, -1])
    assert value.b == array("d", [0.5, 1.5])
    assert (value.c, value.d, value.e, value.f) == ([True], b"1", array("b"), ["x"])
    assert goal.codec.decode(goal.codec.encode(value)) == value


def test_floats_that_are_not_numbers_are_kept() -> None:
    goal = Goal("float32 a\nfloat32[] b")
    value = goal.decoded(goal.body(a=math.inf, b=[-math.inf, math.nan]))
    assert (value.a, value.b[0]) == (math.inf, -math.inf)
    assert math.isnan(value.b[1])


# Any definition


@given(goals(), st.data())
def test_what_was_encoded_is_decoded_as_it_was(goal: GeneratedGoal, data: st.DataObject) -> None:
    value = data.draw(goal.values)
    payload = goal.codec.encode(value)
    assert len(payload) % 4 == 0
    assert goal.codec.decode(payload) == value


@given(goals(), st.data())
def test_no_payload_does_more_than_raise_the_one_error(
    goal: GeneratedGoal, data: st.DataObject
) -> None:
    payload = bytearray(goal.codec.encode(data.draw(goal.values)))
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.integers(0, len(payload) - 1))
        payload[place] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    with suppress(CdrError):
        assert isinstance(goal.codec.decode(cut), goal.type)


def test_a_large_payload_is_not_copied_number_by_number() -> None:
    goal = Goal("int8[] grid")
    cells = array("b", bytes(1_000_000))
    payload = goal.encoded(grid=cells)
    assert payload[4:] == struct.pack("<I", 1_000_000) + cells.tobytes()
