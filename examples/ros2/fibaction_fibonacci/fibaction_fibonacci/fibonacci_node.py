"""A node that serves the Fibonacci action, for `ros2 run` and `ros2 launch`.

ROS reads `--ros-args` from the command line by itself: names, namespaces and parameters.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from signal import SIGINT, SIGTERM

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, serve


class Goal(msgspec.Struct):
    """A request for the numbers up to an index."""

    order: int


class Feedback(msgspec.Struct):
    """The numbers so far."""

    partial_sequence: list[int]


class Result(msgspec.Struct):
    """All numbers that were requested."""

    sequence: list[int]


FIBONACCI = Action(
    "fibonacci",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)


async def fibonacci(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    """Yield the numbers so far every second."""
    numbers = [0, 1]
    while len(numbers) <= goal.request.order:
        await anyio.sleep(1)
        numbers.append(numbers[-2] + numbers[-1])
        yield Feedback(numbers)
    yield Result(numbers[: goal.request.order + 1])


async def run() -> None:
    """Serve until a signal comes."""
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(ActionServer(FIBONACCI, fibonacci), "ros2://fibonacci") as (url,):
            print(f"serving {FIBONACCI.name} at {url}", flush=True)
            await anext(signals)


def main() -> None:
    """Be the process of the node."""
    anyio.run(run)
