"""`python -m tests.ros2.stock.echo server|client NAME`: stock rclpy, with texts of any size."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any

import rclpy
from fibaction_test_msgs.action import Echo
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from tests.ros2.stock.telling import say, shut_down_at_the_end, told

PATIENCE = 25.0


def run_server(node: Any, name: str) -> None:
    """Serve an action whose feedback and result have the text of the goal."""

    def execute(handle: Any) -> Any:
        text = handle.request.text
        handle.publish_feedback(Echo.Feedback(text=text))
        handle.succeed()
        return Echo.Result(text=text)

    server = ActionServer(node, Echo, name, execute)
    shut_down_at_the_end()
    say("ready")
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
    del server  # rclpy does not keep it


class Client:
    def __init__(self, node: Any, name: str) -> None:
        self._client = ActionClient(node, Echo, name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        assert self._client.wait_for_server(timeout_sec=PATIENCE)

    def _wait(self, future: Any) -> Any:
        self._executor.spin_until_future_complete(future, PATIENCE)
        return future.result()

    def call(self, text: str) -> dict[str, Any]:
        """Run a goal, and return its status, and whether its texts are those of the goal."""
        feedback: list[bool] = []
        handle = self._wait(
            self._client.send_goal_async(
                Echo.Goal(text=text),
                feedback_callback=lambda m: feedback.append(m.feedback.text == text),
            )
        )
        answer = self._wait(handle.get_result_async())
        return {
            "status": answer.status,
            "feedback": feedback,
            "is_same": answer.result.text == text,
        }


def run_client(node: Any, name: str) -> None:
    client = Client(node, name)
    say("ready")
    for order in told():
        say({"answer": getattr(client, order.pop("do"))(**order)})


if __name__ == "__main__":
    rclpy.init()
    way = {"server": run_server, "client": run_client}[sys.argv[1]]
    way(rclpy.create_node(f"echo_{sys.argv[1]}"), sys.argv[2])
