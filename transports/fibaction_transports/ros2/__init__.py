"""Actions of ROS 2: servers for any client of ROS, and clients of any server of ROS.

Importing this package needs rclpy. Nothing else in fibaction does.
"""

from __future__ import annotations

from importlib.util import find_spec

from fibaction.words.errors import TransportError

if find_spec("rclpy") is None:
    raise TransportError(
        "ros2:// needs rclpy, which this Python does not find: source the setup.bash of a ROS 2"
        " installation, or, to try it out on Linux, use the wheels of a third party: pip install"
        " 'ros-rclpy[fastrtps]'"
    )

from fibaction_transports.ros2.ros2_transport import Ros2Transport  # after that check

__all__ = ["Ros2Transport"]
