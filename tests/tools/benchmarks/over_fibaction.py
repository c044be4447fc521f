"""fibaction over each of its transports that is served in the same way, as users write it."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, NamedTuple

from anyio import create_task_group

import fibaction
from fibaction import ActionClient, ActionServer, ClientGoal
from fibaction.wire.settings import Limits
from tests.support.certificates import HOST, pems
from tests.tools.benchmarks.contender import (
    AT_ONCE,
    PACED,
    PENDING,
    Contender,
    GoalTimes,
    seconds_since,
)
from tests.tools.benchmarks.inprocess import ACTION, Goal, count

KEPT: dict[str, Any] = {"result_timeout": math.inf, "max_results": 1_000_000}
"""The settings of a server that keeps all results for ever."""
LIMITS = Limits(goals=20_000)
"""The limits for one client with more than 10,000 pending goals."""


@asynccontextmanager
async def serve(where: str = "tcp://127.0.0.1:0", **settings: Any) -> AsyncGenerator[str, None]:
    """Serve; `settings` are the server's."""
    server = ActionServer(ACTION, count, stall_timeout=math.inf, **settings)
    async with fibaction.serve(server, where, limits=LIMITS) as (url,):
        yield url


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with fibaction.connect(address, ACTION) as client:
        yield OverFibaction(client, Goal, lambda feedback: feedback.numbers)


@asynccontextmanager
async def serve_tls() -> AsyncGenerator[str, None]:
    """Serve with a certificate, which the client checks."""
    files = pems()
    async with serve(f"tls://{HOST}:0?cert={files.cert}") as url:
        yield f"{url}?ca={files.ca}"


@asynccontextmanager
async def serve_unix() -> AsyncGenerator[str, None]:
    with TemporaryDirectory() as folder:
        async with serve(f"unix://{Path(folder, 'socket')}") as url:
            yield url


@asynccontextmanager
async def connect_inproc(address: str, **settings: Any) -> AsyncGenerator[Contender, None]:
    """Serve in the client's process; `settings` are the server's."""
    async with serve("inproc://benchmark", **settings) as url, connect(url) as contender:
        yield contender


class Ends(NamedTuple):
    """The two ends of a way; the address of a server in the client's process is not needed."""

    serve: Callable[[], AbstractAsyncContextManager[str]]
    connect: Callable[[str], AbstractAsyncContextManager[Contender]]


ENDS = {
    "ws": Ends(partial(serve, "ws://127.0.0.1:0"), connect),
    "tls": Ends(serve_tls, connect),
    "unix": Ends(serve_unix, connect),
    "tcp_kept": Ends(partial(serve, **KEPT), connect),
    "inproc": Ends(serve, connect_inproc),
    "inproc_kept": Ends(serve, partial(connect_inproc, **KEPT)),
}
"""The ways of this module, by their names."""


class OverFibaction(Contender):
    def __init__(
        self,
        client: ActionClient[Any, Any, Any],
        goal: Callable[[int], Any],
        numbers_of: Callable[[Any], list[int]],
    ) -> None:
        self._client = client
        self._goal = goal
        self._numbers_of = numbers_of
        self._pending: list[ClientGoal[Any, Any]] = []

    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._client.call(self._goal(0))

    async def batches(self, times: int) -> int:
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self._client.call, self._goal(0))
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        seen = 0
        async with self._client.send_goal(self._goal(times)) as goal:
            async for _ in goal.feedback:
                seen += 1
            await goal.result()
        return seen

    async def goal_times(self, times: int) -> list[GoalTimes]:
        taken: list[GoalTimes] = []
        for _ in range(times):
            start = perf_counter()
            goal = await self._client.send_goal(self._goal(0))
            accepted = perf_counter() - start
            await goal.result()
            taken.append(GoalTimes(accepted, perf_counter() - start))
        return taken

    async def feedback_times(self, times: int) -> list[float]:
        taken: list[float] = []
        async with self._client.send_goal(self._goal(PACED + times)) as goal:
            taken += [seconds_since(self._numbers_of(one)) async for one in goal.feedback]
            await goal.result()
        return taken

    async def hold(self, times: int) -> None:
        for _ in range(times):
            self._pending.append(await self._client.send_goal(self._goal(PENDING)))
