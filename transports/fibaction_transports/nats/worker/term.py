"""`Term`: the time in which a lease is valid for certain, without I/O."""

from __future__ import annotations

import math

MARGIN = 1 / 5
"""The part of a lease that a worker leaves unused, so that it has stopped when the lease ends."""
RENEWALS = 3
"""The number of renewals in the time of one lease."""


class Term:
    """The time in which a lease is valid for certain, without I/O."""

    def __init__(self, lease: float) -> None:
        self.lease = lease
        self.valid_until = -math.inf
        """Time until which the lease is valid for certain."""
        self.renew_at = -math.inf
        """Time of the next renewal."""
        self._sent: float | None = None  # the first write whose answer has not come

    def sent(self, now: float) -> None:
        """Note that a renewal is sent now."""
        if self._sent is None:
            self._sent = now

    def stored(self) -> None:
        """Note that the lease is stored, by the earliest of the writes that were sent."""
        assert self._sent is not None
        self.valid_until = self._sent + self.lease * (1 - MARGIN)
        self.renew_at = self._sent + self.lease / RENEWALS
        self._sent = None

    def end(self) -> None:
        """Forget the lease."""
        self.valid_until = self.renew_at = -math.inf
        self._sent = None
