"""A process of its own, to be killed: `serve URL`, or `send URL ORDER`.

The server yields one feedback, and gives a result for order 0 only. The client sends a goal, and
says so when the first feedback has come.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator

import anyio

from fibaction import ActionServer, GoalHandle, connect, serve
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result


async def slowly(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    yield Feedback([0])
    if goal.request.order:
        await anyio.sleep_forever()
    yield Result([0])


async def serving(where: str) -> None:
    async with serve(ActionServer(FIBONACCI, slowly), where) as (url,):
        print(url, flush=True)
        await anyio.sleep_forever()


async def sending(where: str, order: str) -> None:
    async with connect(where, FIBONACCI) as client:
        goal = await client.send_goal(Goal(int(order)))
        async for _ in goal.feedback:
            print(goal.goal_id, flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        anyio.run(serving, sys.argv[2])
    else:
        anyio.run(sending, sys.argv[2], sys.argv[3])
