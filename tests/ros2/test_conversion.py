from __future__ import annotations

import array
import contextlib
import datetime
import enum
import math
import re
import sys
import tracemalloc
import uuid
from collections.abc import Iterator
from functools import reduce
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import example, given, settings, strategies
from msgspec import Meta

from fibaction import Action
from fibaction.types.action import ActionInfo
from fibaction.types.ros_messages import LARGE_ARRAY
from fibaction.words.errors import ProtocolError, TransportError
from fibaction_transports.ros2 import message_structs
from fibaction_transports.ros2.convert.conversion import RosCodec, RosCodecs
from fibaction_transports.ros2.convert.message_classes import message_kind
from fibaction_transports.ros2.convert.schemas import UserSchema
from fibaction_transports.ros2.message_structs import message_types
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes

definition: Any = import_module("rosidl_parser.definition")
numpy: Any = import_module("numpy")
serialization: Any = import_module("rclpy.serialization")

find = RclpyTypes().find
ROS_CLASS: Any = import_module("fibaction_test_msgs.action").Everything
EVERYTHING = find("fibaction_test_msgs/action/Everything")
NOTHING = find("fibaction_test_msgs/action/Nothing")
PARTS = ("goal", "feedback", "result")
UNTYPED = EVERYTHING.codecs(ActionInfo("everything"))
"""The codecs for an end without schemas."""
TYPED = EVERYTHING.codecs(EVERYTHING.info("everything"))
"""The codecs for an end that has the types which are made from the ROS type."""

encode = msgspec.msgpack.encode
decode = msgspec.msgpack.decode


def codecs(**types: Any) -> RosCodecs:
    """The codecs for an end whose types differ from those of ROS in some fields."""
    return EVERYTHING.codecs(action(**types).info)


def action(**types: Any) -> Action[Any, Any, Any]:
    """An action whose types differ from those of ROS in some fields, of which None leaves one out.

    A type, or a type and a default.
    """
    made: list[Any] = []
    for part, known in zip(PARTS, EVERYTHING.types, strict=True):
        fields: list[Any] = []
        for field in msgspec.structs.fields(known):
            other = types.get(field.name, (field.type, msgspec.NODEFAULT))
            if other is not None:
                fields.append((field.name, *(other if isinstance(other, tuple) else (other,))))
        made.append(msgspec.defstruct(part.title(), fields, kw_only=True))
    goal, feedback, result = made
    name = EVERYTHING.type_name
    return Action("everything", goal=goal, feedback=feedback, result=result, type_name=name)


def mismatches(**types: Any) -> list[str]:
    """Return the lines of the error for such an action."""
    with pytest.raises(TransportError) as caught:
        codecs(**types)
    first, *lines = str(caught.value).splitlines()
    assert first == (
        "action 'everything' does not match its ROS type fibaction_test_msgs/action/Everything:"
    )
    return [line.removeprefix("  ").removesuffix(";") for line in lines]


def codec_of(found: RosCodecs, name: str) -> RosCodec:
    """The codec of the message that has the field."""
    for part, known in zip(PARTS, EVERYTHING.types, strict=True):
        if name in known.__struct_fields__:
            codec: RosCodec = getattr(found, part)
            return codec
    raise AssertionError(name)


def put(found: RosCodecs, name: str, value: Any) -> Any:
    """Return ROS's value of a field that was in a payload."""
    return getattr(codec_of(found, name).to_ros(encode({name: value})), name)


def read(found: RosCodecs, name: str, **fields: Any) -> Any:
    """Return the payload's value of a field that was in a ROS message."""
    codec = codec_of(found, name)
    message = codec.to_ros(None)
    for field, value in fields.items():
        *path, last = field.split("__")
        setattr(reduce(getattr, path, message), last, value)
    return decode(codec.from_ros(message))[name]


def over_the_wire(message: Any) -> Any:
    """The message as it arrives at the other end of ROS."""
    return serialization.deserialize_message(
        serialization.serialize_message(message), type(message)
    )


# From payloads to ROS, and back

GREATEST = 3.4028234663852886e38  # of a float32; ROS compares with fewer digits

