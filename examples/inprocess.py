"""One action, from its definition to a result and to a cancel, all in one process."""
# ruff: noqa: D101, D103 - the names here need no explanation

from collections.abc import AsyncGenerator

import anyio
from msgspec import Struct

from fibaction import Action, ActionServer, GoalHandle, connect, serve


class Goal(Struct):
    metres: int


class Feedback(Struct):
    walked: int


class Result(Struct):
    total: int


WALK = Action("walk", goal=Goal, feedback=Feedback, result=Result)


async def walk(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    for metre in range(1, goal.request.metres + 1):
        await anyio.sleep(0.2)  # a cancel is raised here
        yield Feedback(walked=metre)
    yield Result(total=goal.request.metres)


async def main() -> None:
    server = ActionServer(WALK, walk)
    async with serve(server, "inproc://demo"), connect("inproc://demo", WALK) as client:
        print(await client.call(Goal(metres=3), on_feedback=print))
        async with client.send_goal(Goal(metres=10)) as goal:
            async for feedback in goal.feedback:
                if feedback.walked == 2:
                    await goal.cancel()
            print((await goal.outcome()).status)


anyio.run(main)
