"""Goals of Fibonacci as bytes, and an executor that waits, for the tests of a server's parts."""

from __future__ import annotations

import anyio

from fibaction import GoalHandle
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Goal, Result


def packed(order: int) -> bytes:
    return FIBONACCI.goal.encode(Goal(order))


def result(sequence: list[int]) -> bytes:
    return FIBONACCI.result.encode(Result(sequence))


class Held:
    """An executor that waits until it is let go."""

    def __init__(self) -> None:
        self.begun = anyio.Event()
        self.go = anyio.Event()

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        self.begun.set()
        await self.go.wait()
        yield Result([goal.request.order])
