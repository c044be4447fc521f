"""`WorkerJournals`: the journals of one worker, one for each action.

When the lease of the worker has ended, all its goals are lost at once, and nothing more is written
with that incarnation.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager

from anyio import CancelScope
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.goal_store import KeyPlaces, StoredGoal
from fibaction.border.peer_text import excerpt
from fibaction.words.errors import StoreError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker
from fibaction_transports.nats.history.history_writes import HistoryWrites
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import LeaseEntry
from fibaction_transports.nats.worker.journal import FleetJournal
from fibaction_transports.nats.worker.lease import MemberPart, Membership


class WorkerJournals(MemberPart):
    """The journals of one worker that are open, and what they share."""

    def __init__(
        self, broker: Broker, names: FleetNames, membership: Membership, tasks: TaskGroup
    ) -> None:
        self.broker = broker
        self.names = names
        self.membership = membership
        self.tasks = tasks
        """The tasks of the worker."""
        self.room = Notifier()
        """Notifies of a change of the room of a server, or of the membership."""
        self.history = HistoryWrites(broker, names)
        """The goals that are added to the history of the fleet."""
        self.by_action: dict[str, FleetJournal] = {}
        """The journals that are open, by their actions."""
        self.has_goals_left = False
        """True if a server has stopped whose goals could not be released."""
        self.unreadable: dict[str, int] = {}
        """The number of goals without a worker that this one cannot run, by their actions."""
        membership.add(self)

    def __len__(self) -> int:
        """Return the number of goals of all journals."""
        return sum(map(len, self.by_action.values()))

    @asynccontextmanager
    async def open(
        self,
        action: str,
        *,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
        obstacle: Callable[[StoredGoal], str],
        key_places: Callable[[str, int], Awaitable[KeyPlaces]],
    ) -> AsyncGenerator[FleetJournal, None]:
        """Open the journal of an action for as long as the block lasts; then release its goals.

        The callbacks are those of `GoalStore.open`, and `GoalJournal.key_places`.

        Raises:
            StoreError: It is open already.
        """
        if action in self.by_action:
            raise StoreError(f"this worker serves the action {excerpt(action)!r} already")
        journal = FleetJournal(self, action, max_results, claim, lose, obstacle, key_places)
        self.by_action[action] = journal
        try:
            yield journal
        finally:
            with CancelScope(shield=True):
                await journal.release_rest()
                await self.history.settle()
            self.has_goals_left = self.has_goals_left or len(journal) > 0
            del self.by_action[action]
            self.room.notify()

    def describe(self, entry: LeaseEntry) -> None:
        """See `MemberPart.describe`."""
        entry.goals = len(self)

    def fenced(self) -> None:
        """See `MemberPart.fenced`."""
        for journal in self.by_action.values():
            journal.lose_all()
        self.room.notify()

    def joined(self) -> None:
        """See `MemberPart.joined`."""
        self.room.notify()
