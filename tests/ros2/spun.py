"""A node of rclpy in the process of the tests, which a thread spins, and one of ours beside it."""

from __future__ import annotations

import threading
import uuid
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import Any

import anyio
from rclpy.executors import ExternalShutdownException

from fibaction_transports.ros2 import Node, open_node
from fibaction_transports.ros2.on_rclpy.rcl import Context, SingleThreadedExecutor, rclpy
from tests.support.processes import PATIENCE


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


@asynccontextmanager
async def beside_rclpy(
    scheme: str, patience: float = PATIENCE
) -> AsyncGenerator[tuple[Node, Any], None]:
    """Open a node of ours and one of rclpy in one namespace, for as long as the block lasts, which
    is at most `patience` seconds.
    """
    space = f"/t{uuid.uuid4().hex}"
    with anyio.fail_after(patience), spun_node(space, "stock") as stock:
        async with open_node(f"{scheme}://ours", namespace=space, arguments=[]) as node:
            yield node, stock
