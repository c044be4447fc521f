"""A node of rclpy in the process of the tests, which a thread spins."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import Any

from rclpy.executors import ExternalShutdownException

from fibaction_transports.ros2.on_rclpy.rcl import Context, SingleThreadedExecutor, rclpy


@contextmanager
def spun_node(namespace: str, name: str = "mine", *arguments: str) -> Generator[Any, None, None]:
    """Make a node in a context of its own, and spin it for as long as the block lasts."""
    context = Context()
    rclpy.init(args=list(arguments), context=context)
    node = rclpy.create_node(name, context=context, namespace=namespace)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stop = rclpy.task.Future()

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin_until_future_complete(stop)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield node
    finally:
        stop.set_result(None)
        thread.join()
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
