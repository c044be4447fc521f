"""ROS 2 by rclpy, which nothing else in fibaction imports."""

from __future__ import annotations

from importlib.util import find_spec

from fibaction.words.errors import TransportError

if find_spec("rclpy") is None:
    raise TransportError(
        "ros2:// needs rclpy, which this Python does not find: source the setup.bash of a ROS 2"
        " installation, or, to try it out on Linux, use the wheels of a third party: pip install"
        " 'ros-rclpy[fastrtps]'"
    )

# After that check
from fibaction_transports.ros2.on_rclpy.rclpy_adapter import RclpyAdapter

__all__ = ["RclpyAdapter"]
