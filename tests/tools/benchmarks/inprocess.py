"""The cost of a goal and its feedback in one process, beside the least that anyio needs."""

from __future__ import annotations

import gc
import math
from collections.abc import AsyncGenerator, Callable
from statistics import median
from time import perf_counter
from typing import Any

import anyio
import msgspec

from fibaction import Action, ActionClient, ActionServer, GoalHandle, connect, serve
from tests.tools.benchmarks.contender import PACED, PAUSE, PENDING, stamped
from tests.tools.benchmarks.timing import ROUNDS, beside, seconds_each


class Goal(msgspec.Struct):
    count: int


class Feedback(msgspec.Struct):
    numbers: list[int]


class Result(msgspec.Struct):
    count: int


ACTION = Action("count", goal=Goal, feedback=Feedback, result=Result)
Client = ActionClient[Goal, Feedback, Result]


def executor(
    wanted_of: Callable[[Any], int],
    feedback: Callable[[list[int]], Any],
    result: Callable[[int], Any],
) -> Callable[[GoalHandle[Any]], AsyncGenerator[Any, None]]:
    """Return an executor for given message types that does what the number of a goal says: see
    `contender`.
    """

    async def execute(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        wanted = wanted_of(goal.request)
        if wanted >= PACED:
            for _ in range(wanted - PACED):
                await anyio.sleep(PAUSE)
                yield feedback(stamped())
        else:
            same = feedback([1, 2, 3])
            for _ in range(wanted):
                yield same
        if wanted == PENDING:
            await anyio.sleep_forever()
        yield result(wanted)

    return execute


count = executor(lambda goal: goal.count, Feedback, Result)


async def measure(scale: float) -> dict[str, Any]:
    server = ActionServer(ACTION, count, stall_timeout=math.inf)
    async with serve(server, "inproc://benchmark"), connect("inproc://benchmark", ACTION) as client:
        report: dict[str, Any] = {
            "goals, beside a task group with one task each": await goals(client, scale),
            "feedback, beside a memory object stream": await feedback(client, scale),
            "one more goal, with 10 and with 10,000 active": await growth(client, scale),
        }
    report["memory after many goals"] = await memory(scale)
    return report


async def goals(client: Client, scale: float) -> dict[str, float]:
    async def call(times: int) -> None:
        for _ in range(times):
            await client.call(Goal(0))

    async def nothing() -> None:
        pass

    async def task_group(times: int) -> None:
        for _ in range(times):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(nothing)

    return await beside(call, task_group, int(3000 * scale))


async def feedback(client: Client, scale: float) -> dict[str, float]:
    async def stream_feedback(times: int) -> None:
        seen = 0
        async with client.send_goal(Goal(times)) as goal:
            async for _ in goal.feedback:
                seen += 1
            await goal.result()
        assert seen == times, "feedback was lost"

    async def memory_stream(times: int) -> None:
        send, receive = anyio.create_memory_object_stream[Feedback](64)  # the feedback window

        async def produce() -> None:
            message = Feedback([1, 2, 3])
            async with send:
                for _ in range(times):
                    await send.send(message)

        async with anyio.create_task_group() as tasks, receive:
            tasks.start_soon(produce)
            async for _ in receive:
                pass

    return await beside(stream_feedback, memory_stream, int(30_000 * scale))


async def growth(client: Client, scale: float) -> dict[str, float]:
    async def call(times: int) -> None:
        for _ in range(times):
            await client.call(Goal(0))

    async def with_active(number: int, times: int) -> float:
        active = [await client.send_goal(Goal(PENDING)) for _ in range(number)]
        await anyio.wait_all_tasks_blocked()  # so that their start is not measured
        seconds = await seconds_each(call, times)
        await client.cancel_goals()
        for goal in active:
            await goal.outcome()
        return seconds

    times = int(2000 * scale)
    pairs = [
        (await with_active(10, times), await with_active(10_000, times)) for _ in range(ROUNDS)
    ]
    return {
        "per_second_with_10": round(1 / median(pair[0] for pair in pairs)),
        "per_second_with_10_000": round(1 / median(pair[1] for pair in pairs)),
        "cost_ratio": round(median(pair[1] / pair[0] for pair in pairs), 3),
    }


async def memory(scale: float) -> dict[str, float]:
    """Count the Python objects alive after the first goals, and after a hundred times as many."""
    few, many = int(1000 * scale), int(100_000 * scale)
    async with ActionServer(ACTION, count, max_results=100) as server:
        client = ActionClient(server, ACTION)

        async def objects_after(times: int) -> int:
            for _ in range(times):
                await client.call(Goal(0))
            gc.collect()
            return len(gc.get_objects())

        before = await objects_after(few)
        start = perf_counter()
        after = await objects_after(many)
        seconds = perf_counter() - start
    return {
        "goals": many,
        "seconds": round(seconds, 1),
        f"objects_after_{few}": before,
        "objects_more_at_the_end": after - before,
    }
