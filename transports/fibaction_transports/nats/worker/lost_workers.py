"""`LostWorkers`: the judgement that a worker is gone.

It is made by the brokers alone: there is no lease with the incarnation of the worker. While the
stream of the leases is new, its silence says nothing: after the loss of the old stream, each worker
writes its lease again, and has the time of one lease for this.
"""

from __future__ import annotations

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ProtocolError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerRecord
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import GoalEntry, goal_entry, lease_entry
from fibaction_transports.nats.worker.lease import Membership
from fibaction_transports.nats.workers import FleetWorkers

logger = clean_logger("fibaction.nats")


def entry_of(record: BrokerRecord) -> GoalEntry | None:
    """Return the entry in the record of a goal; None if it was deleted, or cannot be read."""
    if not record.data:
        return None
    try:
        return goal_entry(record.data)
    except ProtocolError as exc:
        logger.warning("%s: %s", record.subject, exc)
        return None


async def active_record(
    broker: Broker, names: FleetNames, action: str, goal_id: GoalID
) -> tuple[BrokerRecord, GoalEntry] | None:
    """Return the record of an active goal, and the entry in it; None if there is none.

    Raises:
        BrokerAway: The brokers do not answer.
    """
    record = await broker.get(names.goals, names.goal(action, goal_id))
    entry = None if record is None else entry_of(record)
    if record is None or entry is None or not entry.goal.status.is_active:
        return None
    return record, entry


class LostWorkers:
    """The workers that one worker knows to be gone."""

    def __init__(
        self, broker: Broker, names: FleetNames, membership: Membership, workers: FleetWorkers
    ) -> None:
        self._broker = broker
        self._names = names
        self._membership = membership
        self._workers = workers
        self._gone: set[bytes] = set()  # incarnations, which never come back

    async def is_gone(self, entry: GoalEntry) -> bool:
        """Return whether a goal has no worker, as far as the brokers know.

        Raises:
            BrokerAway: They do not answer, or cannot know it yet.
        """
        return await self.has_ended(entry.goal.worker, entry.incarnation)

    async def has_ended(self, worker: str, incarnation: bytes) -> bool:
        """Return whether an incarnation of a worker has no lease, as far as the brokers know.

        Raises:
            BrokerAway: They do not answer, or cannot know it yet.
        """
        if not incarnation or incarnation in self._gone:
            return True
        if incarnation == self._membership.incarnation or self._workers.has(worker, incarnation):
            return False
        record = await self.record_of(worker)
        if record is not None and record.data:
            try:
                if lease_entry(record.data).incarnation == incarnation:
                    return False
            except ProtocolError:
                return False
        self._gone.add(incarnation)
        return True

    async def record_of(self, worker: str) -> BrokerRecord | None:
        """Return the lease of a worker, which may be a marker; None if it has none for certain.

        Raises:
            BrokerAway: The brokers do not answer, or cannot know it yet.
        """
        stream = self._names.workers
        record = await self._broker.get(stream, self._names.worker(worker))
        if record is None and await self._broker.is_new(stream, self._membership.lease):
            raise BrokerAway(f"the stream {stream} is new, and workers may write to it yet")
        return record
