"""The public functions that convert ROS messages, without ROS."""

from __future__ import annotations

import array
from importlib import import_module
from typing import Any

import msgspec
import pytest

from fibaction.ros_types import from_ros, to_ros
from fibaction.words.errors import ProtocolError
from tests.support.ros_classes import Dock_Goal, Point, Scan, Stamped, Vector3

numpy: Any = import_module("numpy")


class XYZ(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


def test_a_message_becomes_a_struct_of_its_type_and_back() -> None:
    message = Stamped(frame_id="map", point=Point(x=1.5))
    value = from_ros(message)
    assert isinstance(value, msgspec.Struct)
    assert (value, to_ros(value)) == (from_ros(to_ros(value)), message)
    assert to_ros(from_ros(Dock_Goal())) == Dock_Goal()


def test_a_message_becomes_any_type_with_its_fields_and_back() -> None:
    assert from_ros(Point(x=1.5), XYZ) == XYZ(1.5)
    assert to_ros(XYZ(1.5), Point) == Point(x=1.5)
    assert to_ros({"x": 1.5}, Point) == Point(x=1.5)
    assert from_ros(Point(x=1.5), dict[str, float]) == {"x": 1.5, "y": 0.0, "z": 0.0}


def test_arrays_of_numbers_become_those_of_ros() -> None:
    value: Any = from_ros(Scan())
    value.ranges = numpy.full(1000, 0.5)
    value.data = numpy.frombuffer(b"ab" * 500, "u1")
    message = to_ros(value)
    assert message.ranges == array.array("f", [0.5] * 1000)
    assert message.data == array.array("B", b"ab" * 500)
    assert from_ros(message).ranges == [0.5] * 1000


@pytest.mark.parametrize(
    ("convert", "text"),
    [
        (lambda: from_ros(1), "expected a ROS message, got `int`"),
        (
            lambda: from_ros(Vector3(), type(from_ros(Point()))),
            "Expected `like_msgs/msg/Point`, got `like_msgs/msg/Vector3`",
        ),
        (
            lambda: to_ros(XYZ()),
            (
                "`XYZ` is not made from a ROS type: give the class of ROS, as in"
                " to_ros(pose, PoseStamped)"
            ),
        ),
        (
            lambda: to_ros(XYZ(), XYZ),
            "expected a class of ROS, got `<class 'tests.test_ros_types.XYZ'>`",
        ),
    ],
)
def test_what_cannot_be_converted_is_a_type_error(convert: Any, text: str) -> None:
    with pytest.raises(TypeError) as caught:
        convert()
    assert str(caught.value) == text


def test_a_value_that_does_not_fit_names_the_field() -> None:
    with pytest.raises(ProtocolError, match=r"Expected `float`, got `str` - at `\$\.x`"):
        to_ros({"x": "a"}, Point)
    with pytest.raises(ProtocolError, match=r"Expected `float`, got `str` - at `\$\.x`"):
        from_ros(Point(x="a"))
