"""An action for tests: the messages of Fibonacci, with executors that do as they are told."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import msgspec

from fibaction import Action, GoalHandle


class Goal(msgspec.Struct):
    order: int


class Feedback(msgspec.Struct):
    partial_sequence: list[int]


class Result(msgspec.Struct):
    sequence: list[int]


FIBONACCI = Action(
    "fibonacci",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)


async def fibonacci(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    """Compute at once, with one feedback per term after the first two."""
    sequence = [0, 1]
    while len(sequence) <= goal.request.order:
        sequence.append(sequence[-1] + sequence[-2])
        yield Feedback(sequence)
    yield Result(sequence[: goal.request.order + 1])
