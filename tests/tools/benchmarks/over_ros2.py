"""fibaction over `ros2://`. Both ends run with the Python that has ROS 2."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import fibaction
from fibaction import Action, ActionServer
from tests.support.fibonacci import Feedback, Goal, Result
from tests.tools.benchmarks.contender import Contender
from tests.tools.benchmarks.inprocess import executor
from tests.tools.benchmarks.over_fibaction import OverFibaction

ACTION = Action(
    "benchmark_fibaction",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)

execute = executor(lambda goal: goal.order, Feedback, lambda wanted: Result([wanted]))


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with fibaction.serve(ActionServer(ACTION, execute), "ros2://benchmark"):
        yield "ros2://"


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        await client.wait_for_server()
        yield OverFibaction(client, Goal, lambda feedback: feedback.partial_sequence)
