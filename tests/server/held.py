"""Goals of Fibonacci as bytes, executors and callbacks that wait, and calls that fail."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalHandle, GoalID
from fibaction.border.abc import GoalStream
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result


def id_of(number: int) -> GoalID:
    return GoalID(number.to_bytes(16, "big"))


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


async def waits(goal: GoalHandle[Goal]) -> Items:
    """Report once, and wait for ever."""
    yield Feedback([goal.request.order])
    await anyio.sleep_forever()
    yield Result([])


def waited_for(
    offered: GoalStream | Coroutine[Any, Any, GoalStream],
) -> Coroutine[Any, Any, GoalStream]:
    """Return the coroutine that waits for the decision on a goal."""
    assert not isinstance(offered, GoalStream)
    return offered


class Gate:
    """An `on_goal` that decides when it is told to."""

    def __init__(self) -> None:
        self.asked: list[Goal] = []
        self.open = anyio.Event()

    async def __call__(self, goal: Goal) -> None:
        self.asked.append(goal)
        await self.open.wait()


async def start_many(server: ActionServer[Goal, Feedback, Result], count: int) -> list[GoalStream]:
    streams: list[GoalStream] = [
        await server.send_goal(GoalID.random(), packed(order)) for order in range(count)
    ]
    await anyio.wait_all_tasks_blocked()
    return streams


async def fails(
    error: type[Exception], text: str, call: Callable[..., Awaitable[object]], *args: Any
) -> None:
    """Make a call, which raises this error with this text."""
    with pytest.raises(error, match=text):
        await call(*args)


async def turns_during(work: Coroutine[Any, Any, object]) -> int:
    """Return the number of turns that another task has during the work."""
    turns = 0

    async def take_turns() -> None:
        nonlocal turns
        while True:
            await anyio.lowlevel.checkpoint()
            turns += 1

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(take_turns)
        await work
        tasks.cancel_scope.cancel()
    return turns
