"""`Contender`: one way to have goals done in another process.

Each has a module of its own, `over_*`, with `serve`, which gives an address, and `connect`, which
takes that and gives a `Contender`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

AT_ONCE = 500
"""So many goals are a batch."""


class Contender(ABC):
    @abstractmethod
    async def goals(self, times: int) -> None:
        """Goals without feedback, one after another."""

    @abstractmethod
    async def batches(self, times: int) -> None:
        """Batches of goals without feedback, one batch after another."""

    @abstractmethod
    async def feedback(self, times: int) -> None:
        """One goal with so many feedback messages, all of them read and decoded."""
