"""`python -m tests.tools.benchmarks.ros2_fibaction server|client`: fibaction over ROS 2.

It does what `ros2_rclpy` does: the benchmark tells it by lines of JSON.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from time import perf_counter
from typing import Any

import anyio

from fibaction import ActionClient, ActionServer, ClientGoal, GoalHandle, connect, serve
from tests.ros2.stock.ours import action
from tests.ros2.stock.telling import say, told
from tests.support.fibonacci import Feedback, Goal, Result
from tests.tools.benchmarks.ros2_orders import LONG, PENDING

ACTION = action("benchmark_fibaction")


async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    order = goal.request.order
    if order == PENDING:
        await anyio.sleep_forever()
    if order > LONG:
        feedback = Feedback([0, 1, 1])
        for _ in range(order - LONG):
            yield feedback
        order = 0
    sequence = [0, 1]
    for _ in range(1, order):
        sequence.append(sequence[-1] + sequence[-2])
        yield Feedback(sequence)
    yield Result(sequence)


class Client:
    def __init__(self, client: ActionClient[Goal, Feedback, Result]) -> None:
        self._client = client
        self._pending: list[ClientGoal[Feedback, Result]] = []

    async def goals(self, times: int) -> list[float]:
        """Return the seconds that each of the goals took, one after another."""
        seconds: list[float] = []
        for _ in range(times):
            start = perf_counter()
            await self._client.call(Goal(0))
            seconds.append(perf_counter() - start)
        return seconds

    async def feedback(self, times: int, order: int) -> list[float]:
        """Return the number of messages that arrived, and the seconds that all took."""
        arrived = 0
        start = perf_counter()
        for _ in range(times):
            async with self._client.send_goal(Goal(order)) as goal:
                async for _ in goal.feedback:
                    arrived += 1
                await goal.result()
        return [arrived, perf_counter() - start]

    async def batch(self, times: int, patience: float) -> list[float]:
        """Return the number of goals that succeeded, and the seconds that they took."""
        done = 0

        async def call() -> None:
            nonlocal done
            await self._client.call(Goal(0))
            done += 1

        start = perf_counter()
        with anyio.move_on_after(patience):
            async with anyio.create_task_group() as tasks:
                for _ in range(times):
                    tasks.start_soon(call)
        return [done, perf_counter() - start]

    async def hold(self, times: int) -> None:
        """Send so many pending goals."""
        self._pending = [await self._client.send_goal(Goal(PENDING)) for _ in range(times)]

    async def release(self) -> None:
        await self._client.cancel_goals()
        for goal in self._pending:
            await goal.outcome()


async def run_server() -> None:
    async with serve(ActionServer(ACTION, execute), "ros2://"):
        say("ready")
        await anyio.to_thread.run_sync(lambda: list(told()), abandon_on_cancel=True)


async def run_client() -> None:
    async with connect("ros2://", ACTION) as found:
        await found.wait_for_server()
        client = Client(found)
        say("ready")
        orders = told()
        while order := await anyio.to_thread.run_sync(next, orders, None, abandon_on_cancel=True):
            say({"answer": await getattr(client, order.pop("do"))(**order)})


WAYS: dict[str, Any] = {"server": run_server, "client": run_client}

if __name__ == "__main__":
    anyio.run(WAYS[sys.argv[1]])
