"""The driver for trio, and for the event loop of Windows, which has no readers."""

from __future__ import annotations

import math
import socket
from collections.abc import Sequence

import anyio

from fibaction_transports.rtps.loops.driven import Driven


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
