"""REST and server-sent events of `http://`, by a client over h11, which knows nothing of fibaction.

Goals at once share `CONNECTIONS` connections, since each has one request at a time.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from time import perf_counter

import msgspec
from anyio import create_task_group

from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.contender import AT_ONCE, Contender, GoalTimes
from tests.tools.benchmarks.inprocess import Feedback
from tests.transports.web.http_client import HttpClient, client_of

GOALS = "/actions/count/goals"
CONNECTIONS = 20
EVENTS = "text/event-stream"

decoded = msgspec.json.Decoder(Feedback).decode


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_fibaction.serve("http://127.0.0.1:0") as url:
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    yield OverHttp(address)


async def run_goal(client: HttpClient) -> None:
    status, _ = await client.ask("POST", f"{GOALS}?wait=30", {"count": 0})
    assert status == 201, status
    await client.rest()


class OverHttp(Contender):
    """Each piece of work opens its connections: between two, the server ends idle ones."""

    def __init__(self, address: str) -> None:
        self._address = address

    async def goal(self) -> None:
        await self.goals(1)

    async def goals(self, times: int) -> None:
        async with client_of(self._address) as client:
            for _ in range(times):
                await run_goal(client)

    async def batches(self, times: int) -> int:
        each = times * AT_ONCE // CONNECTIONS
        async with create_task_group() as tasks:
            for _ in range(CONNECTIONS):
                tasks.start_soon(self.goals, each)
        return each * CONNECTIONS

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        async with client_of(self._address) as client:
            for _ in range(times):
                start = perf_counter()
                await run_goal(client)
                taken.append(GoalTimes(None, perf_counter() - start))
        return taken

    async def numbers_of(self, goal: int) -> AsyncGenerator[list[int], None]:
        """Send a goal with a stream of its events."""
        async with client_of(self._address) as client:
            status, _ = await client.ask("POST", GOALS, {"count": goal}, accept=EVENTS)
            assert status == 201, status
            left = b""
            while piece := await client.piece():
                *events, left = (left + piece).split(b"\n\n")
                for event in events:
                    if event.find(b"event: feedback") >= 0:
                        yield decoded(event.partition(b"\ndata: ")[2]).numbers
