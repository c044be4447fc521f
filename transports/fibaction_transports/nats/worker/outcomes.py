"""`KeptOutcomes`: the outcomes that one worker has stored, and the deletion of the oldest ones."""

from __future__ import annotations

import time
from collections import deque
from typing import Final

from fibaction_transports.nats.broker.broker import Broker
from fibaction_transports.nats.worker.goal_writes import HeldGoal

SECOND: Final = 1_000_000_000
DELETED_TTL = 60.0
"""Seconds that a deleted record is remembered."""


class KeptOutcomes:
    """The outcomes of one action at one worker."""

    def __init__(self, broker: Broker, max_results: int) -> None:
        """Keep so many of them at most."""
        self._broker = broker
        self._max_results = max_results
        self._ended: deque[tuple[int, str, int]] = deque()  # keep_until, subject, sequence

    def add(self, subject: str, held: HeldGoal) -> None:
        """Note the record of a goal that has ended, and delete the oldest if there are too many."""
        self._ended.append((held.stored.keep_until, subject, held.sequence))
        now = time.time_ns()
        while self._ended and (
            0 < self._ended[0][0] <= now or len(self._ended) > self._max_results
        ):
            keep_until, subject, sequence = self._ended.popleft()
            if not 0 < keep_until <= now:
                self._broker.put(
                    subject, b"", expected=sequence, ttl=DELETED_TTL, then=lambda _answer: None
                )

    def forget(self) -> None:
        """Forget all of them: their stream was lost."""
        self._ended.clear()
