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
from fibaction.wire.frames import UNCOUNTED, framed, header
from fibaction.wire.messages import (
    VERSION,
    CancelGoals,
    Follow,
    FromClient,
    Hello,
    SendGoal,
    WatchStatus,
    encode,
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


def cancels(count: int) -> list[FromClient]:
    return [CancelGoals(9001 + n, NAME, None, None) for n in range(count)]


async def test_a_connection_takes_less_than_the_page_says() -> None:
    async with serving() as connected:
        await connected()
        before = await settled()
        for _ in range(50):
            client = await connected()
            await client.send_bytes(header(2**20) + bytes(UNCOUNTED))
        each = (await settled() - before) / 50

    assert UNCOUNTED < each < page.CONNECTION


FOLLOWED = os.urandom(16)
MESSAGES: dict[str, tuple[dict[str, Any], list[FromClient], list[FromClient], int, int]] = {
    "a goal that runs": ({}, [], sends(500, ENDLESS), page.GOAL, page.GOAL + page.ACTIVE),
    "a goal that is decided on": (
        *({"on_goal": never}, [], sends(500, ENDLESS)),
        *(page.GOAL, page.GOAL + page.ACTIVE),
    ),
    "a goal that waits for a permission": (
        *({"authorize": never}, [], sends(500, ENDLESS)),
        *(page.GOAL, page.GOAL + page.AUTHORIZING),
    ),
    "following": (
        {},
        [SendGoal(1, NAME, FOLLOWED, ENDLESS, 0)],
        [Follow(10 + n, NAME, FOLLOWED, 0, False, 0) for n in range(99)],
        *(200, page.GOAL),
    ),
    "a request that waits": (
        {"on_cancel": never},
        sends(10, ENDLESS),
        [
            WatchStatus(9000, NAME, 0),
            *(CancelGoals(9001 + n, NAME, None, None) for n in range(500)),
        ],
        *(500, page.REQUEST),
    ),
    "a result": ({"max_results": 500}, [], sends(500, SHORT), 100, page.RESULT + page.GOAL),
}
"""For each thing that the page names: the settings of the server, what is sent before, what is
measured, and the limits of the bytes of each message."""


@pytest.mark.parametrize("what", MESSAGES)
async def test_each_thing_that_a_client_asks_for_takes_less_than_the_page_says(what: str) -> None:
    settings, first, messages, least, most = MESSAGES[what]
    async with serving(**settings) as connected:
        client = await connected()
        await client.send(*first)
        before = await settled()
        await client.send(*messages)
        each = (await settled() - before) / len(messages)

    assert least < each < most


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
            await client.send(*cancels(limits.requests))
            await client.send_bytes(header(limits.frame) + bytes(limits.frame - 1))
        await settled()
        peak = tracemalloc.get_traced_memory()[1] - before

    assert bound.whole / 20 < peak < bound.whole