BITS = (8, 16, 32, 64)
NUMBERS = {
    **{f"int{n}": strategies.integers(-(2**n) // 2, 2**n // 2 - 1) for n in BITS},
    **{f"uint{n}": strategies.integers(0, 2**n - 1) for n in BITS},
    "octet": strategies.integers(0, 2**8 - 1),
    "boolean": strategies.booleans(),
    # Without the greatest, which ROS rejects where it checks.
    "float": strategies.floats(width=32, allow_nan=False).filter(lambda x: abs(x) != GREATEST),
    "double": strategies.floats(allow_nan=False),
}
OF_BYTES = ("uint8", "octet")


def values(slot: Any) -> strategies.SearchStrategy[Any]:
    """Values that a field can have, by what ROS itself says of its type."""
    if isinstance(slot, definition.NamespacedType):
        return structs(getattr(import_module(".".join(slot.namespaces)), slot.name))
    if isinstance(slot, definition.AbstractGenericString):
        most = slot.maximum_size if slot.has_maximum_size() else 20
        wide = isinstance(slot, definition.AbstractWString)
        without = "" if wide else "\0"
        characters = strategies.characters(codec="utf-8", exclude_characters=without)
        return strategies.text(characters, max_size=most)
    if isinstance(slot, definition.BasicType):
        return NUMBERS[slot.typename]
    if isinstance(slot, definition.Array):
        size = {"min_size": slot.size, "max_size": slot.size}
    else:
        bounded = isinstance(slot, definition.BoundedSequence)
        size = {"max_size": slot.maximum_size if bounded else 3}
    if getattr(slot.value_type, "typename", None) in OF_BYTES:
        return strategies.binary(**size)
    return strategies.lists(values(slot.value_type), **size)


def structs(cls: Any) -> strategies.SearchStrategy[dict[str, Any]]:
    slots = zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True)
    return strategies.fixed_dictionaries({name: values(slot) for name, slot in slots})


def check_round_trip(part: str, value: dict[str, Any]) -> None:
    payload = encode(value)
    for found in (UNTYPED, TYPED):
        codec: RosCodec = getattr(found, part)
        message = codec.to_ros(payload)
        assert decode(codec.from_ros(message)) == value
        assert decode(codec.from_ros(over_the_wire(message))) == value


@pytest.mark.parametrize("part", PARTS)
@given(strategies.data())
def test_single_values_nested_messages_and_arrays_come_back_as_they_were(
    part: str, data: strategies.DataObject
) -> None:
    check_round_trip(part, data.draw(structs(getattr(ROS_CLASS, part.title()))))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, GREATEST])
@pytest.mark.parametrize(
    ("name", "count"),
    [("a_float32", 0), ("a_float64", 0), ("float32s", 3), ("float64s", LARGE_ARRAY)],
)
def test_a_float_may_be_infinite_or_none_or_just_great(name: str, count: int, value: float) -> None:
    codec = codec_of(UNTYPED, name)
    given = [value] * count or value
    message = over_the_wire(codec.to_ros(encode({name: given})))
    assert repr(decode(codec.from_ros(message))[name]) == repr(given)


def test_a_float_and_an_array_of_floats_take_ints() -> None:
    assert put(UNTYPED, "float64s", [1, 2]) == array.array("d", [1, 2])
    assert repr(put(UNTYPED, "a_float32", 3)) == "3.0"


def test_arrays_are_what_ros_has_them_in() -> None:
    fixed, unbounded = put(UNTYPED, "fixed_int32s", [1, 2, 3]), put(UNTYPED, "int32s", [1, 2])
    assert isinstance(fixed, numpy.ndarray)
    assert (fixed.dtype, fixed.tolist()) == (numpy.int32, [1, 2, 3])
    assert unbounded == array.array("i", [1, 2])


def test_a_message_can_be_filled_again() -> None:
    codec = UNTYPED.feedback
    message = codec.to_ros(encode({"point": {"x": 1.0, "y": 2.0}}))
    codec.fill(message, encode({"point": {"x": 3.0}}))
    assert (message.point.x, message.point.y) == (3.0, 2.0)


# What is left out


def test_nothing_at_all_gives_what_ros_has_by_default() -> None:
    for part in PARTS:
        codec: RosCodec = getattr(UNTYPED, part)
        plain = getattr(ROS_CLASS, part.title())()
        assert repr(codec.to_ros(None)) == repr(plain)
        assert repr(codec.to_ros(b"\x80")) == repr(plain)


def test_a_field_that_is_left_out_has_the_default_of_ros() -> None:
    message = UNTYPED.goal.to_ros(encode({"an_int32": 5}))
    assert message.an_int32 == 5
    assert message.default_int32 == -32
    assert message.default_fixed.tolist() == [1, 2, 3]


def test_a_field_that_is_left_out_has_the_default_of_the_user_if_there_is_one() -> None:
    found = codecs(
        default_int32=(int, 7),
        default_bytes=(bytes, b"\xfe"),
        default_strings=(list[str], msgspec.field(default_factory=list)),
        time=(
            Annotated[datetime.datetime, Meta(tz=True)],
            datetime.datetime.fromtimestamp(9, datetime.UTC),
        ),
    )
    goal = found.goal.to_ros(b"\x80")
    assert (goal.default_int32, goal.default_strings) == (7, [])
    assert goal.default_bytes.tobytes() == b"\xfe"
    assert found.feedback.to_ros(b"\x80").time.sec == 9


@pytest.mark.parametrize(
    ("name", "type_", "default"),
    [
        ("default_int8", int, 300),
        ("default_float32", float, 1e39),
        ("default_fixed", list[int], msgspec.field(default_factory=list)),
        ("default_uint64", int, 2**64),
        ("a_byte", bytes, b""),
    ],
)
def test_a_field_whose_default_ros_cannot_hold_may_not_be_left_out(
    name: str, type_: Any, default: Any
) -> None:
    with pytest.raises(ProtocolError, match=f"missing required field `{name}`"):
        codecs(**{name: (type_, default)}).goal.to_ros(b"\x80")


