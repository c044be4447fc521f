"""`fibaction_transports.web.rosbridge.type_definitions`: JSON Schemas from rosapi's
definitions."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fibaction.interfaces.ros_types import (
    Byte,
    Char,
    Int8,
    Int16,
    Int32,
    Int64,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    array,
    struct,
)
from fibaction.schema.check import MAX_PARTS
from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction_transports.web.rosbridge.type_definitions import TypeDefinition, schema_of

FIELDS = [
    # The field as rosapi of rosbridge_suite tells it, and its type and its default in ROS.
    ("a_bool", "boolean", -1, "True", bool, True),
    ("a_byte", "octet", -1, "b'\\x07'", Byte, 7),
    ("another_byte", "octet", -1, "b'A'", Byte, 65),
    ("a_tab", "octet", -1, "b'\\t'", Byte, 9),
    ("a_char", "uint8", -1, "65", Char, 65),
    ("a_float32", "float", -1, "1.5", float, 1.5),
    ("a_float64", "double", -1, "-2.25", float, -2.25),
    ("an_int8", "int8", -1, "-8", Int8, -8),
    ("an_int16", "int16", -1, "-16", Int16, -16),
    ("a_uint16", "uint16", -1, "16", UInt16, 16),
    ("an_int32", "int32", -1, "-32", Int32, -32),
    ("a_uint32", "uint32", -1, "32", UInt32, 32),
    ("an_int64", "int64", -1, "-64", Int64, -64),
    ("a_uint64", "uint64", -1, "18446744073709551615", UInt64, 2**64 - 1),
    ("a_string", "string", -1, 'it\'s "said"', str, 'it\'s "said"'),
    ("a_wstring", "wstring", -1, "", str, ""),
]


def definition(*fields: tuple[str, str, int, str], name: str = "arm_msgs/Move_Goal") -> Any:
    names, kinds, lengths, examples = (list(column) for column in zip(*fields, strict=True))
    return TypeDefinition(name, names, kinds, lengths, examples)


def properties(*fields: tuple[str, str, int, str]) -> dict[str, Any]:
    found: dict[str, Any] = schema_of([definition(*fields)])["$defs"]["Move_Goal"]["properties"]
    return found


def test_a_message_has_the_schema_that_is_made_from_its_class() -> None:
    made = struct(
        "Move_Goal",
        [(name, kind, default) for name, *_, kind, default in FIELDS],
        module="arm_msgs.action",
        doc="`arm_msgs/Move_Goal` of ROS 2.",
        constants={},
    )
    told = definition(*[field[:4] for field in FIELDS])

    assert schema_of([told]) == msgspec.json.schema(made)


def test_arrays_are_described_without_their_defaults() -> None:
    found = properties(
        ("fixed", "double", 3, "[]"),
        ("any", "string", 0, "[]"),
        ("bytes", "uint8", 0, "[]"),
        ("more_bytes", "octet", 0, "[]"),
        ("uuid", "uint8", 16, "[]"),
        ("bounded", "octet, 5", 0, "[]"),
        ("few", "float64, 5", 0, "[]"),
        ("texts", "sequence<string<5>, 4>", -1, "{}"),
        ("text", "string<5>", -1, ""),
    )
    text = {"type": "string", "contentEncoding": "base64"}
    fixed = msgspec.json.schema(array(float, size=3))
    few_bytes = msgspec.json.schema(array(UInt8, bound=5))
    assert found == {
        "fixed": fixed,
        "any": {"type": "array", "items": {"type": "string"}},
        "bytes": text,
        "more_bytes": text,
        "uuid": msgspec.json.schema(array(UInt8, size=16)),
        "bounded": few_bytes,
        "few": {"type": "array", "items": {"type": "number"}, "maxItems": 5},
        "texts": {
            "type": "array",
            "items": {"type": "string", "maxLength": 5},
            "maxItems": 4,
        },
        "text": {"type": "string", "maxLength": 5, "default": ""},
    }


def test_messages_within_a_message_are_described_once_and_told_apart() -> None:
    point = definition(("x", "double", -1, "0.0"), name="geometry_msgs/Point")
    other = definition(("i", "int32", -1, "0"), name="image_msgs/Point")
    move = definition(
        ("to", "geometry_msgs/Point", -1, "{}"),
        ("path", "geometry_msgs/Point", 0, "[]"),
        ("pixel", "image_msgs/Point", 2, "[]"),
    )
    found = schema_of([move, point, other])
    assert found["$ref"] == "#/$defs/Move_Goal"
    assert list(found["$defs"]) == ["Move_Goal", "Point", "image_msgs.Point"]
    codec = JsonCodec(found)
    assert codec.complete({"to": {}, "path": [{"x": 1}], "pixel": [{}, {}]}) == {
        "to": {"x": 0.0},
        "path": [{"x": 1}],
        "pixel": [{"i": 0}, {"i": 0}],
    }
    with pytest.raises(PayloadError, match=r"goal\.to\.x must be a number"):
        codec.complete({"to": {"x": "far"}})


def test_a_field_whose_type_is_not_described_may_have_any_value() -> None:
    found = properties(
        ("numbers", "arra/array", 0, "[]"),
        ("map", "nav_msgs/Map", -1, "{}"),
        ("any", "any", -1, "0"),
        ("", "", 0, ""),
        ("lines", "a\nb", 0, ""),
    )
    assert list(found.values()) == [{}] * 5
    assert schema_of([]) == {}


@pytest.mark.parametrize(
    ("kind", "example"),
    [
        ("boolean", "yes"),
        ("int8", "200"),
        ("int64", "many"),
        ("uint64", str(2**64)),
        ("uint8", "-1"),
        ("double", "nan"),
        ("double", "inf"),
        ("octet", "b'\\q'"),
        ("octet", "b'\\xzz'"),
        ("octet", "b"),
    ],
)
def test_an_example_that_is_not_a_value_is_no_default(kind: str, example: str) -> None:
    assert "default" not in properties(("x", kind, -1, example))["x"]


def test_a_schema_that_would_be_too_large_to_be_used_is_left_out() -> None:
    small, large = (
        [TypeDefinition(f"p/T{number}") for number in range(size)] for size in (2, MAX_PARTS + 1)
    )
    small[1].fieldnames = list(map(str, range(MAX_PARTS - 2)))
    assert schema_of(small)
    small[1].fieldnames.append("last")
    assert schema_of(small) == schema_of(large) == {}
