"""A robot with many goals: `python -m tests.browser.crowd URL FILE PAST ACTIVE` serves it.

It says that it serves once PAST goals are in its history and ACTIVE goals run, each with ten
feedback messages a second.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import msgspec

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalHistory,
    SqliteStore,
    serve,
)


class Pick(msgspec.Struct):
    """The number of things to pick, and where."""

    things: int
    shelf: str = "A1"


class Picking(msgspec.Struct):
    """How far it is."""

    progress: float


PICK = Action("pick", goal=Pick, feedback=Picking, result=int)
PAUSE = 0.1
"""Seconds between two feedback messages of an active goal."""
AT_ONCE = 200
"""Goals of the past that run at the same time."""


async def pick(goal: GoalHandle[Pick]) -> AsyncGenerator[Any, None]:
    """Pick things at a slow pace."""
    things = goal.request.things
    for place in range(things):
        await anyio.sleep(PAUSE)
        yield Picking(place / things)
    yield things


async def fill(client: ActionClient[Pick, Picking, int], past: int, active: int) -> None:
    """Run the goals of the past, and send those that stay active."""
    for begin in range(0, past, AT_ONCE):
        async with anyio.create_task_group() as group:
            for _ in range(begin, min(begin + AT_ONCE, past)):
                group.start_soon(client.call, Pick(0))
    for place in range(active):
        await client.send_goal(Pick(10_000 + place), labels={"shelf": str(place % 7)})


async def main(url: str, file: str, past: int, active: int) -> None:
    """Fill the server, and serve until the process is ended."""
    store = SqliteStore(file, history=GoalHistory(), sync="normal")
    picking = ActionServer(PICK, pick, store=store, result_timeout=1, max_goals=active + AT_ONCE)
    async with serve([picking], url) as (where,):
        await fill(ActionClient(picking, PICK), past, active)
        print(where, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
