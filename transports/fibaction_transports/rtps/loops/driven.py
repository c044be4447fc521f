"""The border between a participant with sockets and the event loop that drives it."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Protocol


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
        """Call `settle` soon, when those that are ready now have had their turn."""

    async def run(self, driven: Driven, sources: Sequence[socket.socket]) -> None:
        """Drive a participant with its sockets until canceled."""
