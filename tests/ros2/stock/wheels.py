"""A mobile base of rclpy in a namespace of its own, `wheels NAMESPACE`, as far as an executor needs
it: `cmd_vel`, `odom`, a service for its motors, and `/tf` in a map that begins two metres aside.
"""

from __future__ import annotations

import sys
import time
from itertools import pairwise
from statistics import median
from threading import Thread
from typing import Any

import rclpy
from geometry_msgs.msg import TransformStamped, Twist
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from tests.ros2.stock.base import Wheels
from tests.ros2.stock.telling import leave, say, spin, told

STATIC = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Robot(Wheels):
    def __init__(self, node: Any) -> None:
        super().__init__(node)
        self._is_on = False
        self._commands: list[tuple[float, float]] = []
        """The time and the speed of each command."""
        node.create_service(SetBool, "enable_motors", self._enable)
        self._transforms = node.create_publisher(TFMessage, "/tf", 100)
        self._static = node.create_publisher(TFMessage, "/tf_static", STATIC)
        self._static.publish(self._transform("map", "odom", y=2.0))

    def _transform(self, parent: str, child: str, x: float = 0.0, y: float = 0.0) -> Any:
        found = TransformStamped(child_frame_id=child)
        found.header.frame_id = parent
        found.header.stamp = self._node.get_clock().now().to_msg()
        found.transform.translation.x, found.transform.translation.y = x, y
        return TFMessage(transforms=[found])

    def _enable(self, request: Any, response: Any) -> Any:
        self._is_on = response.success = request.data
        return response

    def _follow(self, twist: Twist) -> None:
        self._commands.append((time.monotonic(), twist.linear.x))
        if self._is_on:
            super()._follow(twist)

    def _roll(self) -> None:
        super()._roll()
        x = self._here.pose.pose.position.x
        self._transforms.publish(self._transform("odom", "base_link", x))

    def told(self) -> dict[str, Any]:
        """Return where it is, the time and speed of the last command, and the usual time between
        two.
        """
        gaps = [after[0] - before[0] for before, after in pairwise(self._commands)]
        at, speed = self._commands[-1] if self._commands else (0.0, 0.0)
        x = self._here.pose.pose.position.x
        return {"x": x, "at": at, "speed": speed, "gap": median(gaps or [0.0])}


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("wheels", namespace=sys.argv[1])
    robot = Robot(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = Thread(target=spin, args=[executor])
    spinner.start()
    say("ready")
    for _ in told():
        say({"answer": robot.told()})
    leave(spinner, node)
