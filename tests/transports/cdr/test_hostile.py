"""Malformed payloads and values that do not fit: one error, with type, field and cause."""

from __future__ import annotations

import tracemalloc
from array import array
from typing import Any

import pytest

from fibaction.words.errors import ProtocolError
from fibaction_transports.cdr.streams import MAX_VALUES, CdrError
from tests.transports.cdr.definitions import POSES, Goal

MANY = "ffffffff"


def error_of(goal: Goal, body: str, header: str = "00010000") -> str:
    with pytest.raises(CdrError) as caught:
        goal.decoded(body, header)
    return str(caught.value).removeprefix("made_msgs/action/Made_Goal")


@pytest.mark.parametrize(
    ("text", "body", "error"),
    [
        ("int8 a\nint32 b", "01000000", ".b: 4 bytes expected, 0 bytes left"),
        ("int8 a\nint32 b", "", ".a: 1 bytes expected, 0 bytes left"),
        ("int8 a\nfloat64 b", "0100", ".b: 8 bytes expected, 0 bytes left"),
        ("bool a\nbool b", "0102", ".b: a bool is 0 or 1, not 2"),
        ("bool[] a", "020000000105", ".a: a bool is 0 or 1, not 5"),
        ("bool[2] a", "0103", ".a: a bool is 0 or 1, not 3"),
        ("string a", "", ".a: 4 bytes expected, 0 bytes left"),
        ("string a", "0500000061", ".a: 5 bytes expected, 1 bytes left"),
        ("string a", MANY, ".a: 4294967295 bytes expected, 0 bytes left"),
        ("string a", "0200000061620000", ".a: a string without a NUL at its end"),
        (
            "string a",
            "02000000ff00",
            ".a: a string that is not UTF-8: invalid start byte at byte 0",
        ),
        ("string<=2 a", "0400000061626300", ".a: a string of 3 characters, of at most 2"),
        ("wstring a", MANY + "00000000", ".a: 17179869180 bytes expected, 4 bytes left"),
        ("wstring a", "0100000000d80000", ".a: a wide string that is not UTF-16"),
        ("wstring a", "0100000000001100", ".a: a wide string that is not UTF-16"),
        ("wstring<=1 a", "020000006100000062000000", ".a: a string of 2 characters, of at most 1"),
        ("uint8[] a", MANY + "01", ".a: 4294967295 bytes expected, 1 bytes left"),
        ("uint8[<=2] a", "03000000010203", ".a: 3 elements, of at most 2"),
        ("uint8[3] a", "0102", ".a: 3 bytes expected, 2 bytes left"),
        ("float64[] a", MANY, ".a: 34359738360 bytes expected, 0 bytes left"),
        ("float64[] a", "01000000" + "00" * 8, ".a: 8 bytes expected, 4 bytes left"),
        ("float64[2] a", "00" * 15, ".a: 16 bytes expected, 15 bytes left"),
        ("int16[<=2] a", "03000000" + "00" * 6, ".a: 3 elements, of at most 2"),
        ("string[] a", MANY, ".a: 17179869180 bytes expected, 0 bytes left"),
        ("string[] a", "020000000000000009000000", ".a[1]: 9 bytes expected, 0 bytes left"),
        ("string[<=1] a", "020000000000000000000000", ".a: 2 elements, of at most 1"),
        ("string[2] a", "00000000", ".a: 8 bytes expected, 4 bytes left"),
    ],
)
def test_a_malformed_payload_raises_an_error_with_its_field(
    text: str, body: str, error: str
) -> None:
    assert error_of(Goal(text), body) == error


def test_the_path_leads_through_messages_and_arrays() -> None:
    goal = Goal("geometry_msgs/PoseStamped[] path\ngeometry_msgs/PoseStamped last", POSES)
    pose = "0100000002000000" + "0200000061000000" + "00" * 56
    assert error_of(goal, "02000000" + "00000000" + pose + "0300000004000000" + "09000000") == (
        ".path: 136 bytes expected, 88 bytes left"
    )
    assert error_of(goal, "00000000" + "0100000002000000" + "09000000") == (
        ".last.header.frame_id: 9 bytes expected, 0 bytes left"
    )
    goal = Goal(
        "Inner[] all", {"made_msgs/Inner": "Innermost[2] two", "made_msgs/Innermost": "bool x"}
    )
    assert error_of(goal, "02000000" + "00000007") == ".all[1].two[1].x: a bool is 0 or 1, not 7"