@pytest.mark.parametrize(
    ("name", "type_", "default"),
    [
        ("default_int32", int | None, -32),
        ("default_string", str | None, 'it\'s "said"'),
        ("float64s", list[float] | None, array.array("d")),
        ("default_bytes", bytes | None, array.array("B", [1, 2, 255])),
    ],
)
def test_null_stands_for_the_default_of_ros_where_the_users_type_allows_it(
    name: str, type_: Any, default: Any
) -> None:
    assert put(codecs(**{name: type_}), name, None) == default
    unless_told = codecs(**{name: (type_, None)})
    assert put(unless_told, name, None) == default
    assert getattr(codec_of(unless_told, name).to_ros(b"\x80"), name) == default
    with pytest.raises(ProtocolError, match=rf"got `None` - at `\$\.{name}`"):
        put(UNTYPED, name, None)


def test_a_nested_message_may_be_null() -> None:
    class Point(msgspec.Struct):
        x: float
        y: float
        z: float | None

    found = codecs(point=Point | None)
    assert put(found, "point", None).x == 0
    assert put(found, "point", Point(1.0, 2.0, None)).y == 2
    assert read(found, "point", point__z=3.0) == {"x": 0.0, "y": 0.0, "z": 3.0}


# What does not fit


@pytest.mark.parametrize(
    ("name", "value", "place", "text"),
    [
        *(
            (f"an_int{n}", 2 ** (n - 1), "", f"Expected `int` <= {2 ** (n - 1) - 1}")
            for n in (8, 16, 32, 64)
        ),
        *((f"a_uint{n}", 2**n, "", f"Expected `int` <= {2**n - 1}") for n in (8, 16, 32)),
        *((f"a_uint{n}", -1, "", "Expected `int` >= 0") for n in (8, 16, 32, 64)),
        ("a_bool", 1, "", "Expected `bool`, got `int`"),
        ("a_byte", 256, "", "Expected `int` <= 255"),
        ("a_float32", 1e39, "", "Expected `float` of 32 bits"),
        ("a_float64", "1", "", "Expected `float`, got `str`"),
        ("an_int32", 1.5, "", "Expected `int`, got `float`"),
        ("a_string", "a\0b", "", "Expected `str` without a NUL"),
        ("a_bounded_string", "123456", "", "Expected `str` of length <= 5"),
        ("fixed_bools", [True], "", "Expected `array` of length >= 2"),
        ("fixed_bytes", b"abc", "", "Expected `bytes` of length <= 2"),
        ("fixed_int32s", [1, 2, 2**31], "[2]", "Expected `int` <= 2147483647"),
        ("bounded_int16s", [0] * 6, "", "Expected `array` of length <= 5"),
        ("int8s", b"ab", "", "Expected `array`, got `bytes`"),
        ("float64s", [1.0, [2.0]], "[1]", "Expected `float`, got `array`"),
        ("int32s", 1, "", "Expected `array`, got `int`"),
        ("int32s", [0] * LARGE_ARRAY + [2**31], f"[{LARGE_ARRAY}]", "Expected `int` <= 2147483647"),
        ("int32s", [0.5] * LARGE_ARRAY, "[0]", "Expected `int`, got `float`"),
        ("float32s", [1e39] * LARGE_ARRAY, "[0]", "Expected `float` of 32 bits"),
        ("fixed_int32s", [0] * LARGE_ARRAY, "", "Expected `array` of length <= 3"),
        ("bounded_int32s", [0] * LARGE_ARRAY, "", "Expected `array` of length <= 5"),
        ("point", {"x": "1"}, ".x", "Expected `float`, got `str`"),
        (
            "pose",
            {"header": {"stamp": {"sec": 2**31}}},
            ".header.stamp.sec",
            "Expected `int` <= 2147483647",
        ),
        (
            "parts",
            [{"name": "a"}, {"name": "b", "labels": ["", "\0"]}],
            "[1].labels[1]",
            "Expected `str` without a NUL",
        ),
        ("parts", [{"colour": 1}], "[0]", "Object contains unknown field `colour`"),
        ("fixed_parts", [{}], "", "Expected `array` of length >= 2"),
        (
            "time",
            datetime.datetime(2024, 1, 1),
            "",
            "Expected `datetime` with a timezone component",
        ),
        (
            "times",
            [{}, datetime.datetime(1900, 1, 1, tzinfo=datetime.UTC)],
            "[1]",
            "Expected a time within 2**31 seconds",
        ),
        ("duration", datetime.timedelta(days=30_000), "", "Expected a time within 2**31 seconds"),
    ],
    ids=repr,
)
def test_a_value_that_does_not_fit_is_a_protocol_error_that_names_the_field(
    name: str, value: Any, place: str, text: str
) -> None:
    with pytest.raises(ProtocolError) as caught:
        put(UNTYPED, name, value)
    assert str(caught.value) == f"{text} - at `$.{name}{place}`"


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (encode({"colour": 1}), "Object contains unknown field `colour`"),
        (encode([1]), "Expected `object`, got `array`"),
        (b"\xc0", "Expected `object`, got `None`"),
        (b"", "Input data was truncated"),
        (b"\x81", "Input data was truncated"),
        (encode({"a_string": ""})[:-1] + b"\xa1\xff", "utf-8"),
        (b"\x81\xa8a_string" + b"\x91" * 100_000, "Expected `str`, got `array`"),
        (b"\x81\xaddefault_bytes" + b"\x91" * 100_000, "recursion"),
    ],
)
def test_a_payload_of_another_type_is_a_protocol_error(payload: bytes, text: str) -> None:
    with pytest.raises(ProtocolError, match=f"(?i){re.escape(text)}"):
        UNTYPED.goal.to_ros(payload)


