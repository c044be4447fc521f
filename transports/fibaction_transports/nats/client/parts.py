"""`FleetParts`: the parts of a connection to a fleet, and how long a call tries to find a worker.

`RetryTime` limits the time, and `Placement` knows the workers that one goal was sent to.
"""

from __future__ import annotations

from anyio import current_time

from fibaction.words.errors import ActionError, ConnectionLost, GoalRejected
from fibaction_transports.nats.client.call_routes import (
    FIRST_PAUSE,
    LONGEST_PAUSE,
    CallRoutes,
    FoundGoal,
)
from fibaction_transports.nats.client.free_workers import RoomFinder
from fibaction_transports.nats.client.statuses import AllStatuses
from fibaction_transports.nats.client.worker_connections import WorkerConnections
from fibaction_transports.nats.workers import FleetWorkers


class FleetParts:
    """The parts of a connection to a fleet, which all its endpoints share."""

    def __init__(
        self,
        workers: FleetWorkers,
        connections: WorkerConnections,
        routes: CallRoutes,
        places: RoomFinder,
        statuses: AllStatuses,
        max_record: int,
    ) -> None:
        self.workers = workers
        self.connections = connections
        self.routes = routes
        self.places = places
        self.statuses = statuses
        self.max_record = max_record


class RetryTime:
    """The time that a call has, from its first failure, to find a worker."""

    def __init__(self, routes: CallRoutes) -> None:
        self._routes = routes
        self._ends: float | None = None
        self._pause = FIRST_PAUSE

    async def wait(self, error: ActionError) -> None:
        """Wait before the next try; raise the error if the time is over."""
        if self._ends is None:
            self._ends = current_time() + self._routes.patience
        left = self._ends - current_time()
        if left <= 0:
            raise error
        await self._routes.changes(min(self._pause, left))
        self._pause = min(2 * self._pause, LONGEST_PAUSE)


class Placement:
    """One goal that is to be sent, and the workers that it was sent to."""

    def __init__(self, parts: FleetParts, action: str) -> None:
        self._parts = parts
        self._action = action
        self._refused: set[str] = set()
        self.patience = RetryTime(parts.routes)
        self.owner = ""
        """The worker that has the goal by its record; empty if it may go to any."""
        self.worker = ""
        """The worker that it was sent to last; empty if there was no place for it."""

    def is_decided_by(self, error: ActionError) -> bool:
        """Return whether an error of a worker is the answer, so that no other one is asked."""
        if not self.worker:
            return False
        if isinstance(error, GoalRejected) and (self.owner or not error.is_busy):
            return True
        is_kept = self._parts.workers.is_kept(self.worker, self._action)
        if not (is_kept or isinstance(error, GoalRejected)):
            return True  # no record tells whether a gateway has the goal
        if self.owner or isinstance(error, ConnectionLost):
            return False
        self._refused.add(self.worker)
        serving = self._parts.workers.serving(self._action)
        return self._refused.issuperset(lease.worker for lease in serving)

    def goes_to(self, found: FoundGoal | None) -> bool:
        """Go to the owner of the goal next, or to any worker if it has none; return whether that
        can be at once.
        """
        before = self.owner
        self.owner = found.goal.worker if found is not None and found.is_alive else ""
        self.worker = ""
        return bool(self.owner) and self.owner != before
