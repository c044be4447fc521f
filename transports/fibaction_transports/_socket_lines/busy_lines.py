"""`LineTurns`: the lines of a server on asyncio that have more to handle than a slice of time."""

from __future__ import annotations

import asyncio  # noqa: TID251  # this module is for lines on asyncio only
from abc import abstractmethod
from contextvars import Context, copy_context
from time import perf_counter
from typing import Protocol

from fibaction.border.event_loop import SLICE

NEWS = 0.001
"""Seconds of a turn of the event loop in which lines handle as much news as a slice takes."""


class BusyLine(Protocol):
    """A line that handles what it has read a part at a time."""

    @property
    @abstractmethod
    def context(self) -> Context:
        """The context variables with which it handles frames."""

    @property
    @abstractmethod
    def has_rest(self) -> bool:
        """True if it has more to handle."""

    @abstractmethod
    def go_on(self) -> None:
        """Handle the next part."""


class LineTurns:
    """The lines that have frames left to handle: together they have one slice of each turn of the
    event loop, and go on one after another.

    However many lines there are, they delay the others together as little as one would. So they do
    if many have news in one turn: after `NEWS` seconds each handles one frame, and waits.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._context = copy_context()
        self._waiting: dict[BusyLine, None] = {}
        self._is_due = False
        self._used = 0.0
        """Seconds of this turn in which news were handled."""

    @property
    def is_used_up(self) -> bool:
        """True if the time for news is over in this turn."""
        return self._used >= NEWS

    def use(self, seconds: float) -> None:
        """Count the time in which a line has handled news."""
        if not self._used:
            self._loop.call_soon(self._begin)  # before the sockets of the next turn
        self._used += seconds

    def _begin(self) -> None:
        self._used = 0.0

    def add(self, line: BusyLine) -> None:
        """Let the line go on in a later turn."""
        self._waiting[line] = None
        self._schedule()

    def discard(self, line: BusyLine) -> None:
        """Remove a line that has ended, so that the others do not wait for it."""
        self._waiting.pop(line, None)

    def _schedule(self) -> None:
        if not self._is_due:
            self._is_due = True
            self._loop.call_soon(self._next, context=self._context)

    def _next(self) -> None:
        self._is_due = False
        ends = perf_counter() + SLICE
        left = len(self._waiting)
        while self._waiting and left:  # a line may end others
            left -= 1
            line = next(iter(self._waiting))
            del self._waiting[line]
            line.context.run(line.go_on)
            if line.has_rest:
                self._waiting[line] = None
            if perf_counter() >= ends:
                break
        if self._waiting:
            self._schedule()
