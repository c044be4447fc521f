"""Servers and clients of fibaction over `dds://`, in the process of the tests."""

from __future__ import annotations

import uuid
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import TypeAlias

import anyio

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    connect,
)
from tests.ros2.stock import orders
from tests.ros2.stock.process import Peer
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import Feedback, Goal, Result
from tests.transports.cyclone.partner import partner

FibonacciClient: TypeAlias = ActionClient[Goal, Feedback, Result]
TYPE = "arduinobot_msgs/action/Fibonacci"
NINE = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34]


def new_name() -> str:
    """Return the name of an action that no other test has."""
    return f"t{uuid.uuid4().hex}/fibonacci"


def action(name: str) -> Action[Goal, Feedback, Result]:
    return Action(name, goal=Goal, feedback=Feedback, result=Result, type_name=TYPE)


async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    order = goal.request.order
    if order <= orders.MOST:
        sequence = [0, 1]
        for _ in range(1, order):
            sequence.append(sequence[-1] + sequence[-2])
            yield Feedback(sequence)
        yield Result(sequence)
    elif order == orders.ABORTS:
        raise GoalAborted("the pen is lost", result=Result(orders.PART))
    else:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            raise GoalCanceled("asked to stop", result=Result(orders.PART)) from None


def server(
    name: str, note: Callable[[int], None] = lambda order: None
) -> ActionServer[Goal, Feedback, Result]:
    """Return a server that notes the order of each goal."""

    def on_goal(goal: Goal) -> None:
        note(goal.order)
        if goal.order < 0:
            raise GoalRejected("a sequence has no negative length")

    return ActionServer(action(name), execute, on_goal=on_goal)


@asynccontextmanager
async def client(name: str) -> AsyncGenerator[FibonacciClient, None]:
    """A client whose server is there."""
    async with connect("dds://", action(name)) as found:
        await found.wait_for_server(10)
        yield found


@asynccontextmanager
async def cyclone_server(name: str) -> AsyncGenerator[Peer, None]:
    """A server of Cyclone in another process."""
    async with partner("action_server") as found:
        await found.ask("serve", action=f"/{name}")
        yield found


@asynccontextmanager
async def cyclone_client(name: str) -> AsyncGenerator[Peer, None]:
    """A client of Cyclone in another process, which has found a server."""
    async with partner("action_client") as found:
        await found.ask("connect", action=f"/{name}")

        async def servers() -> int:
            return int(await found.ask("servers"))

        await eventually(servers, bool)
        yield found
