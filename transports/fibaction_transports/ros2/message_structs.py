"""The types of ROS for the core: those of `Action.from_ros`, and any class of a message."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.convert.message_classes import ClassCodec


def message_types(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """Return structs for the goal, the feedback and the result of a ROS action type.

    Its package is one of ROS where rclpy is installed; elsewhere its interface file is looked for.

    Raises:
        TransportError: As for `RosTypes.find`.
    """
    if find_spec("rclpy") is None:
        from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes

        return FileTypes().find(type_name).types
    from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes  # which needs rclpy

    return RclpyTypes().find(type_name).types


def message_classes(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """Return ROS's classes for the goal, the feedback and the result of a ROS action type.

    Raises:
        TransportError: As for `RosTypes.find`, or rclpy is not installed.
    """
    if find_spec("rclpy") is None:
        raise TransportError(
            f"the classes of {type_name} are made by ROS, which is not found here: source the"
            " setup.bash of ROS, or use structs, which need no ROS"
        )
    from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes  # which needs rclpy

    return RclpyTypes().find(type_name).classes


def message_class(kind: type[Any]) -> ClassCodec:
    """Describe a class of ROS.

    Raises:
        TransportError: It has a field that ROS's own Python code cannot handle.
    """
    return ClassCodec(kind)
