"""The contract of all transports, over ROS 2, through rclpy, with fibaction at both ends."""

from __future__ import annotations

from tests.support.contract_over_ros import contract_over

globals().update(contract_over("ros2"))
