"""`LostStreams`: makes the streams of a fleet again when they are lost, and fills them.

Theory of operation
-------------------

A stream is lost when an operator deletes it, or when a broker comes back without its storage. Then
there is none, or another one of its name, which this or another worker has made. Each worker looks
for the streams several times in a lease, so that it can store its lease again before it has to
fence itself. It makes those that are missing, and writes again what is its own:

- its lease, so that other workers do not take its goals over;
- the records of its goals, which continue meanwhile;
- the notes of goals that wait at it, and of those that a scan finds without a worker;
- the slots of keys that its goals have, if it has opened their stream (`open_keys`).

The history (`open_history`) is made again without goals. What no living worker has in its memory is
lost: outcomes, and goals that had no worker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from anyio import sleep

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError
from fibaction.words.goal_query import GoalHistory
from fibaction_transports.nats.broker.broker import BrokerAway
from fibaction_transports.nats.worker.journal import WorkerJournals
from fibaction_transports.nats.worker.lease import FIRST_PAUSE
from fibaction_transports.nats.worker.takeover import Takeover

CHECKS = 4
"""The number of times that the streams are looked for in the time of one lease."""
LOST = ""
"""Stands for the identity of a stream that is lost, and not made again yet."""

logger = clean_logger("fibaction.nats")


class _More(NamedTuple):
    """The streams that a fleet has in addition to the three that each has."""

    has_keys: bool = False
    history: GoalHistory | None = None


class LostStreams:
    """The streams of one fleet, as one worker looks after them."""

    def __init__(self, journals: WorkerJournals, takeover: Takeover, replicas: int) -> None:
        self._broker = journals.broker
        self._names = names = journals.names
        self._membership = journals.membership
        self._journals = journals
        self._takeover = takeover
        self._replicas = replicas
        self._known: dict[str, str] = {}  # the identities of the streams
        self._more = _More()
        self._repairs: dict[str, tuple[str, Callable[[], None]]] = {
            names.workers: ("the leases of workers", self._membership.rewrite),
            names.goals: ("outcomes, and goals that had no worker", self._rewrite_goals),
            names.notes: ("notes of goals that wait or are left", self._add_notes),
        }

    async def open(self) -> None:
        """Note the streams that there are.

        Raises:
            BrokerAway: The brokers do not answer.
        """
        for stream in self._repairs:
            self._known[stream] = await self._identity(stream)

    async def open_keys(self, repair: Callable[[], None]) -> None:
        """Make the stream of the slots of keys if it is missing, and look for it from now on: call
        `repair` when it was lost, and is there again.

        Raises:
            BrokerAway: The brokers do not answer.
            TransportError: The stream cannot be made.
        """
        more = self._more._replace(has_keys=True)
        await self._open(self._names.keys, "the slots of keys", repair, more)

    async def make_keys(self) -> None:
        """Make the stream of the slots of keys for other records, if it is missing.

        Raises:
            BrokerAway: The brokers do not answer.
            TransportError: The stream cannot be made.
        """
        if self._names.keys not in self._repairs:
            await self.open_keys(lambda: None)

    async def open_history(self, history: GoalHistory) -> None:
        """Make the stream of the history if it is missing, with these bounds, and look for it.

        Raises:
            BrokerAway: The brokers do not answer.
            TransportError: The stream cannot be made.
        """
        more = self._more._replace(history=history)
        await self._open(self._names.history, "the goals of the past", lambda: None, more)

    async def _open(self, stream: str, what: str, repair: Callable[[], None], more: _More) -> None:
        await self._make(more)
        self._known[stream] = await self._identity(stream)
        self._repairs[stream] = what, repair
        self._more = more  # not before, or later repairs would need it

    async def run(self) -> None:
        """Look for the streams, until canceled."""
        while True:
            pause = self._membership.lease / CHECKS
            try:
                await self._check()
            except BrokerAway:
                pause = FIRST_PAUSE  # the next request waits for the connection
            except TransportError as exc:
                logger.warning("worker %r: %s", self._membership.worker, exc)
            await sleep(pause)

    async def _check(self) -> None:
        """Look for each stream, and repair those that are lost.

        Raises:
            BrokerAway: The brokers do not answer.
            TransportError: A stream cannot be made again.
        """
        known = dict(self._known)
        found = {stream: await self._identity(stream) for stream in known}
        lost = [stream for stream, one in known.items() if found[stream] != one]
        for stream in lost:
            if self._known[stream] != LOST:
                what, _ = self._repairs[stream]
                logger.error("the stream %s was lost, and with it %s", stream, what)
                self._known[stream] = LOST
        if LOST in found.values():
            await self._make(self._more)
        for stream in lost:
            self._known[stream] = await self._identity(stream)
            if self._known[stream] != LOST:
                _, repair = self._repairs[stream]
                repair()

    async def _make(self, more: _More) -> None:
        """Make the streams that are missing."""
        await self._broker.create_streams(
            self._names, replicas=self._replicas, has_keys=more.has_keys, history=more.history
        )

    async def _identity(self, stream: str) -> str:
        found = await self._broker.find_stream(stream)
        return LOST if found is None else found.identity

    def _rewrite_goals(self) -> None:
        for journal in self._journals.by_action.values():
            journal.rewrite_all()

    def _add_notes(self) -> None:
        for journal in self._journals.by_action.values():
            journal.offer_all()
        self._takeover.note_again()
