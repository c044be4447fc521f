"""The cost of goals of an executor that is a function, beside one that is an async generator.

The seconds are those of the processor, since both ends are in this process.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack
from functools import partial
from time import process_time
from typing import Any

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Report, action, connect, serve
from tests.tools.benchmarks.timing import beside

WHERE = ("inproc://functions", "tcp://127.0.0.1:0")
BY_GENERATOR = Action("by_generator", goal=int, feedback=int, result=str)
Client = ActionClient[int, int, str]


async def generator(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(goal.request):
        yield number
    yield "done"


@action("by_function")
async def function(count: int, report: Report[int]) -> str:
    for number in range(count):
        await report(number)
    return "done"


async def measure(scale: float) -> dict[str, Any]:
    """Compare both in turns, by clients of one server each, in this process."""
    return {where.partition(":")[0]: await compare(where, scale) for where in WHERE}


async def compare(where: str, scale: float) -> dict[str, Any]:
    servers = [
        ActionServer(BY_GENERATOR, generator, stall_timeout=math.inf),
        ActionServer(function, stall_timeout=math.inf),
    ]
    async with AsyncExitStack() as stack:
        (url,) = await stack.enter_async_context(serve(servers, where))
        of_function = await stack.enter_async_context(connect(url, function))
        of_generator = await stack.enter_async_context(connect(url, BY_GENERATOR))
        return {
            "goals, beside those of a generator": await beside(
                partial(goals, of_function),
                partial(goals, of_generator),
                int(2000 * scale),
                process_time,
            ),
            "feedback, beside that of a generator": await beside(
                partial(feedback, of_function),
                partial(feedback, of_generator),
                int(20_000 * scale),
                process_time,
            ),
        }


async def goals(client: Client, times: int) -> None:
    for _ in range(times):
        await client.call(0)


async def feedback(client: Client, times: int) -> None:
    seen = 0
    async with client.send_goal(times) as goal:
        async for _ in goal.feedback:
            seen += 1
        await goal.result()
    assert seen == times, "feedback was lost"