NAMES = [name for type_ in EVERYTHING.types for name in type_.__struct_fields__]
plain = strategies.recursive(
    strategies.none()
    | strategies.booleans()
    | strategies.integers(-(2**63), 2**64 - 1)
    | strategies.floats()
    | strategies.text(max_size=7)
    | strategies.binary(max_size=7)
    | strategies.datetimes(timezones=strategies.just(datetime.UTC))
    | strategies.timedeltas(),
    lambda inner: (
        strategies.lists(inner, max_size=4)
        | strategies.dictionaries(strategies.sampled_from(["x", "sec", "name", "pose"]), inner)
    ),
    max_leaves=6,
)
SAMPLES = [codec.from_ros(codec.to_ros(None)) for found in (UNTYPED, TYPED) for codec in found] + [
    encode({"int32s": list(range(300)), "float64s": [0.5] * 300, "chars": [7] * 300})
]


@strategies.composite
def damaged(draw: strategies.DrawFn) -> bytes:
    """A message with one stretch of it replaced."""
    payload = draw(strategies.sampled_from(SAMPLES))
    start = draw(strategies.integers(0, len(payload)))
    end = draw(strategies.integers(start, min(len(payload), start + 20)))
    return payload[:start] + draw(strategies.binary(max_size=4)) + payload[end:]


def check_that_it_is_converted_or_rejected(payload: bytes) -> None:
    """If it is converted, the C code of ROS must be able to take it: it asserts what it gets."""
    for codec in (*UNTYPED, *TYPED):
        with contextlib.suppress(ProtocolError):
            codec.from_ros(over_the_wire(codec.to_ros(payload)))


@example(b"\x81\x80\x01")
@given(damaged())
def test_a_damaged_payload_gives_a_message_or_a_protocol_error(payload: bytes) -> None:
    check_that_it_is_converted_or_rejected(payload)


@given(strategies.dictionaries(strategies.sampled_from(NAMES), plain, max_size=2))
def test_any_plain_data_gives_a_message_or_a_protocol_error(data: dict[str, Any]) -> None:
    check_that_it_is_converted_or_rejected(encode(data))


@pytest.fixture
def looking_closely(monkeypatch: pytest.MonkeyPatch) -> None:
    """ROS's own classes look at each value, as with ROS_PYTHON_CHECK_FIELDS=1 and before Jazzy."""
    for module in list(sys.modules.values()):
        if hasattr(module, "ros_python_check_fields"):
            monkeypatch.setattr(module, "ros_python_check_fields", "1")


@pytest.mark.usefixtures("looking_closely")
def test_ros_finds_nothing_wrong_with_what_it_is_given() -> None:
    @settings(max_examples=20)  # ROS takes its time to look
    @given(strategies.tuples(*(structs(getattr(ROS_CLASS, p.title())) for p in PARTS)))
    def convert(parts: tuple[dict[str, Any], ...]) -> None:
        for name, value in zip(PARTS, parts, strict=True):
            codec: RosCodec = getattr(UNTYPED, name)
            assert decode(codec.from_ros(codec.to_ros(encode(value)))) == value

    convert()
    large = encode(
        {
            "int32s": list(range(LARGE_ARRAY)),
            "uint8s": [1] * LARGE_ARRAY,
            "bytes": b"\x01" * LARGE_ARRAY,
        }
    )
    UNTYPED.result.to_ros(large)


@pytest.mark.usefixtures("looking_closely")
def test_an_error_that_only_ros_finds_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError, match=r"'a_float32' field must be .* - at `\$\.a_float32`"):
        put(UNTYPED, "a_float32", GREATEST)


# Bytes


@pytest.mark.parametrize("value", [[1, 200], b"\x01\xc8"])
@pytest.mark.parametrize("name", ["bytes", "chars", "uint8s", "fixed_uint8s", "bounded_chars"])
def test_an_array_of_bytes_takes_bytes_and_a_list_of_ints(name: str, value: Any) -> None:
    codec = codec_of(UNTYPED, name)
    assert decode(codec.from_ros(codec.to_ros(encode({name: value}))))[name] == b"\x01\xc8"


