"""Structs for the messages of an action of ROS, for `Action.from_ros`."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from fibaction_transports.ros2.on_dds.messages.dds_types import DdsTypes


def message_types(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """Return structs for the goal, the feedback and the result of a ROS action type.

    Its package is one of ROS where rclpy is installed; elsewhere its interface file is looked for.

    Raises:
        TransportError: As for `RosTypes.find`.
    """
    if find_spec("rclpy") is None:
        return DdsTypes().find(type_name).types
    from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes  # which needs rclpy

    return RclpyTypes().find(type_name).types