@pytest.mark.parametrize(
    ("header", "error"),
    [
        ("", "a payload of 0 bytes, which has no header of 4 bytes"),
        ("000100", "a payload of 3 bytes, which has no header of 4 bytes"),
        ("00030000", "encapsulation 0x0003; only plain CDR, 0x0000 and 0x0001, is read"),
        ("00070000", "encapsulation 0x0007; only plain CDR, 0x0000 and 0x0001, is read"),
        ("01000000", "encapsulation 0x0100; only plain CDR, 0x0000 and 0x0001, is read"),
    ],
)
def test_another_encoding_is_named(header: str, error: str) -> None:
    assert error_of(Goal("int8 a"), "", header) == f": {error}"


def test_of_many_elements_the_one_that_is_cut_off_is_named() -> None:
    goal = Goal("Element[] all", {"made_msgs/Element": "int32 a\nint8 b"})
    whole = goal.encoded(all=[goal.structs["Element"]()] * 3)
    assert error_of(goal, whole[4:-8].hex()) == ".all[2].a: 4 bytes expected, 0 bytes left"


def test_elements_of_one_byte_are_limited_in_number() -> None:
    goal = Goal("Empty[] all", {"made_msgs/Empty": ""})
    most = MAX_VALUES
    assert error_of(goal, (most + 1).to_bytes(4, "little").hex() + "00" * (most + 1)) == (
        ".all: more than 1,000,000 strings and nested messages in one payload"
    )


def test_the_limit_is_one_for_all_arrays_of_a_payload() -> None:
    goal = Goal(
        "Pair[] pairs\nPair[] more", {"made_msgs/Pair": "Empty a\nEmpty b", "made_msgs/Empty": ""}
    )
    half = 200_000
    body = (half.to_bytes(4, "little") + bytes(2 * half)).hex()
    assert error_of(goal, body * 2) == (
        ".more: more than 1,000,000 strings and nested messages in one payload"
    )


@pytest.mark.parametrize("text", ["uint8[] a", "float64[] a", "string[] a", "string a", "bool[] a"])
def test_nothing_is_allocated_for_what_is_only_announced(text: str) -> None:
    goal = Goal(text)
    payload = bytes.fromhex("00010000" + "ffffff7f" + "00" * 60)
    tracemalloc.start()
    try:
        with pytest.raises(CdrError):
            goal.codec.decode(payload)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 100_000


# Values


def unfit(goal: Goal, **fields: Any) -> str:
    with pytest.raises(CdrError) as caught:
        goal.encoded(**fields)
    return str(caught.value).removeprefix("made_msgs/action/Made_Goal")


@pytest.mark.parametrize(
    ("text", "value", "error"),
    [
        ("bool a", 1, "a bool expected, found 1"),
        ("bool a", None, "a bool expected, found None"),
        ("string a", b"x", "a str expected, found b'x'"),
        ("string a", "a\0b", "a string with a NUL in it, where readers of ROS would cut it off"),
        ("string a", "\ud800", "a string that UTF-8 cannot hold: surrogates not allowed"),
        ("string<=2 a", "abc", "a string of 3 characters, of at most 2"),
        ("wstring a", "\ud800", "a string that UTF-16 cannot hold: surrogates not allowed"),
        ("wstring a", 5, "a str expected, found 5"),
        ("wstring<=1 a", "ab", "a string of 2 characters, of at most 1"),
        ("uint8[2] a", b"x", "2 elements expected, found 1"),
        ("uint8[2] a", 2, "a list of numbers expected, found int"),
        ("uint8[] a", 2, "a list of numbers expected, found int"),
        ("uint8[] a", "xy", "a list of numbers expected, found str"),
        ("uint8[<=1] a", b"xy", "2 elements, of at most 1"),
        ("int16[] a", b"xy", "a list of numbers expected, found bytes"),
        ("int16[] a", None, "a list of numbers expected, found NoneType"),
        ("int16[2] a", [1], "2 elements expected, found 1"),
        ("int16[<=1] a", [1, 2], "2 elements, of at most 1"),
        ("string[<=1] a", ["a", "b"], "2 elements, of at most 1"),
        ("string[] a", "ab", "a list expected, found str"),
        ("string[] a", None, "a list expected, found NoneType"),
    ],
)
def test_a_value_that_does_not_fit_raises_an_error_with_its_field(
    text: str, value: Any, error: str
) -> None:
    assert unfit(Goal(text), a=value) == f".a: {error}"


