"""A process of its own, to be killed: `peer.py serve URL`, or `peer.py send URL ORDER`.

The server yields one feedback, and gives a result for order 0 only. The client sends a goal, and
says so when the first feedback has come.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, connect, serve


class Goal(msgspec.Struct):
    order: int


class Feedback(msgspec.Struct):
    partial_sequence: list[int]


class Result(msgspec.Struct):
    sequence: list[int]


FIBONACCI = Action("fibonacci", goal=Goal, feedback=Feedback, result=Result)


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
