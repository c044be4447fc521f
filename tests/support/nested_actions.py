"""Actions that are hard to describe: with tags, types in themselves, and classes of one name.

    python -m tests.support.nested_actions URL

serves them; with an action that needs no goal, and takes times, a set and a decimal.
"""

from __future__ import annotations

import datetime
import sys
from collections.abc import AsyncGenerator
from decimal import Decimal
from typing import Annotated, Any, Literal

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, action, serve


class Point(msgspec.Struct):
    x: Annotated[float, msgspec.Meta(ge=-100, le=100)]
    y: float = 0.0


class ToPoint(msgspec.Struct, tag="point"):
    point: Point


class ToShelf(msgspec.Struct, tag="shelf"):
    number: int
    side: Literal["left", "right"] = "left"


class Part(msgspec.Struct):
    name: str
    parts: list[Part] = []


class Goal(msgspec.Struct):
    target: ToPoint | ToShelf
    fallback: ToPoint | ToShelf | None = None
    parts: list[Part] = []
    label: bytes = b""
    at: Annotated[datetime.datetime, msgspec.Meta(tz=True)] | None = None


class Feedback(msgspec.Struct):
    done: int


class Result(msgspec.Struct):
    total: int


OtherGoal = msgspec.defstruct("Goal", [("order", Annotated[int, msgspec.Meta(ge=0, le=50)])])
FETCH = Action("fetch", goal=Goal, feedback=Feedback, result=Result)
COUNT: Action[Any, Feedback, Result] = Action(
    "left/count", goal=OtherGoal, feedback=Feedback, result=Result
)


async def fetch(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    """End at once."""
    yield Feedback(1)
    yield Result(len(goal.request.parts))


async def count(goal: GoalHandle[Any]) -> AsyncGenerator[Feedback | Result, None]:
    """Count with pauses, and without an end if the order is 50."""
    for number in range(goal.request.order):
        yield Feedback(number)
        await anyio.sleep(0.01)
    if goal.request.order == 50:
        await anyio.sleep_forever()
    yield Result(goal.request.order)


class Booking(msgspec.Struct):
    at: datetime.datetime = datetime.datetime(2026, 1, 31)
    lasts: datetime.timedelta = datetime.timedelta(hours=1)
    opens: datetime.time | None = None
    seats: set[int] = set()
    price: Decimal | None = None


@action
async def book(booking: Booking) -> Booking:
    """Return what was booked."""
    return booking


async def main(url: str) -> None:
    """Serve the actions until the process is ended."""
    servers = [ActionServer(FETCH, fetch), ActionServer(COUNT, count), book]
    async with serve(servers, url) as (served,):
        print(served, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, sys.argv[1])