@pytest.mark.parametrize(
    ("text", "value", "place"),
    [
        ("int8 a", 128, ".a: 128 does not fit"),
        ("uint16 a", -1, ".a: -1 does not fit"),
        ("uint64 a", 2**64, ".a: 18446744073709551616 does not fit"),
        ("int32 a", "1", ".a: '1' does not fit"),
        ("int32 a", 1.0, ".a: 1.0 does not fit"),
        ("float32 a", 1e39, ".a: 1e+39 does not fit"),
        ("float64 a", None, ".a: None does not fit"),
        ("int8[] a", [0, 128], ".a[1]: 128 does not fit"),
        ("float32[] a", [0.0, 1e39], ".a[1]: 1e+39 does not fit"),
        ("float64[] a", ["x" * 1000], ".a[0]: 'xxx"),
        ("bool[] a", [True, 2], ".a[1]: a bool expected, found 2"),
        ("string[] a", ["", 5], ".a[1]: a str expected, found 5"),
        ("uint8[] a", [1, 256], ".a[1]: 256 does not fit"),
    ],
)
def test_a_number_that_does_not_fit_is_named(text: str, value: Any, place: str) -> None:
    text = unfit(Goal(text), a=value)
    assert text.startswith(place)
    assert len(text) < 300


def test_of_several_numbers_the_one_that_does_not_fit_is_named() -> None:
    goal = Goal(
        "Empty none\nint8 a\nInner inner\nint8 b",
        {"made_msgs/Empty": "", "made_msgs/Inner": "int8 x\nint8 y"},
    )
    inner = goal.structs["Inner"](x=1, y=1000)
    assert unfit(goal, a=1, inner=inner).startswith(".inner.y: 1000 does not fit")


def test_of_many_elements_the_one_that_does_not_fit_is_named() -> None:
    goal = Goal("Element[] all", {"made_msgs/Element": "int8 a\nint8 b"})
    element = goal.structs["Element"]
    assert unfit(goal, all=[element(), element(), element(b=200)]).startswith(".all[2].b: 200 does")
    assert unfit(goal, all=[element(), element(), None]).startswith(".all[2]: a message expected")


@pytest.mark.parametrize(
    ("kind", "value", "error"),
    [
        ("bool", 5, "a bool expected, found 5"),
        ("uint8[2]", b"x", "2 elements expected, found 1"),
    ],
)
def test_many_elements_are_checked_as_one_is(kind: str, value: Any, error: str) -> None:
    goal = Goal("Element[] all", {"made_msgs/Element": f"{kind} a"})
    element = goal.structs["Element"]
    assert unfit(goal, all=[element(), element(), element(a=value)]) == f".all[2].a: {error}"


def test_a_message_that_is_not_one_is_named() -> None:
    goal = Goal("Inner inner\nInner[] all", {"made_msgs/Inner": "int8 x\nint8 y"})
    assert unfit(goal, inner=None) == (
        ": a message expected: 'NoneType' object has no attribute 'x'"
    )
    assert unfit(goal, all=[goal.structs["Inner"](), 5]) == (
        ".all[1]: a message expected: 'int' object has no attribute 'x'"
    )


def test_the_error_has_its_parts_and_is_one_of_the_package_and_a_value_error() -> None:
    with pytest.raises(CdrError) as caught:
        Goal("int16[<=1] a").decoded("02000000")
    error = caught.value
    assert isinstance(error, ProtocolError)
    assert isinstance(error, ValueError)
    assert (error.type_name, error.field) == ("made_msgs/action/Made_Goal", "a")
    assert error.problem == "2 elements, of at most 1"
    assert str(CdrError("no place")) == "no place"
    assert str(CdrError("two\nlines")) == "two\\x0alines"


# What is taken for an array of numbers


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("int16[] a", [1, 2]),
        ("int16[] a", (1, 2)),
        ("int16[] a", array("h", [1, 2])),
        ("int16[] a", array("i", [1, 2])),
        ("int16[] a", memoryview(array("h", [1, 2]))),
        ("int16[] a", memoryview(array("h", [1, 7, 2]))[::2]),
        ("int16[] a", {1: None, 2: None}),
        ("uint8[] a", [1, 2]),
        ("uint8[] a", bytearray(b"\1\2")),
        ("uint8[] a", memoryview(b"\1\2")),
        ("uint8[] a", array("H", [1, 2])),
        ("uint8[2] a", array("B", [1, 2])),
        ("int64[] a", array("l", [1, 2])),
        ("bool[] a", memoryview(b"\1\0").cast("?")),
    ],
)
def test_numbers_may_be_in_a_list_or_in_memory(text: str, value: Any) -> None:
    goal = Goal(text)
    decoded = goal.codec.decode(goal.encoded(a=value)).a
    assert list(decoded) == list(value)


def test_empty_arrays_are_taken_too() -> None:
    goal = Goal("int16[] a\nuint8[] b\nfloat64[] c")
    assert goal.body(a=array("h"), b=bytearray(), c=[]) == "00" * 12


def test_memory_of_several_dimensions_is_not_taken_for_a_row() -> None:
    square = memoryview(bytes(4)).cast("b", (2, 2))
    error = ".a: one dimension expected, found 2: flatten the array"
    assert unfit(Goal("int8[] a"), a=square) == error
