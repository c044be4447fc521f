"""The bound for a server's memory, which docs/howto/secure.md states, is one.

Each number of the formula is measured on a real server over TCP, by what Python has allocated.
"""

from __future__ import annotations

import gc
import os
import sys
import tracemalloc
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest
from anyio.abc import SocketStream

from fibaction import Action, ActionServer, GoalHandle, Limits, Schedule, serve
from fibaction.border.abc import Notifier
from fibaction.wire.codec import encode
from fibaction.wire.frames import UNCOUNTED, framed, header
from fibaction.wire.messages import (
    VERSION,
    CancelGoals,
    Follow,
    FromClient,
    Hello,
    SendGoal,
    WatchStatus,
)
from fibaction.wire.settings import DEFAULT_LIMITS

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))

import secure_parts as page  # noqa: E402  # a part of docs/, which is no package

WORK = Action("work", goal=bytes, feedback=int, result=str)
NAME = WORK.name
WAITING = 3200
"""Bytes of a goal that waits for its start, as docs/howto/schedule.md says: a part of the 12 KiB
that secure.md counts for each active goal, and of the 2 KiB of its connection."""
ENDLESS, SHORT = msgspec.msgpack.encode(b"endless"), msgspec.msgpack.encode(b"")
pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(autouse=True)
def _measured() -> Generator[None, None, None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


async def work(goal: GoalHandle[bytes]) -> AsyncGenerator[int | str, None]:
    if goal.request:
        await anyio.sleep_forever()
    yield "done"


async def never(*_: object) -> None:
    await anyio.sleep_forever()


class Raw:
    """A client that sends messages, and reads nothing."""

    def __init__(self, stream: SocketStream) -> None:
        self._stream = stream

    async def send(self, *messages: FromClient) -> None:
        await self._stream.send(framed(map(encode, messages)))

    async def send_bytes(self, data: bytes) -> None:
        await self._stream.send(data)


@asynccontextmanager
async def serving(
    limits: Limits = DEFAULT_LIMITS, authorize: Any = None, **settings: Any
) -> AsyncGenerator[Callable[[], Awaitable[Raw]], None]:
    """Serve, and yield a function that connects a client."""
    server = ActionServer(WORK, work, shutdown_timeout=0, **settings)
    streams: list[SocketStream] = []
    async with serve(server, "tcp://127.0.0.1:0", limits=limits, authorize=authorize) as (url,):
        port = int(url.rpartition(":")[2])

        async def connected() -> Raw:
            streams.append(await anyio.connect_tcp("127.0.0.1", port))
            client = Raw(streams[-1])
            await client.send(Hello(VERSION, 3600.0, "", os.urandom(16)))
            return client

        try:
            yield connected
        finally:
            for stream in streams:
                await anyio.aclose_forcefully(stream)


async def settled() -> int:
    """Wait until the server has nothing to do, and return the bytes that are allocated."""
    await anyio.wait_all_tasks_blocked()
    await anyio.sleep(0.1)  # the kernel passes bytes on meanwhile
    await anyio.wait_all_tasks_blocked()
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def sends(count: int, goal: bytes, *, first: int = 10) -> list[FromClient]:
    return [SendGoal(first + n, NAME, os.urandom(16), goal, 0) for n in range(count)]


async def test_a_connection_takes_less_than_the_page_says() -> None:
    async with serving() as connected:
        await connected()
        before = await settled()
        for _ in range(50):
            client = await connected()
            await client.send_bytes(header(2**20) + bytes(UNCOUNTED))
        each = (await settled() - before) / 50

    assert UNCOUNTED < each < page.CONNECTION


@pytest.mark.parametrize("on_goal", [None, never], ids=["runs", "undecided"])
async def test_a_goal_takes_less_than_the_page_says(on_goal: Any) -> None:
    async with serving(on_goal=on_goal) as connected:
        client = await connected()
        before = await settled()
        await client.send(*sends(500, ENDLESS))
        each = (await settled() - before) / 500

    assert page.GOAL < each < page.GOAL + page.ACTIVE


async def test_a_goal_that_waits_for_a_place_takes_less_than_the_page_says() -> None:
    count, news = 0, Notifier()

    def note(_: bytes) -> None:
        nonlocal count
        count += 1
        news.notify()

    async def taken(number: int) -> int:
        while count < number:
            await news.wait()
        return await settled()

    schedule = Schedule(concurrency=1, queue=10_000)
    async with serving(schedule=schedule, on_goal=note) as connected:
        client = await connected()
        # The first goals bring what all share; many are looked at, since tables grow by doubling.
        await client.send(*sends(500, ENDLESS))
        before = await taken(500)
        await client.send(*sends(1500, ENDLESS, first=510))
        each = (await taken(2000) - before) / 1500

    assert 1000 < each < WAITING


async def test_a_goal_that_waits_for_a_permission_takes_less_than_the_page_says() -> None:
    async with serving(authorize=never) as connected:
        client = await connected()
        before = await settled()
        await client.send(*sends(500, ENDLESS))
        each = (await settled() - before) / 500

    assert page.GOAL < each < page.GOAL + page.AUTHORIZING


async def test_following_takes_less_than_the_page_says() -> None:
    goal_id = os.urandom(16)
    async with serving() as connected:
        client = await connected()
        await client.send(SendGoal(1, NAME, goal_id, ENDLESS, 0))
        before = await settled()
        await client.send(*(Follow(10 + n, NAME, goal_id, 0, False, 0) for n in range(99)))
        each = (await settled() - before) / 99

    assert 200 < each < page.GOAL


async def test_a_request_that_waits_takes_less_than_the_page_says() -> None:
    async with serving(on_cancel=never) as connected:
        client = await connected()
        await client.send(*sends(10, ENDLESS))
        before = await settled()
        await client.send(
            WatchStatus(9000, NAME, 0),
            *(CancelGoals(9001 + n, NAME, None, None) for n in range(500)),
        )
        each = (await settled() - before) / 501

    assert 500 < each < page.REQUEST


async def test_an_answer_that_lists_all_goals_takes_less_than_the_page_says() -> None:
    async with serving(interrupt_on_cancel=False) as connected:
        client, other = await connected(), await connected()
        await client.send(*sends(1000, ENDLESS))
        await other.send(CancelGoals(1, NAME, None, None))
        before = await settled()
        tracemalloc.reset_peak()
        await other.send(CancelGoals(2, NAME, None, None))
        await settled()
        each = (tracemalloc.get_traced_memory()[1] - before) / 1000

    assert 100 < each < page.LISTED


async def test_a_result_takes_less_than_the_page_says() -> None:
    async with serving(max_results=500) as connected:
        client = await connected()
        before = await settled()
        await client.send(*sends(500, SHORT))
        each = (await settled() - before) / 500

    assert 100 < each < page.RESULT + page.GOAL


async def test_all_that_clients_do_at_once_takes_less_than_the_bound() -> None:
    bound = page.TIGHT
    limits = bound.limits
    settings = {name: getattr(bound, name) for name in page.OF_THE_SERVER if hasattr(bound, name)}
    async with serving(limits, on_cancel=never, **settings) as connected:
        before = await settled()
        tracemalloc.reset_peak()
        for _ in range(limits.connections):
            client = await connected()
            goal = msgspec.msgpack.encode(bytes(40_000))
            await client.send(*sends(limits.goals, goal))
            await client.send(
                *(CancelGoals(9001 + n, NAME, None, None) for n in range(limits.requests))
            )
            await client.send_bytes(header(limits.frame) + bytes(limits.frame - 1))
        await settled()
        peak = tracemalloc.get_traced_memory()[1] - before

    assert bound.whole / 20 < peak < bound.whole
