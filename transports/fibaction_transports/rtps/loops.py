"""The event loops that drive a participant with sockets.

That of asyncio has a persistent reader for each socket, and one handle for the deadline: waiting
for each datagram in a task would add and remove the reader each time, and wake a task. The other
one is for trio, and for the event loop of Windows, which has no readers.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # one of the loops is for asyncio only
import math
import socket
from collections.abc import Sequence
from typing import Protocol

import anyio

from fibaction.border.event_loop import asyncio_loop, asyncio_task

LONGEST_SETTLING = 0.001
"""Seconds after which `settle` is called in any case."""


class Driven(Protocol):
    """A participant with sockets, as its loop sees it."""

    def read(self, source: socket.socket) -> None:
        """Read what has arrived at a socket."""

    def work(self) -> bool:
        """Take what was read, for a short time; return whether something is left."""
        ...

    def on_deadline(self) -> None:
        """Do what is due."""

    def settle(self) -> None:
        """Send what is to be sent."""


class DrivingLoop(Protocol):
    """An event loop that drives a participant."""

    def time(self) -> float:
        """Return the time of the event loop."""
        ...

    def wake(self, when: float) -> None:
        """Call `on_deadline` at this time at the latest."""

    def settle_soon(self) -> None:
        """Call `settle` soon, when those that are ready now have had their turn: the samples that a
        goal causes are written in several turns, by several tasks, and share a datagram.
        """

    async def run(self, driven: Driven, sources: Sequence[socket.socket]) -> None:
        """Drive a participant with its sockets until canceled."""


def calls_for(source: socket.socket) -> bool:
    """Return whether the caller runs on an event loop of asyncio that calls back for sockets, as
    all do but that of Windows.
    """
    if asyncio_task() is None:
        return False
    try:
        asyncio_loop().add_reader(source, bool)
    except NotImplementedError:
        return False
    asyncio_loop().remove_reader(source)
    return True


class AsyncioLoop:
    """Drives a participant by callbacks of asyncio's loop."""

    def __init__(self) -> None:
        self._loop = asyncio_loop()
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._driven: Driven | None = None
        self._wake_at = math.inf
        self._alarm: asyncio.TimerHandle | None = None
        self._turn: asyncio.Handle | None = None
        self._settling: asyncio.Handle | None = None
        self._is_wanted = False
        self._settle_until = 0.0
        self.time = self._loop.time
        """Return the time of the event loop."""

    def settle_soon(self) -> None:
        """Call `settle` after a whole turn of the event loop in which nobody has asked for it."""
        self._is_wanted = True
        if self._settling is None:
            self._settle_until = self.time() + LONGEST_SETTLING
            self._settling = self._loop.call_soon(self._settle)

    def wake(self, when: float) -> None:
        """Call `on_deadline` at this time at the latest."""
        # Most deadlines are put off: an alarm that is too early costs less than moving it.
        if when < self._wake_at:
            if self._alarm is not None:
                self._alarm.cancel()
            self._wake_at = when
            self._alarm = self._loop.call_at(when, self._ring)

    async def run(self, driven: Driven, sources: Sequence[socket.socket]) -> None:
        """Drive a participant with its sockets until canceled, or until a callback fails."""
        self._driven = driven
        try:
            for source in sources:
                self._loop.add_reader(source, self._on_readable, driven, source)
            await self._failed
        finally:
            self._driven = None
            for source in sources:
                self._loop.remove_reader(source)
            for handle in (self._alarm, self._turn, self._settling):
                if handle is not None:
                    handle.cancel()

    def _on_readable(self, driven: Driven, source: socket.socket) -> None:
        try:
            driven.read(source)
        except Exception as exc:
            self._fail(exc)
        else:
            if self._turn is None:
                self._work(driven)

    def _work(self, driven: Driven) -> None:
        """Work for one turn; others have theirs before the next one."""
        self._turn = None
        try:
            is_left = driven.work()
        except Exception as exc:
            self._fail(exc)
        else:
            if is_left:
                self._turn = self._loop.call_soon(self._work, driven)

    def _ring(self) -> None:
        self._wake_at = math.inf
        if self._driven is not None:
            try:
                self._driven.on_deadline()
            except Exception as exc:
                self._fail(exc)

    def _settle(self) -> None:
        if self._is_wanted and self.time() < self._settle_until:
            self._is_wanted = False
            self._settling = self._loop.call_soon(self._settle)
            return
        self._settling = None
        if self._driven is not None:
            try:
                self._driven.settle()
            except Exception as exc:
                self._fail(exc)

    def _fail(self, exc: Exception) -> None:
        """Let `run` raise an error of a callback."""
        if not self._failed.done():
            self._failed.set_exception(exc)


class AnyioLoop:
    """Drives a participant by tasks."""

    def __init__(self) -> None:
        self._wake_at = math.inf
        self._woken = anyio.Event()

    def time(self) -> float:
        """Return the time of the event loop."""
        return anyio.current_time()

    def settle_soon(self) -> None:
        """Call `settle` when those that are ready now have had their turn."""
        self.wake(-math.inf)  # `on_deadline` settles, too

    def wake(self, when: float) -> None:
        """Call `on_deadline` at this time at the latest."""
        if when < self._wake_at:
            self._wake_at = when
            self._woken.set()

    async def run(self, driven: Driven, sources: Sequence[socket.socket]) -> None:
        """Drive a participant with its sockets until canceled."""
        async with anyio.create_task_group() as tasks:
            for source in sources:
                tasks.start_soon(self._receive, driven, source)
            await self._keep_deadlines(driven)

    async def _receive(self, driven: Driven, source: socket.socket) -> None:
        while True:
            await anyio.wait_readable(source)
            driven.read(source)
            while driven.work():
                await anyio.lowlevel.checkpoint()

    async def _keep_deadlines(self, driven: Driven) -> None:
        while True:
            self._woken = anyio.Event()
            with anyio.move_on_after(self._wake_at - anyio.current_time()):
                await self._woken.wait()
            if self._wake_at <= anyio.current_time():
                self._wake_at = math.inf
                driven.on_deadline()
