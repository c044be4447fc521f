"""Action servers of rclpy whose goals run at the same time, in a process of their own."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor

from tests.ros2.stock.telling import say, shut_down_at_the_end, spin

PERIOD = 0.02
"""The seconds between two messages of feedback."""


def wait() -> None:
    """Wait until it is time for the next feedback."""
    time.sleep(PERIOD)  # noqa: TID251  # a server of rclpy blocks its thread


def serve(node_name: str, *actions: tuple[Any, str, Callable[[Any], Any]]) -> None:
    """Serve actions, each with its type, name and executor, until standard input ends."""
    rclpy.init()
    node = rclpy.create_node(node_name)
    group = ReentrantCallbackGroup()
    servers = [
        ActionServer(
            node,
            kind,
            name,
            execute,
            callback_group=group,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
        )
        for kind, name, execute in actions
    ]
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    shut_down_at_the_end()
    say("ready")
    spin(executor)
    del servers  # rclpy does not keep them
