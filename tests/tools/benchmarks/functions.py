"""Goals and feedback of a function beside those of a generator, in one process and over TCP.

    python -m tests.tools.benchmarks.functions [--rounds N] [--write]

Both do the same, at two actions of one process, which has both ends. The time is the processor's.
They are measured in turns, and each round has one ratio, so a machine that is busy for a while
changes both. `--write` puts the table into docs/comparisons.md.
"""

from __future__ import annotations

import gc
import math
from collections.abc import AsyncGenerator, Awaitable, Callable
from statistics import median
from time import process_time

import anyio

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Report, action, connect, serve
from fibaction.types.action import GoalT
from tests.support.page_parts import markdown_table
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result
from tests.tools.benchmarks.pages import run

ADDRESSES = {"in one process": "inproc://functions", "tcp": "tcp://127.0.0.1:0"}
GOALS, AT_ONCE, MESSAGES = 300, 500, 5000
WARM_UP = 2
"""First rounds, which are not counted."""


async def by_generator(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    feedback = Feedback([1, 2, 3])
    for _ in range(goal.request.count):
        yield feedback
    yield Result(goal.request.count)


@action("by_function")
async def by_function(report: Report[Feedback], count: int) -> Result:
    feedback = Feedback([1, 2, 3])
    for _ in range(count):
        await report(feedback)
    return Result(count)


async def goals(
    client: ActionClient[GoalT, Feedback, Result], goal: Callable[[int], GoalT]
) -> None:
    for _ in range(GOALS):
        await client.call(goal(0))


async def at_once(
    client: ActionClient[GoalT, Feedback, Result], goal: Callable[[int], GoalT]
) -> None:
    async with anyio.create_task_group() as tasks:
        for _ in range(AT_ONCE):
            tasks.start_soon(client.call, goal(0))


async def feedback(
    client: ActionClient[GoalT, Feedback, Result], goal: Callable[[int], GoalT]
) -> None:
    async with client.send_goal(goal(MESSAGES)) as sent:
        async for _ in sent.feedback:
            pass


KINDS = {"goals, one after another": goals, "goals, 500 at once": at_once, "feedback": feedback}
NAMED: Action[Goal, Feedback, Result] = Action(
    "by_generator", goal=ACTION.goal.type, feedback=Feedback, result=Result
)


async def seconds_of(work: Awaitable[None]) -> float:
    gc.collect()
    start = process_time()
    await work
    return process_time() - start


async def ratios(where: str, rounds: int) -> dict[str, list[float]]:
    """Return the rates of the function as parts of the generator's, one of each round."""
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}
    servers = [
        ActionServer(NAMED, by_generator, stall_timeout=math.inf),
        ActionServer(by_function, stall_timeout=math.inf),
    ]
    async with serve(servers, where) as (url,), connect(url) as connection:
        generator, function = connection.client(NAMED), connection.client(by_function)
        for number in range(rounds + WARM_UP):
            for kind, work in KINDS.items():
                taken: dict[bool, float] = {}
                for is_function in (number % 2 == 0, number % 2 == 1):
                    taken[is_function] = await seconds_of(
                        work(function, by_function.goal_of)
                        if is_function
                        else work(generator, Goal)
                    )
                if number >= WARM_UP:
                    found[kind].append(taken[False] / taken[True])
    return found


async def measure(rounds: int) -> str:
    """Return the table for the page."""
    rows: list[list[str]] = []
    for name, where in ADDRESSES.items():
        for kind, of_rounds in (await ratios(where, rounds)).items():
            between = f"{min(of_rounds):.2f} and {max(of_rounds):.2f}"
            rows.append([f"{name}, {kind}", f"{median(of_rounds):.2f}", between])
    return markdown_table(
        ["A function, as a part of a generator", "Median", "Rounds between"], rows
    )


def main() -> None:
    """Print the table, or write it."""
    run("functions", measure, rounds=30)


if __name__ == "__main__":
    main()
