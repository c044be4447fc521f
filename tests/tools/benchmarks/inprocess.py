"""The action of the benchmarks of fibaction, and its executor."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from typing import Any

import msgspec

from fibaction import Action, ActionClient, GoalHandle
from tests.tools.benchmarks.contender import messages_of


class Goal(msgspec.Struct):
    count: int


class Feedback(msgspec.Struct):
    numbers: list[int]


class Result(msgspec.Struct):
    count: int


ACTION = Action("count", goal=Goal, feedback=Feedback, result=Result)
Client = ActionClient[Goal, Feedback, Result]


def executor(
    wanted_of: Callable[[Any], int],
    feedback: Callable[[list[int]], Any],
    result: Callable[[int], Any],
) -> Callable[[GoalHandle[Any]], AsyncGenerator[Any, None]]:
    """Return an executor for given message types that does what the number of a goal says: see
    `contender`.
    """

    async def execute(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        wanted = wanted_of(goal.request)
        async for message in messages_of(wanted, feedback):
            yield message
        yield result(wanted)

    return execute


count = executor(lambda goal: goal.count, Feedback, Result)
