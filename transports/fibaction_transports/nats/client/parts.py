"""`FleetParts`: the parts of a connection to a fleet, and how long a call tries to find a worker.

`RetryTime` limits the time, and `Placement` knows the workers that one goal was sent to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from anyio import current_time

from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError, ConnectionLost, GoalRejected, RejectionCode
from fibaction_transports.nats.client.call_routes import (
    FIRST_PAUSE,
    LONGEST_PAUSE,
    CallRoutes,
    FoundGoal,
)
from fibaction_transports.nats.client.free_workers import RoomFinder
from fibaction_transports.nats.client.statuses import AllStatuses
from fibaction_transports.nats.client.worker_connections import WorkerConnections
from fibaction_transports.nats.history.fleet_history import FleetHistory
from fibaction_transports.nats.records import LeaseEntry
from fibaction_transports.nats.workers import FleetWorkers

E = TypeVar("E", bound=ActionError)


class FleetParts:
    """The parts of a connection to a fleet, which all its endpoints share."""

    def __init__(
        self,
        workers: FleetWorkers,
        connections: WorkerConnections,
        routes: CallRoutes,
        places: RoomFinder,
        statuses: AllStatuses,
        history: Callable[[str], FleetHistory],
        max_record: int,
    ) -> None:
        self.workers = workers
        self.connections = connections
        self.routes = routes
        self.places = places
        self.statuses = statuses
        self.history = history
        """Returns the history of the action of a name."""
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
        self._types: list[dict[str, Any]] = []  # those of goals that do not fit this one
        self._rejections: list[GoalRejected] = []  # since then
        self._lost: list[str] = []  # the workers that did not answer
        self.patience = RetryTime(parts.routes)
        self.owner = ""
        """The worker that has the goal by its record; empty if it may go to any."""
        self.worker = ""
        """The worker that it was sent to last; empty if there was no place for it."""

    @property
    def reader(self) -> str:
        """The worker to go to after one that cannot read the goal, because its action has other
        types; empty if there is none.
        """
        if not self._types:
            return ""
        serving = self._parts.workers.serving(self._action)
        readers = [
            lease
            for lease in serving
            if lease.worker not in self._refused and self._type_at(lease) not in self._types
        ]
        readers.sort(key=lambda lease: (self._lost.count(lease.worker), not lease.has_room))
        return readers[0].worker if readers else ""

    def answer(self, error: ActionError) -> ActionError | None:
        """Return the answer by an error of a worker; None if another worker is to be asked."""
        if not self.worker:
            return None
        if isinstance(error, GoalRejected):
            return self._answer_by(error)
        if not self._parts.workers.is_kept(self.worker, self._action):
            return error  # no record tells whether a gateway has the goal
        if isinstance(error, ConnectionLost):
            self._lost.append(self.worker)
        if self.owner or isinstance(error, ConnectionLost):
            return None
        return self._next_or(error)

    def _answer_by(self, rejected: GoalRejected) -> GoalRejected | None:
        """Return the answer by a rejection: that of a worker that can read the goal, if any can."""
        is_unreadable = rejected.code is RejectionCode.UNREADABLE
        if self.owner or not (rejected.code.is_temporary or is_unreadable):
            return rejected
        lease = self._parts.workers.get(self.worker)
        if is_unreadable and lease is not None:
            self._types.append(self._type_at(lease))
        if not self._types:
            return self._next_or(rejected)
        self._refused.add(self.worker)
        self._rejections.append(rejected)
        if self.reader:
            return None
        return next((one for one in self._rejections if one.code.is_temporary), self._rejections[0])

    def _next_or(self, error: E) -> E | None:
        """Return None to ask another worker; the error if all of them were asked."""
        self._refused.add(self.worker)
        serving = self._parts.workers.serving(self._action)
        return error if self._refused.issuperset(lease.worker for lease in serving) else None

    def _type_at(self, lease: LeaseEntry) -> dict[str, Any]:
        """Return the type of goals at a worker, as a JSON Schema."""
        served = (one.info for one in lease.actions if one.info.name == self._action)
        return next(served, ActionInfo(self._action)).goal

    def goes_to(self, found: FoundGoal | None) -> bool:
        """Go to the owner of the goal next, or to any worker if it has none; return whether that
        can be at once.
        """
        before = self.owner
        self.owner = found.goal.worker if found is not None and found.is_alive else ""
        self.worker = ""
        return bool(self.owner) and self.owner != before