@pytest.mark.parametrize(
    ("type_", "expected"),
    [
        (bytes, b"\x01\xc8"),
        (bytearray, b"\x01\xc8"),
        (list[int], [1, 200]),
        (tuple[int, ...], [1, 200]),
        (tuple[int, int], [1, 200]),
        (Any, b"\x01\xc8"),
        (list[int] | None, [1, 200]),
        (bytes | None, b"\x01\xc8"),
        (list, [1, 200]),
    ],
    ids=repr,
)
@pytest.mark.parametrize("name", ["bytes", "chars", "uint8s", "fixed_uint8s", "fixed_bytes"])
def test_the_type_of_the_user_selects_bytes_or_a_list_of_ints(
    name: str, type_: Any, expected: Any
) -> None:
    found = codecs(**{name: type_})
    codec = codec_of(found, name)
    message = codec.to_ros(encode({name: b"\x01\xc8"}))
    assert decode(codec.from_ros(message))[name] == expected


def test_an_array_of_byte_may_be_a_list_of_bytes() -> None:
    found = codecs(bytes=list[bytes])
    assert put(found, "bytes", [b"\x01", 200]) == [b"\x01", b"\xc8"]
    assert read(found, "bytes", bytes=[b"\x01", b"\xc8"]) == [b"\x01", b"\xc8"]


@pytest.mark.parametrize(("type_", "expected"), [(int, 7), (bytes, b"\x07"), (Any, 7)], ids=repr)
def test_a_byte_is_an_int_unless_the_user_wants_bytes(type_: Any, expected: Any) -> None:
    found = codecs(a_byte=type_)
    assert put(found, "a_byte", 7) == put(found, "a_byte", b"\x07") == b"\x07"
    assert read(found, "a_byte", a_byte=b"\x07") == expected


# Time

NOON = datetime.datetime(2024, 2, 29, 12, 0, 0, 123456, datetime.UTC)
NOON_SECONDS = 1709208000
FIELDS = {"sec": NOON_SECONDS, "nanosec": 123456000}
Aware = Annotated[datetime.datetime, Meta(tz=True)]


@pytest.mark.parametrize("value", [NOON, FIELDS, "2024-02-29T13:00:00.123456+01:00"], ids=repr)
@pytest.mark.parametrize("type_", [datetime.datetime, Aware, Any])
def test_a_time_may_be_sent_as_a_datetime_or_by_fields(type_: Any, value: Any) -> None:
    message = put(codecs(time=type_), "time", value)
    assert (message.sec, message.nanosec) == (NOON_SECONDS, 123456000)


@pytest.mark.parametrize("type_", [datetime.datetime, Aware])
def test_a_time_is_received_as_the_datetime_that_the_user_wants(type_: Any) -> None:
    wanted = action(time=type_, times=list[type_])
    found = EVERYTHING.codecs(wanted.info)
    message = found.feedback.to_ros(encode({"time": NOON, "times": [FIELDS, {"sec": -(2**31)}]}))
    feedback = wanted.feedback.decode(found.feedback.from_ros(message))
    assert feedback.time == NOON
    assert feedback.times == [NOON, datetime.datetime(1901, 12, 13, 20, 45, 52, 0, datetime.UTC)]


def test_a_time_is_received_as_text_to_the_nanosecond() -> None:
    found = codecs(time=str)
    text = read(found, "time", time__sec=NOON_SECONDS, time__nanosec=1)
    assert text == "2024-02-29T12:00:00.000000001Z"
    over = read(found, "time", time__sec=NOON_SECONDS, time__nanosec=2**32 - 1)
    assert over == "2024-02-29T12:00:04.294967295Z"


WITH_TIMES = codecs(time=datetime.datetime, duration=datetime.timedelta)
times = strategies.datetimes(
    datetime.datetime(1902, 1, 1),
    datetime.datetime(2038, 1, 1),
    timezones=strategies.just(datetime.UTC),
)
spans = strategies.timedeltas(-datetime.timedelta(days=24855), datetime.timedelta(days=24855))


@given(times, spans)
def test_any_datetime_and_timedelta_come_back_as_they_were(
    time: datetime.datetime, span: datetime.timedelta
) -> None:
    codec = WITH_TIMES.feedback
    back = decode(codec.from_ros(codec.to_ros(encode({"time": time, "duration": span}))))
    assert msgspec.convert(back["time"], datetime.datetime) == time
    assert msgspec.convert(back["duration"], datetime.timedelta) == span


@pytest.mark.parametrize(
    "value", [datetime.timedelta(seconds=-0.5), {"sec": -1, "nanosec": 500_000_000}, "-PT0.5S"]
)
def test_a_duration_may_be_sent_as_a_timedelta_or_by_fields(value: Any) -> None:
    message = put(UNTYPED, "duration", value)
    assert (message.sec, message.nanosec) == (-1, 500_000_000)


def test_a_duration_is_received_to_the_nearest_microsecond() -> None:
    text = read(WITH_TIMES, "duration", duration__sec=1, duration__nanosec=1500)
    assert msgspec.convert(text, datetime.timedelta) == datetime.timedelta(
        seconds=1, microseconds=2
    )


# Large arrays

