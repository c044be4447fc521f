"""The parts of the product that are there for speed alone, each beside the product without it.

    python -m tests.tools.benchmarks.parts [--rounds N]

Both sides of a ratio run in turns in one process, and it is the processor's time that counts, so
that other programs disturb little. The ratios are in the docstrings of the parts.
"""

from __future__ import annotations

import argparse
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator, Hashable
from contextlib import contextmanager
from functools import partial
from statistics import median
from time import process_time
from typing import Any
from unittest.mock import patch

import anyio
from anyio.abc import TaskGroup

from fibaction import Action, ActionClient, ActionServer, GoalHandle, connect, serve
from fibaction.border.abc import ForwardingEndpoint
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.execution.interruption import CancelOnce
from fibaction.server.execution.task_pool import Job, TaskPool

COUNT = Action("count", goal=int, feedback=int, result=str)
GOALS = 2000
FEEDBACK = 20_000

Side = Callable[[], Awaitable[None]]


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    """Yield as much feedback as the goal says."""
    for number in range(goal.request):
        yield number
    yield "done"


async def call_all(client: ActionClient[int, int, str], goals: int, feedback: int) -> None:
    for _ in range(goals):
        await client.call(feedback)


# A task for each goal, in place of those of the pool


def _add_with_a_task(self: TaskPool, job: Job, key: Hashable = None) -> None:
    async def run(scopes: CancelOnce) -> None:
        with scopes.rest:
            await job(scopes)

    scopes = CancelOnce(lambda: None)
    tasks: TaskGroup = self._tasks
    scopes.run_by(tasks.start_soon(run, scopes, name=self._name))


@contextmanager
def without_pool() -> Generator[None, None, None]:
    with patch.object(TaskPool, "add", _add_with_a_task):
        yield


async def short_goals(*, pooled: bool) -> None:
    async with ActionServer(COUNT, count) as server:
        client = ActionClient(server, COUNT)
        await client.call(0)  # the pool's group is open then
        if pooled:
            await call_all(client, GOALS, 0)
        else:
            with without_pool():
                await call_all(client, GOALS, 0)


# A coroutine for each goal that is sent over TCP: what wraps an endpoint offers nothing at once


async def goals_over_tcp(*, offered: bool) -> None:
    server = ActionServer(COUNT, count)
    endpoint = server if offered else ForwardingEndpoint(server)
    async with serve(endpoint, "tcp://127.0.0.1:0") as (url,), connect(url, COUNT) as client:
        await call_all(client, GOALS, 0)


# The limit of a log computed at each feedback, in place of at each read


def _append_and_compute(self: FeedbackLog[Any], payload: bytes, real: Any) -> None:
    real(self, payload)
    self.make_room()


async def feedback_in_process(*, cached: bool) -> None:
    real = FeedbackLog.append
    wrong = lambda self, payload: _append_and_compute(self, payload, real)  # noqa: E731
    async with ActionServer(COUNT, count) as server:
        client = ActionClient(server, COUNT)

        async def follow() -> None:
            await client.call(FEEDBACK, on_feedback=lambda _: None)

        if cached:
            await follow()
        else:
            with patch.object(FeedbackLog, "append", wrong):
                await follow()


PARTS: dict[str, tuple[Side, Side]] = {
    "short goals, with the task pool": (
        partial(short_goals, pooled=True),
        partial(short_goals, pooled=False),
    ),
    "short goals over TCP, offered": (
        partial(goals_over_tcp, offered=True),
        partial(goals_over_tcp, offered=False),
    ),
    "feedback, with a cached limit": (
        partial(feedback_in_process, cached=True),
        partial(feedback_in_process, cached=False),
    ),
}
"""Each part: the product with it, and without it."""


def seconds_of(side: Side) -> float:
    """Return the processor's time that one run takes."""

    async def run() -> float:
        began = process_time()
        await side()
        return process_time() - began

    ran: Coroutine[Any, Any, float] = run()
    return anyio.run(lambda: ran)


def main() -> None:
    """Print how many times as fast each part makes what it is for."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.benchmarks.parts")
    parser.add_argument("--rounds", type=int, default=9)
    rounds = parser.parse_args().rounds
    for name, (with_it, without_it) in PARTS.items():
        ratios = sorted(
            (without := seconds_of(without_it)) and without / seconds_of(with_it)
            for _ in range(rounds)
        )
        print(f"{name}: {median(ratios):.2f} times as fast ({ratios[0]:.2f} to {ratios[-1]:.2f})")


if __name__ == "__main__":
    main()
