"""The server that is attacked, in a process of its own.

It serves until SIGTERM, and its meter answers to the test. It logs to standard error as
docs/howto/secure.md shows.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # the meter is a selector of its loop
import ctypes
import logging
import os
import resource
import sys
from collections.abc import AsyncGenerator, Callable
from multiprocessing.connection import Connection
from signal import SIGTERM
from typing import Any

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, GoalRejected, Limits, Permission, serve
from fibaction._runtime.log import LIMIT
from fibaction.wire.auth import Peer
from tests.hostile.documents import ANYTHING, NUMBERS, TREE
from tests.hostile.meter import Meter
from tests.support.fibonacci import FIBONACCI, fibonacci


class Settings(msgspec.Struct):
    """The settings of a server, as a test gives them."""

    limits: dict[str, int | float] = {}
    """Fields of `Limits`."""
    server: dict[str, Any] = {}
    """Arguments of each `ActionServer`."""
    wire: dict[str, Any] = {}
    """Arguments of `serve`."""
    authorize: str = ""
    """The name of a function in `AUTHORIZE`; empty for none."""
    url: str = "tcp://127.0.0.1:0"
    """The address at which it serves, beside one of `http://`."""


class Beat(msgspec.Struct):
    """A goal of `ticker`: so many messages of so many bytes, each after so many seconds."""

    interval: float = 0.0
    size: int = 0
    count: int = 2**31


class Sized(msgspec.Struct):
    """A goal of `grow`: so many bytes of result."""

    size: int


MOST_MEMORY = 4 * 2**30
"""Bytes of address space from which on the server fails: an attack is not to stop the machine."""


MMAP_THRESHOLD = -3
"""The option of `mallopt` with the bytes of a block from which on it is given back when freed.

glibc raises it to the largest block that was freed. From then on, blocks of that size leave holes
in the heap, and the peak of a server with messages of 15 MiB is 60 to 100 MiB by chance.
docs/howto/secure.md says how to set it for a server.
"""
LARGE_BLOCK = 2**20


class Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A goal whose error names the field that does not belong to it."""

    size: int


TICKER = Action("ticker", goal=Beat, feedback=bytes, result=int)
ECHO = Action("echo", goal=dict[str, Any], feedback=int, result=dict[str, Any])
GROW = Action("grow", goal=Sized, feedback=int, result=bytes)
FOREVER = Action("forever", goal=int, feedback=str, result=int)
DEAF = Action("deaf", goal=int, feedback=str, result=int)
STUBBORN = Action("stubborn", goal=int, feedback=str, result=int)
FAIL = Action("fail", goal=str, feedback=str, result=int)
PICKY = Action("picky", goal=str, feedback=str, result=int)
HOLD = Action("hold", goal=dict[str, Any], feedback=str, result=int)
STRICT = Action("strict", goal=Strict, feedback=str, result=int)
SLOW = Action("slow", goal=dict[str, Any], feedback=str, result=int)


async def ticker(goal: GoalHandle[Beat]) -> AsyncGenerator[bytes | int, None]:
    beat = goal.request
    for _ in range(beat.count):
        if beat.interval:
            await anyio.sleep(beat.interval)
        yield bytes(beat.size)
    yield beat.count


async def echo(goal: GoalHandle[dict[str, Any]]) -> AsyncGenerator[int | dict[str, Any], None]:
    yield goal.request


async def grow(goal: GoalHandle[Sized]) -> AsyncGenerator[int | bytes, None]:
    yield bytes(goal.request.size)


async def forever(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    await anyio.sleep_forever()
    yield 0


async def stubborn(goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
    """Swallow every cancellation."""
    while True:
        try:
            await anyio.sleep_forever()
        except BaseException:  # the mistake that this executor is for
            yield goal.request


async def fail(goal: GoalHandle[str]) -> AsyncGenerator[int, None]:
    if goal.request is not None:
        raise ValueError(goal.request)
    yield 0


async def nothing(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    yield 0


def reject(goal: str) -> None:
    raise GoalRejected(goal)


async def wait(goal: object) -> None:
    await anyio.sleep(0.3)


def servers(given: dict[str, Any]) -> list[ActionServer[Any, Any, Any]]:
    """Return the servers of all actions."""
    given = {"shutdown_timeout": 0.5, **given}
    return [
        ActionServer(FIBONACCI, fibonacci, **given),
        ActionServer(TICKER, ticker, **given),
        ActionServer(ECHO, echo, **given),
        ActionServer(GROW, grow, **given),
        ActionServer(FOREVER, forever, **given),
        ActionServer(DEAF, forever, **{"interrupt_on_cancel": False, **given}),
        ActionServer(STUBBORN, stubborn, **given),
        ActionServer(FAIL, fail, **given),
        ActionServer(HOLD, forever, **given),
        ActionServer(PICKY, nothing, on_goal=reject, **given),
        ActionServer(STRICT, nothing, **given),
        ActionServer(SLOW, nothing, on_goal=wait, **given),
        ActionServer(TREE, nothing, **given),
        ActionServer(NUMBERS, nothing, **given),
        ActionServer(ANYTHING, nothing, **given),
    ]


def only_send(peer: Peer, action: str, permission: Permission) -> bool:
    return peer.name == "honest" or permission is Permission.SEND


def only_observe(peer: Peer, action: str, permission: Permission) -> bool:
    return peer.name == "honest" or permission is Permission.OBSERVE


async def later(peer: Peer, action: str, permission: Permission) -> bool:
    if peer.name != "honest":
        await anyio.sleep(0.3)
    return True


AUTHORIZE: dict[str, Callable[..., Any]] = {
    function.__name__: function for function in (only_send, only_observe, later)
}


async def serve_all(settings: Settings, test: Connection) -> None:
    """Serve until SIGTERM; the test is sent the URLs first."""
    wire = dict(settings.wire)
    if settings.authorize:
        wire["authorize"] = AUTHORIZE[settings.authorize]
    limits: Any = settings.limits
    with anyio.open_signal_receiver(SIGTERM) as signals:
        async with serve(
            servers(settings.server),
            settings.url,
            "http://127.0.0.1:0",
            limits=Limits(**limits),
            **wire,
        ) as urls:
            test.send(urls)
            await anext(signals)


def run(test: Connection, orders: Connection, log: str, settings: Settings) -> None:
    """Be the server's process."""
    ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, LARGE_BLOCK)
    os.dup2(os.open(log, os.O_WRONLY), sys.stderr.fileno())
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")
    anyio.run(
        serve_all,
        settings,
        test,
        backend_options={"loop_factory": lambda: asyncio.SelectorEventLoop(Meter(orders))},
    )
    LIMIT.flush()  # a process of multiprocessing calls nothing at its exit
