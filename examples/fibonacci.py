"""The Fibonacci action: its messages, its rule for goals, its executor.

The other Fibonacci examples share it. It does not depend on how it is served or called.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from functools import partial

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalCanceled, GoalHandle, GoalRejected

URL = "tcp://127.0.0.1:7400"
"""The default URL of server and client."""

MAX_ORDER = 46
"""The index of the last number that fits the `int32[]` of the ROS 2 action: 1836311903."""


class Goal(msgspec.Struct):
    """A request for the Fibonacci numbers 0, 1, 1, 2, 3 and so on."""

    order: int
    """The index of the last number; the first has index 0."""


class Feedback(msgspec.Struct):
    """The numbers so far."""

    partial_sequence: list[int]


class Result(msgspec.Struct):
    """All numbers that were requested; after a cancel, the numbers so far."""

    sequence: list[int]


FIBONACCI = Action(
    "fibonacci",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)


def on_goal(goal: Goal) -> None:
    """Accept an order from 0 to `MAX_ORDER`.

    Raises:
        GoalRejected: The order is out of range.
    """
    if goal.order < 0:
        raise GoalRejected(f"order is {goal.order}, and the index of a number is 0 or more")
    if goal.order > MAX_ORDER:
        raise GoalRejected(
            f"order is {goal.order}, and the numbers after index {MAX_ORDER} do not fit int32"
        )


async def fibonacci(
    goal: GoalHandle[Goal], period: float = 1.0
) -> AsyncGenerator[Feedback | Result, None]:
    """Compute one number every `period` seconds; the first two take no time."""
    order = goal.request.order
    sequence = [0, 1][: order + 1]
    try:
        while len(sequence) <= order:
            await anyio.sleep(period)
            sequence.append(sequence[-1] + sequence[-2])
            yield Feedback(sequence)
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled(result=Result(sequence)) from None
    yield Result(sequence)


def make_server(period: float = 1.0) -> ActionServer[Goal, Feedback, Result]:
    """Return a server of the action that takes `period` seconds for each number."""
    return ActionServer(FIBONACCI, partial(fibonacci, period=period), on_goal=on_goal)
