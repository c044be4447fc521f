"""`FleetStore`: the goals of one worker, kept by the brokers.

There is a journal for each action. When the lease of the worker has ended, all its goals are lost
at once (`lose_all`), and nothing more is written with that incarnation.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from anyio import CancelScope
from anyio.abc import TaskGroup

from fibaction.border.event_loop import Background
from fibaction.border.goal_store import GoalStore, KeyPlaces, StoredGoal, no_obstacle
from fibaction.border.peer_text import excerpt
from fibaction.words.errors import StoreError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.worker.journal import FleetJournal
from fibaction_transports.nats.worker.lease import Membership

if TYPE_CHECKING:
    from fibaction_transports.nats.worker.limits.fleet_limits import FleetLimits


def _ignore(_journal: FleetJournal, _tasks: TaskGroup, _ends_unreadable: bool) -> None:
    """Do nothing with a journal."""


class FleetStore(GoalStore):
    """The goals of all servers of one worker."""

    tells_statuses = True

    def __init__(self, broker: Broker, names: FleetNames, membership: Membership) -> None:
        self.broker = broker
        self.names = names
        self.membership = membership
        self.tasks: TaskGroup
        """The tasks of the worker."""
        self.limits: FleetLimits
        """The limits that this worker has together with others."""
        self.journals: dict[str, FleetJournal] = {}
        """The journals that are open, by their actions."""
        self.has_goals_left = False
        """True if a server has stopped whose goals could not be released."""
        self.unreadable: dict[str, int] = {}
        """The number of goals without a worker that this one cannot run, by their actions."""
        self.on_open: Callable[[FleetJournal, TaskGroup, bool], None] = _ignore
        """The function that is called with each journal that is opened, with its tasks, and with
        whether its server ends the goals that no worker can run."""
        self.on_room: Callable[[], None] = lambda: None
        """The function that is called when the room of a server has changed."""
        membership.on_fence = self.lose_all

    def __len__(self) -> int:
        return sum(map(len, self.journals.values()))

    async def key_places(self, limit: str, most: int) -> KeyPlaces:
        """Return the places of a limit of all workers: see `GoalJournal.key_places`."""
        return await self.limits.places(limit, most)

    def lose_all(self) -> None:
        """Let go of all goals: the lease has ended."""
        for journal in self.journals.values():
            journal.lose_all()

    @asynccontextmanager
    async def open(
        self,
        action: str,
        *,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
        obstacle: Callable[[StoredGoal], str] = no_obstacle,
        ends_unreadable: bool = False,
    ) -> AsyncGenerator[FleetJournal, None]:
        """See `GoalStore.open`. Goals are claimed from when the block begins."""
        if action in self.journals:
            raise StoreError(f"this worker serves the action {excerpt(action)!r} already")
        journal = FleetJournal(self, action, max_results, claim, lose, obstacle)
        self.journals[action] = journal
        try:
            async with Background() as tasks:
                self.on_open(journal, tasks, ends_unreadable)
                yield journal
        finally:
            with CancelScope(shield=True):
                await journal.release_rest()
            self.has_goals_left = self.has_goals_left or len(journal) > 0
            del self.journals[action]
            self.on_room()
