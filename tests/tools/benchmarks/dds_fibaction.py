"""`python -m tests.tools.benchmarks.dds_fibaction server|client NAME`: fibaction at `dds://`.

It does what `ros2_rclpy` does, without rclpy.
"""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncGenerator, AsyncIterator
from time import perf_counter, process_time
from typing import Any

import anyio
import msgspec

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Return, connect, serve
from tests.support.fibonacci import Feedback, Goal, Result
from tests.tools.benchmarks.ros2_orders import LARGE, LARGE_PAUSE, LARGE_TYPE, LONG


class Text(msgspec.Struct):
    text: str


def action(name: str) -> Action[Goal, Feedback, Result]:
    return Action(
        name,
        goal=Goal,
        feedback=Feedback,
        result=Result,
        type_name="arduinobot_msgs/action/Fibonacci",
    )


def large_action(name: str) -> Action[Text, Text, Text]:
    return Action(f"{name}_large", goal=Text, feedback=Text, result=Text, type_name=LARGE_TYPE)


async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    order = goal.request.order
    feedback = Feedback([0, 1, 1])
    for _ in range(order - LONG):
        yield feedback
    yield Result([0, 1])


async def execute_large(goal: GoalHandle[Text]) -> AsyncGenerator[Text | Return[Text], None]:
    feedback = Text("x" * LARGE)
    for _ in range(int(goal.request.text)):
        await anyio.sleep(LARGE_PAUSE)
        yield feedback
    yield Return(Text("done"))


class Client:
    def __init__(
        self,
        client: ActionClient[Goal, Feedback, Result],
        large: ActionClient[Text, Text, Text],
    ) -> None:
        self._client = client
        self._large = large

    async def goals(self, times: int) -> float:
        """Return the seconds that the goals took, one after another."""
        start = perf_counter()
        for _ in range(times):
            await self._client.call(Goal(0))
        return perf_counter() - start

    async def batch(self, times: int) -> float:
        """Return the seconds that goals took which were sent at once."""
        start = perf_counter()
        async with anyio.create_task_group() as tasks:
            for _ in range(times):
                tasks.start_soon(self._client.call, Goal(0))
        return perf_counter() - start

    async def feedback(self, times: int) -> list[float]:
        """Return the number of messages of one goal that arrived, and the seconds."""
        arrived = 0
        start = perf_counter()
        async with self._client.send_goal(Goal(LONG + times)) as goal:
            async for _ in goal.feedback:
                arrived += 1
            await goal.result()
        return [arrived, perf_counter() - start]

    async def large(self, times: int) -> list[float]:
        """Return the number of large messages that arrived whole, the seconds, and those of the
        processor.
        """
        arrived, start, used = 0, perf_counter(), process_time()
        async with self._large.send_goal(Text(str(times))) as goal:
            async for feedback in goal.feedback:
                arrived += len(feedback.text) == LARGE
            await goal.result()
        return [arrived, perf_counter() - start, process_time() - used]


async def run_server(name: str) -> None:
    servers = (
        ActionServer(action(name), execute),
        ActionServer(large_action(name), execute_large),
    )
    async with serve(servers, "dds://benchmark_server"):
        say("ready")
        async for _ in orders():
            pass


async def run_client(name: str) -> None:
    async with connect("dds://benchmark_client") as connection:
        small, large = connection.client(action(name)), connection.client(large_action(name))
        await small.wait_for_server()
        await large.wait_for_server()
        client = Client(small, large)
        say("ready")
        async for order in orders():
            say({"answer": await getattr(client, order.pop("do"))(**order)})


def say(value: Any) -> None:
    print(json.dumps(value), flush=True)


async def orders() -> AsyncIterator[dict[str, Any]]:
    """Yield the orders of the standard input, until it ends."""
    while line := await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True):
        yield json.loads(line)


WAYS: dict[str, Any] = {"server": run_server, "client": run_client}

if __name__ == "__main__":
    anyio.run(WAYS[sys.argv[1]], sys.argv[2])
    if "rclpy" in sys.modules:
        raise SystemExit("rclpy was imported")
