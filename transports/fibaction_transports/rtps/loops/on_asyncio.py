"""The driver for asyncio: a persistent reader for each socket, and one handle for the deadline.

Waiting for each datagram in a task would add and remove the reader each time, and wake a task.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # this module is for asyncio only
import math
import socket
from collections.abc import Callable, Sequence

from fibaction.border.event_loop import asyncio_loop, asyncio_task
from fibaction_transports.rtps.loops.driven import Driven

TURNS = 4
"""Turns of the event loop after which `settle` is called: the samples that a goal causes are
written in several turns, by several tasks, and share a datagram."""
LONGEST_SETTLING = 0.001
"""Seconds after which `settle` is called at the next turn, because each may take long."""


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
        self._turns = 0
        self._settle_until = 0.0
        self.time = self._loop.time
        """Return the time of the event loop."""

    def settle_soon(self) -> None:
        """Call `settle` after a few turns of the event loop."""
        if self._settling is None:
            self._turns = TURNS
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
        self._guarded(lambda: self._read(driven, source))

    def _read(self, driven: Driven, source: socket.socket) -> None:
        driven.read(source)
        if self._turn is None:
            self._work(driven)

    def _work(self, driven: Driven) -> None:
        """Work for one turn; others have theirs before the next one."""
        self._turn = None
        if driven.work():
            self._turn = self._loop.call_soon(self._guarded, lambda: self._work(driven))

    def _ring(self) -> None:
        self._wake_at = math.inf
        if self._driven is not None:
            self._guarded(self._driven.on_deadline)

    def _settle(self) -> None:
        self._turns -= 1
        if self._turns > 0 and self.time() < self._settle_until:
            self._settling = self._loop.call_soon(self._settle)
            return
        self._settling = None
        if self._driven is not None:
            self._guarded(self._driven.settle)

    def _guarded(self, call: Callable[[], None]) -> None:
        """Call, and let `run` raise what is raised."""
        try:
            call()
        except Exception as exc:
            if not self._failed.done():
                self._failed.set_exception(exc)