NUMBER_ARRAYS = [
    "int8s",
    "int16s",
    "uint16s",
    "int32s",
    "uint32s",
    "int64s",
    "uint64s",
    "float32s",
    "float64s",
]
CODES = dict(zip(NUMBER_ARRAYS, "bhHiIqQfd", strict=True))


@strategies.composite
def large(draw: strategies.DrawFn) -> tuple[str, list[Any]]:
    """The name of an array, and so many numbers that they are converted at once."""
    name = draw(strategies.sampled_from([*CODES, "chars"]))
    (slot,) = (
        slot.value_type
        for field, slot in zip(
            ROS_CLASS.Result.get_fields_and_field_types(),
            ROS_CLASS.Result.SLOT_TYPES,
            strict=True,
        )
        if field == name
    )
    some = draw(strategies.lists(NUMBERS[slot.typename], min_size=1, max_size=4))
    count = draw(strategies.sampled_from([LARGE_ARRAY - 1, LARGE_ARRAY, LARGE_ARRAY + 1, 65536]))
    return name, (some * count)[:count]


@given(large())
def test_a_large_array_is_as_if_msgspec_had_converted_it(case: tuple[str, list[Any]]) -> None:
    name, numbers = case
    found = WITH_LISTS if name == "chars" else UNTYPED
    codec = codec_of(found, name)
    message = codec.to_ros(encode({name: numbers}))
    assert getattr(message, name) == array.array(CODES.get(name, "B"), numbers)
    payload = codec.from_ros(message)
    assert decode(payload)[name] == numbers
    # And so back from what is packed by itself, as between two ends of ROS.
    assert codec.to_ros(payload) == message


WITH_LISTS = codecs(chars=list[int])


def test_a_large_fixed_array_is_a_numpy_array() -> None:
    codec = codec_for(numbers="double[1000]")
    message = codec.to_ros(encode({"numbers": [0.5] * 1000}))
    assert isinstance(message.numbers, numpy.ndarray)
    assert decode(codec.from_ros(message))["numbers"] == [0.5] * 1000


def codec_for(**fields: str) -> RosCodec:
    """The codec of a message that has these fields."""
    return RosCodec(message_part(message_class(**fields)))


def message_part(cls: Any) -> Any:
    return message_kind(cls).bind(UserSchema({}), "message", [])


def message_class(**fields: str) -> Any:
    """A class like those that ROS generates."""

    def init(self: Any) -> None:
        for name in fields:
            setattr(self, name, numpy.zeros(1000))

    members = {
        "__module__": "made_up.msg._thing",
        "__init__": init,
        "get_fields_and_field_types": staticmethod(lambda: fields),
    }
    return type("Thing", (), members)


def test_a_million_numbers_are_converted_without_an_object_for_each() -> None:
    payload = encode({"float64s": [0.5] * 1_000_000})
    tracemalloc.start()
    try:
        message = UNTYPED.result.to_ros(payload)
        _, to_ros = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        UNTYPED.result.from_ros(message)
        _, from_ros = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # It is some three copies at 8 or 9 bytes a number. As objects they would take 24 each, 8 more
    # in the list, and 8 in the array of the message: 40.
    assert to_ros < 36_000_000
    assert from_ros < 36_000_000


# Matching


class Colour(enum.Enum):
    RED = "red"


class Level(enum.IntEnum):
    LOW = 1


class Flat(msgspec.Struct, array_like=True):
    x: float
    y: float
    z: float


class Cat(msgspec.Struct, tag=True):
    x: float


class Dog(msgspec.Struct, tag=True):
    x: float


class Point(msgspec.Struct):
    x: float
    y: int
    w: float


@pytest.mark.parametrize(
    ("name", "type_"),
    [
        ("an_int32", Level),
        ("an_int32", int | str),
        ("an_int32", Literal[1, "a", None]),
        ("an_int32", Annotated[int, Meta(ge=0)]),
        ("a_bool", Literal[True]),
        ("a_string", Colour),
        ("a_string", uuid.UUID),
        ("a_float64", float | int),
        ("fixed_int32s", tuple[int, int, int]),
        ("fixed_int32s", Annotated[list[int], Meta(min_length=3, max_length=3)]),
        ("strings", set[str]),
        ("strings", list),
        ("point", dict[str, float]),
        ("point", dict),
        ("point", Any),
        ("parts", list[dict[str, Any]]),
    ],
    ids=repr,
)
def test_a_type_that_can_hold_the_values_of_ros_matches(name: str, type_: Any) -> None:
    codecs(**{name: type_})


ROS_HAS, NO_MATCH = "the ROS type has", "and the action has none that matches"
A_POSE = f"{ROS_HAS} the struct geometry_msgs/PoseStamped"


