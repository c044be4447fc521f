"""`fibaction_transports.cdr` beside ROS: the same bytes for the same values, the same hashes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.interfaces import ActionFile, make_structs, read_action
from fibaction.interfaces.files import InterfaceMessage, read_message
from fibaction.interfaces.packages import SearchPath
from fibaction_transports.cdr.codec import CdrCodec
from fibaction_transports.cdr.standard_messages import (
    CANCEL_GOAL,
    MESSAGES,
    ActionCodecs,
    action_interface,
)
from fibaction_transports.cdr.type_hashes import type_hash
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from tests.transports.cdr.definitions import Goal
from tests.transports.cdr.generated import values_of
from tests.transports.cdr.recorded import RECORDED, recorded

serialization: Any = import_module("rclpy.serialization")

SHARE = Path(sys.prefix, "share")
TYPES = [
    "arduinobot_msgs/action/Fibonacci",
    "arduinobot_msgs/action/MoveArm",
    "fibaction_test_msgs/action/Echo",
    "fibaction_test_msgs/action/Everything",
    "fibaction_test_msgs/action/Nothing",
    "test_msgs/action/Fibonacci",
    "test_msgs/action/NestedMessage",
]
PARTS = ("goal", "result", "feedback")


def action_file(type_name: str) -> ActionFile:
    return read_action(SHARE / f"{type_name}.action", search=[SHARE])


class Both:
    """One message of an action, by our codec and by ROS."""

    def __init__(self, type_name: str, part: str) -> None:
        file = action_file(type_name)
        self.message: InterfaceMessage = getattr(file, part)
        self.structs: dict[str, Any] = {**make_structs(file)}
        self.ours = CdrCodec(self.message, self.structs)
        self._decode = msgspec.msgpack.Decoder(self.structs[self.message.class_name]).decode
        ros = RclpyTypes().find(type_name)
        package, _, name = type_name.split("/")
        self._ros_class = getattr(getattr(import_module(f"{package}.action"), name), part.title())
        self._values = getattr(ros.codecs(ros.info("any")), part)

    def ros_bytes(self, value: Any) -> bytes:
        """Return the value as ROS serializes it."""
        message = self._values.to_ros(msgspec.msgpack.encode(value))
        payload: bytes = serialization.serialize_message(message)
        return payload

    def ros_value(self, payload: bytes) -> Any:
        """Return what ROS reads in a payload."""
        message = serialization.deserialize_message(payload, self._ros_class)
        return self._decode(self._values.from_ros(message))


BOTH = {(name, part): Both(name, part) for name in TYPES for part in PARTS}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("type_name", TYPES)
@given(data=st.data())
def test_ros_and_the_codec_read_each_other(type_name: str, part: str, data: st.DataObject) -> None:
    both = BOTH[type_name, part]
    value = data.draw(values_of(both.message, both.structs))
    assert both.ours.decode(both.ros_bytes(value)) == value
    assert both.ros_value(both.ours.encode(value)) == value


def ros_class(name: str) -> Any:
    """Return the class of a message that is recorded in the tests of the codec."""
    impl = import_module("arduinobot_msgs.action").Fibonacci.Impl
    services: dict[str, Any] = {
        "SendGoal": impl.SendGoalService,
        "GetResult": impl.GetResultService,
        "CancelGoal": import_module("action_msgs.srv").CancelGoal,
    }
    service, _, end = name.partition("_")
    if service in services:
        return getattr(services[service], end)
    if name == "FeedbackMessage":
        return impl.FeedbackMessage
    tests = import_module("fibaction_test_msgs.action")
    if service in ("Everything", "Nothing"):
        return getattr(getattr(tests, service), end)
    packages = ("action_msgs.msg", "geometry_msgs.msg", "rmw_dds_common.msg")
    modules = map(import_module, packages)
    return next(getattr(module, name) for module in modules if hasattr(module, name))


@pytest.mark.parametrize("name", RECORDED)
def test_the_recorded_bytes_are_still_those_of_ros(name: str) -> None:
    cls = ros_class(name)
    first, second = (
        serialization.deserialize_message(recorded(name, gap), cls) for gap in ("00", "ff")
    )
    assert first == second
    payload = serialization.serialize_message(first)
    # The gaps have what was in memory, so they are compared as gaps.
    body = RECORDED[name]
    for index in range(0, len(body), 2):
        if body[index : index + 2] != "--":
            assert payload[4 + index // 2] == int(body[index : index + 2], 16), index // 2


# Type hashes


def hashes_of_ros() -> dict[str, str]:
    """Return the hash of each type that is installed, by its name."""
    found: dict[str, str] = {}
    for path in SHARE.glob("*/*/*.json"):
        hashes = json.loads(path.read_text()).get("type_hashes", [])
        found |= {one["type_name"]: one["hash_string"] for one in hashes}
    return found


HASHES = hashes_of_ros()


def all_in(message: InterfaceMessage) -> Iterator[InterfaceMessage]:
    yield message
    for nested in message.nested.values():
        yield from all_in(nested)


def hashed(message: InterfaceMessage) -> dict[str, str]:
    """Return the hashes of a message and of all that it nests, by type name."""
    return {one.type_name: type_hash(one) for one in all_in(message)}


def test_all_messages_that_are_installed_have_the_hashes_of_ros() -> None:
    names = [
        f"{path.parts[-3]}/msg/{path.stem}"
        for path in sorted(SHARE.glob("*/msg/*.msg"))
        if f"{path.parts[-3]}/msg/{path.stem}" in HASHES
    ]
    assert len(names) > 80
    found: dict[str, str] = {}
    for name in names:  # one after the other, since namesakes of several packages are two types
        found |= hashed(read_message(name, SearchPath((), [SHARE])))
    assert {name: found[name] for name in names} == {name: HASHES[name] for name in names}


@pytest.mark.parametrize(
    "path", sorted(SHARE.glob("*/action/*.action")), ids=lambda path: path.stem
)
def test_all_types_that_ros_makes_of_an_action_have_its_hashes(path: Path) -> None:
    found = hashed(action_interface(read_action(path, search=[SHARE])))
    assert len(found) >= 16
    assert found == {name: HASHES[name] for name in found}


def test_the_messages_that_all_actions_use_have_the_hashes_of_ros() -> None:
    found = hashed(CANCEL_GOAL)
    for message in MESSAGES.values():
        found |= hashed(message)
    assert found == {name: HASHES[name] for name in found}


def test_an_action_of_ros_has_its_codecs() -> None:
    codecs = ActionCodecs(action_file("test_msgs/action/Fibonacci"))
    assert codecs.feedback_message.type_name == "test_msgs/action/Fibonacci_FeedbackMessage"


# Arrays of numpy, which is installed with ROS


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("bool", "bool"),
        ("uint8", "uint8"),
        ("int8", "int8"),
        ("uint16", "uint16"),
        ("int64", "int64"),
        ("float32", "float32"),
        ("float64", "float64"),
        ("float64", ">f8"),  # another byte order
        ("float64", "float32"),  # another type, which fits
        ("int32", "int64"),
    ],
)
@pytest.mark.parametrize("count", [0, 1, 5])
def test_an_array_of_numpy_is_taken_for_numbers(kind: str, dtype: str, count: int) -> None:
    numpy = import_module("numpy")
    goal = Goal(f"{kind}[] values")
    values = numpy.arange(count).astype(dtype)
    expected = bytes(values) if kind == "uint8" else values.tolist()
    assert goal.codec.decode(goal.encoded(values=values)).values == expected


def test_an_image_of_numpy_must_be_flat() -> None:
    image = import_module("numpy").zeros((2, 3), "uint8")
    goal = Goal("uint8[] data")
    with pytest.raises(ValueError, match="one dimension expected, found 2: flatten the array"):
        goal.encoded(data=image)
    assert goal.codec.decode(goal.encoded(data=image.ravel())).data == bytes(6)
