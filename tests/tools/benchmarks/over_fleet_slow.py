"""fibaction over `nats://` with goals that take a while, and workers that run few at once.

All that wait are in one queue of the fleet.
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio

import fibaction
from fibaction import ActionServer, GoalHandle, Schedule
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result
from tests.tools.benchmarks.over_fibaction import connect as connect
from tests.tools.benchmarks.over_fleet import FLEET, MANY

CONCURRENCY = 5
SECONDS = 0.1
"""Seconds of a goal, so a worker does at most 50 of them in a second."""


async def work(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    await anyio.sleep(SECONDS)
    yield Result(goal.request.count)


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    server = ActionServer(
        ACTION, work, schedule=Schedule(concurrency=CONCURRENCY, queue=1000), **MANY
    )
    async with fibaction.serve(server, os.environ[FLEET]):
        yield os.environ[FLEET]
