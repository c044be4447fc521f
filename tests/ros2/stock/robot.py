"""A stock server of rclpy in a namespace of its own: `robot NAMESPACE`."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any

import rclpy
from arduinobot_msgs.action import Fibonacci
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException

from tests.ros2.stock.telling import say, shut_down_at_the_end


def execute(handle: Any) -> Any:
    handle.succeed()
    return Fibonacci.Result()


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("server", namespace=sys.argv[1])
    server = ActionServer(node, Fibonacci, "fibonacci", execute)
    shut_down_at_the_end()
    say("ready")
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
