"""The writes of goals to their records: their order, and the rule for doubtful ones.

Theory of operation
-------------------

The writes of one goal wait for each other, because each needs the sequence of the one before; those
of different goals do not. Answers are given in the order of the calls (`AnswerQueue`).

A write without an answer may be stored or not. Then the record is read, until the lease ends: with
the nonce of the write it is stored; with the sequence from before it is written again; otherwise
the goal is taken (`HeldGoal.sequence_for`).

If there is no room for a write, a new goal is rejected, and a write about an accepted one waits
(`Shortage`). The records of goals that have ended are counted, and the oldest ones are deleted
(`KeptOutcomes`).

Sans-I/O, but for that.
"""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable
from copy import copy
from typing import NamedTuple

from fibaction.border.goal_store import (
    GoalTaken,
    RecordTooLarge,
    StoredGoal,
    StoreFull,
    Then,
)
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ProtocolError, StoreError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerRecord
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    NONCE_SIZE,
    ROOM_TO_GROW,
    GoalEntry,
    encode,
    goal_entry,
)
from fibaction_transports.nats.worker.lease import FIRST_PAUSE, LONGEST_PAUSE

SPARE = {
    kind: ROOM_TO_GROW - 64 * step
    for step, kind in enumerate(("accept", "take", "begin", "cancel"))
}
"""Bytes that are added to a record of this kind. Each later record of the goal has fewer, so that a
full stream has room for it in place of the one before: for an end with a short result, too."""
DELETED_TTL = 60.0
"""Seconds that a deleted record is remembered."""
IS_STORED = -1
"""Stands for a sequence: the write is stored already."""

logger = clean_logger("fibaction.nats")


class Write:
    """A write of one goal."""

    __slots__ = (
        "_pause",
        "answer",
        "data",
        "incarnation",
        "is_answered",
        "kind",
        "nonce",
        "stored",
        "then",
    )

    def __init__(
        self, kind: str, goal: StoredGoal, worker: str, incarnation: bytes, then: Then
    ) -> None:
        self.kind = kind
        self.stored = copy(goal)
        self.stored.worker = "" if kind == "release" else worker
        self.incarnation = incarnation
        self.nonce = secrets.token_bytes(NONCE_SIZE) + bytes(SPARE.get(kind, 0))
        owner = b"" if kind == "release" else incarnation
        self.data = encode(GoalEntry(self.stored, owner, self.nonce))
        self.then = then
        self.is_answered = False
        self.answer: StoreError | None = None
        self._pause = FIRST_PAUSE

    def next_pause(self) -> float:
        """Return the seconds before the next try, which grow from one to the next."""
        pause, self._pause = self._pause, min(2 * self._pause, LONGEST_PAUSE)
        return pause


class HeldGoal:
    """A goal that this worker has."""

    __slots__ = ("goal_id", "sequence", "stored", "waits", "writes")

    def __init__(self, goal_id: GoalID, sequence: int, stored: StoredGoal) -> None:
        self.goal_id = goal_id
        self.sequence = sequence
        """The sequence of its record; 0 if it has none."""
        self.stored = stored
        """The goal as it was written last."""
        self.waits = False
        """True if it has not begun here."""
        self.writes: deque[Write] = deque()
        """The writes that are not answered; the first one is under way."""

    def is_first(self, write: Write) -> bool:
        """Return whether a write is the one that is under way."""
        return bool(self.writes) and self.writes[0] is write

    def sequence_for(self, write: Write, record: BrokerRecord | None) -> int | None:
        """Return the sequence to write over, by the record that was read after a doubtful write;
        `IS_STORED` if the write is stored, None if the goal is taken.
        """
        if record is None or record.sequence < self.sequence:
            return self.sequence  # by a broker that is behind: sequences only grow
        if not record.data:
            return record.sequence if write.kind == "accept" else None
        try:
            entry = goal_entry(record.data)
        except ProtocolError:
            return None
        if entry.nonce == write.nonce:
            return IS_STORED
        is_mine = entry.incarnation == write.incarnation
        if record.sequence == self.sequence or (is_mine and write.kind != "accept"):
            return record.sequence
        has_ended = entry.goal.status.is_terminal and is_mine
        # The server has forgotten its outcome, so the goal may be sent again.
        return record.sequence if write.kind == "accept" and has_ended else None


class AnswerQueue:
    """The answers to writes, which are given in the order of the calls."""

    def __init__(self, on_empty: Callable[[], None]) -> None:
        """Call `on_empty` when all writes are answered."""
        self._on_empty = on_empty
        self._order: deque[Write] = deque()
        self._is_answering = False

    def __len__(self) -> int:
        return len(self._order)

    def add(self, write: Write) -> None:
        """Take the turn of a write."""
        self._order.append(write)

    def answer(self, write: Write, error: StoreError | None) -> None:
        """Answer a write as soon as all before it are answered."""
        write.is_answered, write.answer = True, error
        if self._is_answering:
            return  # a function that takes an answer has called
        self._is_answering = True
        try:
            while self._order and self._order[0].is_answered:
                first = self._order.popleft()
                first.then(first.answer)
        finally:
            self._is_answering = False
        if not self._order:
            self._on_empty()


def taken(goal_id: GoalID) -> GoalTaken:
    """Return the error for a goal of another worker."""
    return GoalTaken(f"another worker has goal {goal_id}")


def too_large(write: Write, limit: int) -> RecordTooLarge:
    """Return the error for a record with more bytes than the brokers take."""
    what = f"the record of goal {write.stored.goal_id} has {len(write.data)} bytes"
    return RecordTooLarge(f"{what}, and the brokers take {limit} at most")


class Shortage:
    """A shortage of room at full brokers: the goals of one action whose writes wait.

    New goals are rejected meanwhile: the next room is for goals that were accepted.
    """

    def __init__(self, names: FleetNames) -> None:
        self._fleet = excerpt(names.fleet)
        self._stream = names.goals
        self._goals: set[GoalID] = set()
        self._is_closed = False

    def __bool__(self) -> bool:
        return bool(self._goals)

    def error(self, why: str = "accepted goals wait for room") -> StoreFull:
        """Return the error of a new goal."""
        return StoreFull(
            f"the brokers of fleet {self._fleet!r} keep no more goals: {why} (stream"
            f" {self._stream})"
        )

    def failure_of(self, write: Write, why: str) -> StoreError | None:
        """Return the error of a write for which there is no room; None if it is to wait.

        An end and a begin wait, however long. A new goal is rejected, and what is written at a stop
        fails, so that it ends.
        """
        error = self.error(why)
        if write.kind == "accept":
            return error
        if write.kind == "release" or self._is_closed:
            return StoreError(str(error))
        if not self._goals:
            logger.error("%s; what is told of accepted goals waits", error)
        self._goals.add(write.stored.goal_id)
        return None

    def close(self) -> None:
        """Let nothing wait any longer: the server has stopped."""
        self._is_closed = True

    def discard(self, goal_id: GoalID) -> None:
        """Note that nothing about a goal waits any longer."""
        if goal_id in self._goals:
            self._goals.remove(goal_id)
            if not self._goals:
                logger.warning("the brokers of fleet %r have room again", self._fleet)


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
