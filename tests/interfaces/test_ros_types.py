from __future__ import annotations

from typing import Any

import msgspec
import pytest
from msgspec import Struct

from fibaction.interfaces.ros_types import (
    PRIMITIVES,
    Byte,
    Char,
    Int32,
    UInt8,
    array,
    attribute,
    string,
    struct,
)

INTEGERS = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "byte": (0, 255),
    "char": (0, 255),
}


def fits(value: object, kind: Any) -> bool:
    """Return whether the value is decoded from a payload of that type."""
    try:
        return bool(msgspec.msgpack.decode(msgspec.msgpack.encode(value), type=kind) == value)
    except (msgspec.ValidationError, OverflowError):
        return False


def make(*fields: tuple[str, Any, Any], **constants: Any) -> type[Struct]:
    return struct("Made", fields, module="robot_msgs", doc="A doc.", constants=constants)


@pytest.mark.parametrize("name", INTEGERS)
def test_an_integer_has_the_limits_of_its_width(name: str) -> None:
    low, high = INTEGERS[name]

    fitting = [
        number for number in (low - 1, low, 0, high, high + 1) if fits(number, PRIMITIVES[name])
    ]
    assert fitting == [low, 0, high]


def test_a_bounded_string_counts_characters() -> None:
    assert fits("ウィキ", string(3))
    assert not fits("four", string(3))
    assert string() is str


@pytest.mark.parametrize("element", [UInt8, Byte, Char])
def test_an_array_of_octets_is_bytes(element: Any) -> None:
    assert array(element) is bytes
    assert fits(b"abc", array(element, size=3))
    assert not fits(b"ab", array(element, size=3))
    assert not fits(b"abcd", array(element, bound=3))


def test_a_struct_has_fields_defaults_constants_and_a_docstring() -> None:
    made: Any = make(("order", Int32, 7), ("name", str, "x"), MOST=9)

    assert made.MOST == 9
    assert made.__doc__ == "A doc."
    assert made.__module__ == "robot_msgs"
    assert msgspec.to_builtins(made()) == {"order": 7, "name": "x"}
    assert not fits({"order": 2**31}, made)
    with pytest.raises(msgspec.ValidationError, match="unknown field `other`"):
        msgspec.convert({"other": 1}, made)


def test_two_structs_do_not_share_a_default() -> None:
    point: Any = make(("x", float, 0.0))
    made: Any = make(
        ("empty", list[Int32], []),
        ("full", list[Int32], [1]),
        ("point", point, {}),
        ("points", array(point), [{"x": 1.0}, {}]),
    )

    one, other = made(), made()
    one.empty.append(1)
    one.full.append(2)
    one.point.x = 5.0
    one.points[0].x = 5.0

    assert msgspec.to_builtins(other) == {
        "empty": [],
        "full": [1],
        "point": {"x": 0.0},
        "points": [{"x": 1.0}, {"x": 0.0}],
    }


def test_a_field_named_as_a_keyword_keeps_its_name_in_payloads() -> None:
    made: Any = make(("from", Int32, 1), ("import", list[Int32], []), ("class", list[Int32], [3]))

    assert attribute("from") == "from_"
    assert attribute("order") == "order"
    assert made(from_=5).from_ == 5
    assert msgspec.to_builtins(made(from_=5)) == {"from": 5, "import": [], "class": [3]}
