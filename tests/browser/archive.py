"""A robot whose past is in a history only: `python -m tests.browser.archive URL FILE` serves it.

It says that it serves once its goals have run, and are forgotten but for the history.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from contextlib import suppress
from typing import Any

import anyio
import msgspec

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    SqliteStore,
    serve,
)


class Spot(msgspec.Struct):
    """A place on a wall."""

    x: float
    y: float


class Paint(msgspec.Struct):
    """An order to paint spots of a wall."""

    order: int
    color: str = "red"
    spots: list[Spot] = []


class Painted(msgspec.Struct):
    """The paint that it took."""

    liters: float
    color: str


PAINT = Action("paint", goal=Paint, feedback=int, result=Painted)
VARNISH = Action("varnish", goal=Paint, feedback=int, result=Painted, checkpoint=dict[str, int])
"""An action whose goals are remembered as well."""
GOALS = 230
"""Goals of the action `paint`, more than a page of the history has."""


async def paint(goal: GoalHandle[Paint]) -> AsyncGenerator[Any, None]:
    """Paint; each tenth goal fails."""
    request = goal.request
    yield 1
    if request.order % 10 == 0:
        raise GoalAborted("the can is empty")
    yield Painted(request.order / 4, request.color)


async def fill(painting: ActionServer[Any, Any, Any]) -> None:
    """Run the goals of the past, and wait until the server has forgotten them."""
    client = ActionClient(painting, PAINT)
    for order in range(1, GOALS + 1):
        labels = {"order": str(order), "wall": "north" if order % 2 else "south"}
        color = "blue" if order == GOALS - 1 else "red"
        with suppress(GoalAborted):
            await client.call(Paint(order, color, [Spot(order, 2.0)]), labels=labels)
    while await client.goals():  # noqa: ASYNC110  # nothing tells that goals are forgotten
        await anyio.sleep(0.01)


async def main(url: str, file: str) -> None:
    """Fill the history, and serve until the process is ended."""
    store = SqliteStore(file, history=GoalHistory(), sync="normal")
    painting = ActionServer(PAINT, paint, store=store, result_timeout=0.001)
    varnishing = ActionServer(VARNISH, paint, store=store, result_timeout=600)
    async with serve([painting, varnishing], url) as (where,):
        await fill(painting)
        print(where, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, sys.argv[1], sys.argv[2])
