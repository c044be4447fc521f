"""A robot whose goals end as their order says, and the messages about them."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import anyio

from fibaction import (
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
)
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

TYPE = "arduinobot_msgs/action/Fibonacci"


class Robot:
    """An executor whose goals end as their order says."""

    def __init__(self) -> None:
        self.go_on = anyio.Event()
        self.ended = anyio.Event()
        """Set if a goal was interrupted."""
        self.runs = 0
        self.refuses_cancels = False
        self.server = ActionServer(FIBONACCI, self, on_goal=self.on_goal, on_cancel=self.on_cancel)

    def on_goal(self, goal: Goal) -> None:
        if goal.order < 0:
            raise GoalRejected("order is negative")

    def on_cancel(self, goal: GoalHandle[Goal]) -> None:
        if self.refuses_cancels:
            raise CancelRejected("it is nearly done")

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        self.runs += 1
        order = goal.request.order
        yield Feedback([0])
        yield Feedback([0, order])
        if order == 6:
            raise GoalAborted("six is too many")
        if order == 7:
            raise GoalAborted("seven is too many", result=Result([7]))
        if order >= 50:
            try:
                await self.go_on.wait()
            except BaseException:
                self.ended.set()
                if order == 51:
                    raise GoalCanceled("stopped", result=Result([5, 1])) from None
                raise
        yield Result([order])


def goal(order: Any, **more: Any) -> dict[str, Any]:
    members = {"op": "send_action_goal", "id": "g1", "action": "/fibonacci", "action_type": TYPE}
    return members | {"args": {"order": order}, "feedback": True} | more


def result(values: Any, status: int = 4, *, ok: bool = True, **more: Any) -> dict[str, Any]:
    members = {"op": "action_result", "id": "g1", "action": "/fibonacci", "values": values}
    return members | {"status": status, "result": ok} | more


def feedback(*numbers: int, **more: Any) -> dict[str, Any]:
    members = {"op": "action_feedback", "id": "g1", "action": "/fibonacci"}
    return members | {"values": {"partial_sequence": list(numbers)}} | more
