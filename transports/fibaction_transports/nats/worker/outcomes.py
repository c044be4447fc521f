"""`KeptOutcomes`: the outcomes that one worker has stored, and the deletion of the oldest ones."""

from __future__ import annotations

import time
from collections import deque
from typing import Final, NamedTuple

from fibaction.border.goal_store import StoredGoal
from fibaction_transports.nats.broker.broker import Broker
from fibaction_transports.nats.worker.record_writes import HeldGoal

SECOND: Final = 1_000_000_000
DELETED_TTL = 60.0
"""Seconds that a deleted record is remembered."""


class KeptOutcome(NamedTuple):
    """The record of a goal that has ended."""

    ended_at: int
    keep_until: int
    subject: str
    sequence: int

    @classmethod
    def of(cls, goal: StoredGoal, subject: str, sequence: int) -> KeptOutcome:
        """Return the record of this goal."""
        return cls(goal.ended_at, goal.keep_until, subject, sequence)


class KeptOutcomes:
    """The outcomes of one action at one worker, and the goals of the fleet that were given up."""

    def __init__(self, broker: Broker, max_results: int) -> None:
        """Keep so many of each at most."""
        self._broker = broker
        self._max_results = max_results
        self._ended: deque[KeptOutcome] = deque()
        self._given_up: deque[KeptOutcome] = deque()

    def add(self, subject: str, held: HeldGoal) -> None:
        """Note the record of a goal that has ended, and delete the oldest if there are too many."""
        kept = self._given_up if held.stored.is_given_up else self._ended
        kept.append(KeptOutcome.of(held.stored, subject, held.sequence))
        self._trim(kept)

    def found(self, given_up: list[KeptOutcome]) -> None:
        """Note all goals that were given up, as their records say, and delete the oldest."""
        self._given_up = deque(sorted(given_up))
        self._trim(self._given_up)

    def _trim(self, kept: deque[KeptOutcome]) -> None:
        now = time.time_ns()
        while kept and (0 < kept[0].keep_until <= now or len(kept) > self._max_results):
            oldest = kept.popleft()
            if not 0 < oldest.keep_until <= now:
                self._broker.put(
                    oldest.subject,
                    b"",
                    expected=oldest.sequence,
                    ttl=DELETED_TTL,
                    then=lambda _answer: None,
                )

    def forget(self) -> None:
        """Forget all of them: their stream was lost."""
        self._ended.clear()
        self._given_up.clear()
