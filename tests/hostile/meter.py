"""A meter of an event loop: the longest turn, and the peak of the process's memory.

A turn is what the loop does between two waits for its sockets: as long as it lasts, no other client
has an answer. It is measured in seconds of the processor that the thread has used, so that other
programs on a busy machine do not count.

But they slow the processor down, to less than half where two programs share a core. So a slow turn
is followed by a piece of work of which it is known how long it takes at best, and its seconds are
those of a processor at its best.
"""

from __future__ import annotations

import gc
import os
import selectors
import signal
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

SLOW = 0.02
"""Seconds of a turn from which on the speed of the processor is measured, too."""
PIECE = range(50_000)
"""What is summed up to know how fast the processor is: about a millisecond."""


class Reading(NamedTuple):
    """The meter's figures since the last reset."""

    longest: float
    """Seconds of the processor that the longest turn took, or the one that is not over, at the best
    speed of this machine."""
    cpu: float
    """Seconds of the processor that the thread has used."""
    peak: int
    """Bytes of resident memory, at most."""
    memory: int
    """Bytes of resident memory now."""
    collecting: float
    """Seconds of the processor that the longest garbage collection took."""


class Meter(selectors.DefaultSelector):
    """A selector of asyncio's loop that measures the time between two calls of `select`."""

    def __init__(self, orders: Connection) -> None:
        super().__init__()
        self._orders = orders
        self._clock = time.pthread_getcpuclockid(threading.get_ident())
        self._turn_began: float | None = None
        self._longest = 0.0
        self._best = min(self._summing() for _ in range(10))
        self._reset_at = self._now()
        self._collecting = self._collection_began = 0.0
        gc.callbacks.append(self._collects)
        threading.Thread(target=self._obey, daemon=True).start()

    def _now(self) -> float:
        return time.clock_gettime(self._clock)

    def _summing(self) -> float:
        """Return the seconds of the processor that it takes to sum up `PIECE` now."""
        began = self._now()
        sum(PIECE)
        return self._now() - began

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if self._turn_began is not None:
            taken = self._now() - self._turn_began
            if taken > SLOW:
                summing = self._summing()
                self._best = min(self._best, summing)
                taken *= self._best / summing
            self._longest = max(self._longest, taken)
            self._turn_began = None
        ready = super().select(timeout)
        self._turn_began = self._now()
        return ready

    def read(self) -> Reading:
        began, now = self._turn_began, self._now()
        running = 0.0 if began is None else now - began
        sizes = _sizes()
        return Reading(
            longest=max(self._longest, running),
            cpu=now - self._reset_at,
            peak=sizes["VmHWM"],
            memory=sizes["VmRSS"],
            collecting=self._collecting,
        )

    def reset(self) -> None:
        self._longest = self._collecting = 0.0
        self._reset_at = self._now()
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory is that of now

    def _collects(self, phase: str, _info: Mapping[str, int]) -> None:
        if phase == "start":
            self._collection_began = self._now()
        else:
            self._collecting = max(self._collecting, self._now() - self._collection_began)

    def _obey(self) -> None:
        """Answer the orders of the test, also while the loop is busy."""
        with suppress(EOFError, OSError):
            while True:
                if self._orders.recv() == "reset":
                    self.reset()
                self._orders.send(self.read())
        os.kill(os.getpid(), signal.SIGKILL)  # the test has gone, and the loop may hang


def _sizes() -> Mapping[str, int]:
    found: dict[str, Any] = {}
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if name in ("VmHWM", "VmRSS"):
            found[name] = int(value.split()[0]) * 1024
    return found
