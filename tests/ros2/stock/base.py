"""The other nodes of a mobile base: wheels with odometry, and RViz, where someone clicks.

The wheels follow `cmd_vel` in both directions, without turning, and publish where they are.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException

from tests.ros2.stock.telling import say, shut_down_at_the_end

PERIOD = 0.02
"""The seconds between two messages of odometry."""
CLICKS = 1.0
"""The seconds between two clicks."""


class Wheels:
    """Wheels that are at once as fast as they should be."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._here = Odometry(child_frame_id="base_link")
        self._here.header.frame_id = "odom"
        self._publisher = node.create_publisher(Odometry, "odom", 10)
        node.create_subscription(Twist, "cmd_vel", self._follow, 10)
        node.create_timer(PERIOD, self._roll)

    def _follow(self, twist: Twist) -> None:
        self._here.twist.twist = twist

    def _roll(self) -> None:
        position, speed = self._here.pose.pose.position, self._here.twist.twist.linear
        position.x += speed.x * PERIOD
        position.y += speed.y * PERIOD
        self._here.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(self._here)


def click_again_and_again(node: Any) -> None:
    """Click at one pose, as with the button "2D Goal Pose"."""
    pose = PoseStamped()
    pose.header.frame_id = "map"
    pose.pose.position.x = 1.0
    publisher = node.create_publisher(PoseStamped, "goal_pose", 10)
    node.create_timer(CLICKS, lambda: publisher.publish(pose))


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("wheels")
    wheels = Wheels(node)
    click_again_and_again(node)
    shut_down_at_the_end()
    say("ready")
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