@pytest.mark.parametrize(
    ("path", "type_", "ros", "ours"),
    [
        ("goal.an_int32", str, "int32", "a string"),
        ("goal.an_int32", Cat, "int32", "a struct"),
        ("goal.an_int32", type(None), "int32", "nothing (null)"),
        ("goal.a_float32", int, "float32", "an int"),
        ("goal.a_string", bytes, "string", "bytes"),
        ("goal.a_string", Aware, "string", "a datetime"),
        ("goal.default_fixed", tuple[int, int], "int32[3]", "2 elements"),
        ("goal.default_fixed[]", tuple[int, float, int], "int32", "a float"),
        ("goal.default_bytes", str, "uint8[]", "a string"),
        ("result.int8s", bytes, "int8[]", "bytes"),
        ("feedback.point", Flat, "the struct geometry_msgs/Point", "a list"),
        ("feedback.time", datetime.timedelta, "the struct builtin_interfaces/Time", "a timedelta"),
    ],
    ids=repr,
)
def test_a_type_that_does_not_match_its_ros_type_is_reported(
    path: str, type_: Any, ros: str, ours: str
) -> None:
    name = path.split(".")[1].removesuffix("[]")
    line = f"{path}: {ROS_HAS} {ros}, the action has {ours}"
    assert mismatches(**{name: type_}) == [line]


def test_all_mismatches_are_reported_at_once() -> None:
    assert mismatches(
        an_int32=str | float | None,
        a_string=None,
        pose=Cat | Dog,
        int8s=bytes,
        point=Point,
        time=dict[str, str],
        durations=list[dict[str, str]],
        parts=list[dict[str, int]],
    ) == [
        f"goal.an_int32: {ROS_HAS} int32, {NO_MATCH}: a string, a float",
        "goal.a_string (string): the action has no such field",
        f"feedback.parts[].name: {ROS_HAS} string, the action has an int",
        f"feedback.parts[].position: {ROS_HAS} float64[3], the action has an int",
        f"feedback.parts[].labels: {ROS_HAS} string[<=2], the action has an int",
        f"feedback.time.sec: {ROS_HAS} int32, the action has a string",
        f"feedback.time.nanosec: {ROS_HAS} uint32, the action has a string",
        f"feedback.durations[].sec: {ROS_HAS} int32, the action has a string",
        f"feedback.durations[].nanosec: {ROS_HAS} uint32, the action has a string",
        f"feedback.point.y: {ROS_HAS} float64, the action has an int",
        "feedback.point.z (float64): the action has no such field",
        "feedback.point.w: the ROS type has no such field",
        f"feedback.pose: {A_POSE}, {NO_MATCH}: a struct, a struct",
        f"result.int8s: {ROS_HAS} int8[], the action has bytes",
    ]


@pytest.mark.parametrize(
    "schema",
    [
        {"$ref": "#/$defs/Ring", "$defs": {"Ring": {"$ref": "#/$defs/Ring"}}},
        {"$ref": "#/$defs/Ring", "$defs": {"Ring": {"anyOf": [{"$ref": "#/$defs/Ring"}] * 9}}},
        {"$ref": "#/$defs/Missing"},
        {"$ref": "#/$defs/Missing", "$defs": 1},
        {"$ref": 1},
        {"anyOf": 1},
        {"anyOf": [1]},
        {"enum": 1},
        {"enum": [[1]]},
        {"type": 1},
        {"type": "strange"},
        {"type": "object", "properties": 1},
        {"type": "object", "additionalProperties": 1},
        {"type": "object", "properties": {"x": {}, "y": {"type": []}, "z": 1}},
    ],
    ids=repr,
)
def test_an_invalid_schema_allows_any_value(schema: dict[str, Any]) -> None:
    problems: list[str] = []
    point = import_module("geometry_msgs.msg").Point
    message_kind(point).bind(UserSchema(schema), "point", problems)
    assert problems == []


