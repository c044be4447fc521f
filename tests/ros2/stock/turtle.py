"""The turtle of turtlesim, as far as programs see it: `/turtle1/cmd_vel` and `/turtle1/pose`."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import Twist
from rclpy.executors import ExternalShutdownException
from turtlesim.msg import Pose

from tests.ros2.stock.telling import say, shut_down_at_the_end

PERIOD = 0.016


class Turtle:
    def __init__(self, node: Any) -> None:
        self._pose = Pose(x=5.5, y=5.5)
        self._publisher = node.create_publisher(Pose, "/turtle1/pose", 10)
        node.create_subscription(Twist, "/turtle1/cmd_vel", self._follow, 10)
        node.create_timer(PERIOD, self._swim)

    def _follow(self, twist: Twist) -> None:
        self._pose.linear_velocity = twist.linear.x

    def _swim(self) -> None:
        self._pose.x += self._pose.linear_velocity * PERIOD
        self._publisher.publish(self._pose)


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("turtlesim")
    turtle = Turtle(node)
    shut_down_at_the_end()
    say("ready")
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
