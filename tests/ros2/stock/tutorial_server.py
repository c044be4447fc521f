"""The server of ROS 2's tutorial, with shorter sleeps.

It blocks while it executes, and rejects cancels, because it has no callback for them.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import rclpy
from arduinobot_msgs.action import Fibonacci
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from tests.ros2.stock.telling import say, shut_down_at_the_end

STEP = 0.1


class FibonacciActionServer(Node):  # type: ignore[misc]  # rclpy has no types here
    def __init__(self) -> None:
        super().__init__("fibonacci_action_server")
        self._action_server = ActionServer(self, Fibonacci, "tutorial", self.execute_callback)

    def execute_callback(self, goal_handle: Any) -> Any:
        self.get_logger().info("Executing goal...")
        feedback_msg = Fibonacci.Feedback()
        feedback_msg.partial_sequence = [0, 1]
        for i in range(1, goal_handle.request.order):
            feedback_msg.partial_sequence.append(
                feedback_msg.partial_sequence[i] + feedback_msg.partial_sequence[i - 1]
            )
            goal_handle.publish_feedback(feedback_msg)
            time.sleep(STEP)  # noqa: TID251  # it is in the tutorial, and is what is tested
        goal_handle.succeed()
        result = Fibonacci.Result()
        result.sequence = feedback_msg.partial_sequence
        return result


def main() -> None:
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.init()
        fibonacci_action_server = FibonacciActionServer()
        shut_down_at_the_end()
        say("ready")
        rclpy.spin(fibonacci_action_server)


if __name__ == "__main__":
    main()