KEYWORDS = [
    "type",
    "$ref",
    "anyOf",
    "enum",
    "properties",
    "items",
    "prefixItems",
    "format",
    "additionalProperties",
    "contentEncoding",
    "default",
    "minItems",
    "maxItems",
    "time",
    "parts",
    "point",
]
json = strategies.recursive(
    strategies.none()
    | strategies.booleans()
    | strategies.integers()
    | strategies.sampled_from(
        ["array", "object", "string", "number", "null", "duration", "#/$defs/A", "#/$defs/B"]
    ),
    lambda inner: (
        strategies.lists(inner, max_size=3)
        | strategies.dictionaries(strategies.sampled_from(KEYWORDS), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(json, json, json)
def test_any_schema_matches_or_is_reported(schema: Any, one: Any, other: Any) -> None:
    root = {**(schema if isinstance(schema, dict) else {}), "$defs": {"A": one, "B": other}}
    problems: list[str] = []
    part: Any = message_kind(ROS_CLASS.Feedback).bind(UserSchema(root), "feedback", problems)
    if problems:
        assert all(line.startswith("feedback") for line in problems)
    else:
        codec = RosCodec(part)
        assert codec.from_ros(codec.to_ros(None))


def test_a_schema_that_is_nested_without_end_is_a_transport_error() -> None:
    schema: dict[str, Any] = {}
    for _ in range(100_000):
        schema = {"anyOf": [schema]}
    with pytest.raises(TransportError, match="the types of action 'deep' are nested too deep"):
        NOTHING.codecs(ActionInfo("deep", goal=schema))


def test_codecs_are_made_once_for_each_description_and_few_are_kept() -> None:
    first = NOTHING.codecs(ActionInfo("a"))
    assert NOTHING.codecs(ActionInfo("a")) is first
    assert NOTHING.codecs(ActionInfo("b")) is not first
    for number in range(200):
        NOTHING.codecs(ActionInfo(f"a{number}"))
    assert NOTHING.codecs(ActionInfo("a")) is not first


# Finding


def test_a_type_is_found_once() -> None:
    found = find("arduinobot_msgs/action/Fibonacci")
    assert found is find("arduinobot_msgs/action/Fibonacci")
    assert found.type_name == "arduinobot_msgs/action/Fibonacci"
    assert found.impl is import_module("arduinobot_msgs.action").Fibonacci.Impl


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package `broken_msgs`, with a module for actions."""
    folder = tmp_path / "broken_msgs"
    folder.mkdir()
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "broken_msgs"]:
        del sys.modules[name]


def error_of(type_name: str) -> str:
    with pytest.raises(TransportError) as caught:
        find(type_name)
    return str(caught.value)


@pytest.mark.parametrize(
    "name", ["", "Fibonacci", "a/msg/B", "a/action/b", "a.b/action/C", "a/action/B\n", "/action/A"]
)
def test_an_invalid_type_name_is_an_error(name: str) -> None:
    assert error_of(name) == (
        "give the Action a type_name such as 'example_interfaces/action/Fibonacci', which ROS"
        f" needs: {name!r} is not a ROS action type"
    )


def test_a_package_that_is_not_there_is_named() -> None:
    assert error_of("missing_msgs/action/Thing") == (
        "the ROS package 'missing_msgs', which has missing_msgs/action/Thing, is not installed"
        " here: build it, and source its setup.bash"
    )


@pytest.mark.parametrize("file", ["action/Dock.action", "msg/Dock.msg"])
def test_sources_that_are_not_built_are_no_package_although_python_could_import_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    (tmp_path / "unbuilt_msgs" / file).parent.mkdir(parents=True)
    (tmp_path / "unbuilt_msgs" / file).touch()
    monkeypatch.syspath_prepend(tmp_path)
    assert error_of("unbuilt_msgs/action/Dock") == (
        "the ROS package 'unbuilt_msgs', which has unbuilt_msgs/action/Dock, is not installed"
        " here: build it, and source its setup.bash"
    )
    assert "unbuilt_msgs" not in sys.modules  # or what is built later would not be found


def test_a_package_without_actions_is_named(package: Path) -> None:
    assert error_of("broken_msgs/action/Thing") == "the ROS package 'broken_msgs' has no actions"


def test_an_action_that_a_package_does_not_have_is_named() -> None:
    assert error_of("test_msgs/action/Thing") == (
        "the ROS package 'test_msgs', as it is built here, has no action 'Thing': look at its"
        " .action files, and build it again"
    )


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("import no_such_module", "No module named 'no_such_module'"),
        ("raise RuntimeError('made for another Python')", "made for another Python"),
    ],
)
def test_a_package_that_cannot_be_imported_says_why(package: Path, source: str, text: str) -> None:
    (package / "action.py").write_text(source)
    assert error_of("broken_msgs/action/Thing") == (
        f"broken_msgs/action/Thing cannot be imported ({text}): source the setup.bash of ROS and"
        " of what it needs"
    )


def test_a_type_without_its_compiled_part_says_so(package: Path) -> None:
    (package / "action.py").write_text("class Thing:\n    pass\n")
    assert re.fullmatch(
        r"broken_msgs/action/Thing cannot be used, because its compiled part cannot be loaded"
        r" \(.*_TYPE_SUPPORT.*\): build the ROS package 'broken_msgs' again, for this ROS and this"
        r" Python",
        error_of("broken_msgs/action/Thing"),
    )


def test_a_field_that_ros_cannot_handle_is_named() -> None:
    with pytest.raises(TransportError) as caught:
        message_kind(message_class(letter="wchar"))
    assert str(caught.value) == (
        "made_up/Thing.letter is a wchar, which ROS itself cannot handle in Python"
    )


# Types that are made from ROS


def test_two_values_of_a_type_from_ros_share_nothing() -> None:
    goal_type, feedback_type, _ = EVERYTHING.types
    goal_type().default_fixed.append(4)
    feedback_type().fixed_parts[0].position[0] = 5.0
    assert goal_type().default_fixed == [1, 2, 3]
    assert feedback_type().fixed_parts[0].position == [0.0, 0.0, 0.0]


def test_types_are_made_from_interface_files_where_there_is_no_rclpy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(message_structs, "find_spec", lambda name: None)
    for made, ros in zip(message_types(EVERYTHING.type_name), EVERYTHING.types, strict=True):
        assert encode(made()) == encode(ros())


def test_the_function_that_makes_types_is_an_entry_point() -> None:
    (entry,) = entry_points(group="fibaction.interfaces", name="ros2")
    assert entry.load() is message_types
