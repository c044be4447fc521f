"""An imitation of `rclpy.experimental.AsyncNode`, which the releases of these tests do not have.

It has the shape of the one of ROS 2 Lyrical as far as the page uses it: `async with` runs the node
on the event loop, callbacks of subscriptions may be coroutine functions, the next message waits for
the end of the callback, an exception ends the block, and there is no `add_waitable`. Programs of
the page have a copy of this module beside them.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # as the node that it imitates
from collections.abc import Awaitable, Callable
from threading import Thread
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor


class AsyncNode:
    """A node whose callbacks run on the event loop."""

    def __init__(self, node_name: str) -> None:
        self._node = rclpy.create_node(node_name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._spinner = Thread(target=self._executor.spin)
        self._tasks = asyncio.TaskGroup()
        self._reading: list[asyncio.Task[None]] = []

    def get_namespace(self) -> str:
        return str(self._node.get_namespace())

    async def __aenter__(self) -> AsyncNode:
        await self._tasks.__aenter__()
        self._spinner.start()
        return self

    async def __aexit__(self, *error: Any) -> None:
        self._executor.shutdown()
        self._spinner.join()
        self._node.destroy_node()
        for task in self._reading:
            task.cancel()
        await self._tasks.__aexit__(*error)

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], Awaitable[None] | None],
        qos_profile: Any,
    ) -> None:
        loop = asyncio.get_running_loop()
        messages = asyncio.Queue[Any]()

        def take(message: Any) -> None:
            loop.call_soon_threadsafe(messages.put_nowait, message)

        async def read() -> None:
            while True:
                done = callback(await messages.get())
                if done is not None:
                    await done

        self._node.create_subscription(msg_type, topic, take, qos_profile)
        self._reading.append(self._tasks.create_task(read()))
