"""fibaction over `ros2://`. Both ends run with the Python that has ROS 2."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio

import fibaction
from fibaction import Action, ActionServer, GoalHandle
from tests.benchmarks.contender import PACED, PAUSE, PENDING, Contender, stamped
from tests.benchmarks.over_fibaction import OverFibaction
from tests.fibonacci import Feedback, Goal, Result

ACTION = Action(
    "benchmark_fibaction",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)


async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    wanted = goal.request.order
    if wanted >= PACED:
        for _ in range(wanted - PACED):
            await anyio.sleep(PAUSE)
            yield Feedback(stamped())
    else:
        feedback = Feedback([1, 2, 3])
        for _ in range(wanted):
            yield feedback
    if wanted == PENDING:
        await anyio.sleep_forever()
    yield Result([wanted])


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with fibaction.serve(ActionServer(ACTION, execute), "ros2://benchmark"):
        yield "ros2://"


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        await client.wait_for_server()
        yield OverFibaction(client, Goal, lambda feedback: feedback.partial_sequence)
