"""The action of the example: a robot picks the items of an order from their shelves.

An order that has begun goes on with another robot if its own is gone: what was picked is kept after
each item.
"""

from __future__ import annotations

from typing import Any

import anyio
from msgspec import Struct

from fibaction import (
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    Report,
    Schedule,
    action,
)

URL = "nats://127.0.0.1:4222/warehouse"
AT_ONCE = 2
"""Orders that a robot picks at the same time; more wait until any robot has room."""
WAITING = 20
DAY = 24 * 60 * 60


class Order(Struct):
    """An order of so many items."""

    items: int


class Progress(Struct):
    """The number of items that are picked, and the robot that has picked the last one."""

    items: int
    robot: str


class Picked(Struct):
    """The number of items in the box, also if the order was canceled."""

    items: int


def on_goal(order: Order) -> None:
    """Accept an order of at least one item.

    Raises:
        GoalRejected: There is nothing to pick.
    """
    if order.items < 1:
        raise GoalRejected(f"an order has 1 item or more, not {order.items}")


class Robot:
    """A robot that takes `period` seconds for each item."""

    def __init__(self, name: str, period: float) -> None:
        self._name = name
        self._period = period

    @action(checkpoint=int)
    async def pick(
        self, report: Report[Progress], goal: GoalHandle[object], order: Order
    ) -> Picked:
        """Pick one item after the other, from the last one that was kept."""
        items: int = goal.restored or 0
        try:
            while items < order.items:
                await anyio.sleep(self._period)
                # A kill at this point makes the next robot pick this item again.
                items += 1
                await goal.checkpoint(items)
                await report(Progress(items, self._name))
        except anyio.get_cancelled_exc_class():
            raise GoalCanceled(result=Picked(items)) from None
        return Picked(items)


def make_server(name: str, period: float) -> ActionServer[Any, Progress, Picked]:
    """Return a robot whose orders go on with other robots when it stops or is gone."""
    return ActionServer(
        Robot(name, period).pick,
        on_goal=on_goal,
        schedule=Schedule(concurrency=AT_ONCE, queue=WAITING),
        recovery="rerun",
        at_stop="keep",
        result_timeout=DAY,
    )
