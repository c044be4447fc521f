"""`CallRoutes`: the way of a goal from a worker that has lost it to the one that has it now.

Theory of operation
-------------------

A client follows a goal on the line to its owner. The goal is lost there if the lease of the worker
has ended, if the worker says that another one has taken the goal, or if the line does not come back
in time. A line that only flickers does not lose it: the connection continues with it on the next
one.

A lost goal waits here, and its record is read, again and again, until one of these is true:

- Its owner is alive. The connection to that worker adopts the goal, and follows it from the last
  feedback that has arrived. This is so if the goal has ended, too: its last feedback is there.
- It has ended, and its owner is gone. It is finished by its record, and the feedback that has not
  arrived counts as lost.
- There is no record any more: its outcome is unknown. In a new stream the record may come yet.
- `reconnect_timeout` seconds have passed since the line was lost: `ConnectionLost`.

A worker that has just come to own a goal may not know it yet, and the former one may not know that
it was lost. So a goal that is lost again before its owner has continued with it waits, longer each
time, before the next look.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import NamedTuple, TypeVar

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import StoredGoal
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.messages import Follow, Following, SendGoal
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.words.goals import UNKNOWN_OUTCOME, GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerAway
from fibaction_transports.nats.client.worker_connections import Lines, WorkerConnections
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import GoalEntry, goal_entry
from fibaction_transports.nats.workers import FleetWorkers

T = TypeVar("T")

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 1.0
"""Seconds between two looks at a record: short at first, for a takeover that is under way."""
RECORDS_READ_AT_ONCE = 32
"""Records that are read at the same time: a lost worker may have had very many goals."""

logger = clean_logger("fibaction.nats")


class FoundGoal(NamedTuple):
    """A goal that has a record."""

    goal: StoredGoal
    is_alive: bool
    """True if the worker that owns it has a lease."""


class CallRoutes:
    """Finds goals, and leads lost ones to their owners."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        workers: FleetWorkers,
        lines: Lines,
        settings: ClientSettings,
        tasks: TaskGroup,
    ) -> None:
        self._broker = broker
        self._names = names
        self._workers = workers
        self.connections = WorkerConnections(lines, settings, tasks, self.lose)
        """The connections to the workers, which give lost goals back to the routes."""
        self._tasks = tasks
        self.patience = settings.reconnect_timeout if settings.reconnect else 0.0
        """Seconds that a call waits for a worker that has its goal."""
        self._looks = anyio.CapacityLimiter(RECORDS_READ_AT_ONCE)
        self._lost: dict[RemoteGoal, ActionError] = {}
        self._is_closed = False
        workers.when_gone(self.connections.end)

    async def find(self, action: str, goal_id: GoalID) -> FoundGoal | None:
        """Return the goal as its record tells it; None if it has none.

        Raises:
            ConnectionLost: The brokers do not answer.
        """
        await self._workers.ready()
        try:
            async with self._looks:
                record = await self._broker.get(
                    self._names.goals, self._names.goal(action, goal_id)
                )
        except BrokerAway as exc:
            raise ConnectionLost(f"the record of goal {goal_id} cannot be read: {exc}") from exc
        if record is None or not record.data:
            return None
        entry: GoalEntry = goal_entry(record.data)
        return FoundGoal(entry.goal, self._workers.has(entry.goal.worker, entry.incarnation))

    async def active(self, action: str) -> list[FoundGoal]:
        """Return the active goals of an action that have records, also those without an owner.

        Raises:
            ConnectionLost: The brokers do not answer.
        """
        found: list[FoundGoal] = []
        names, slices = self._names, Slices()
        try:
            async with self._broker.watch(names.goals, names.goal(action)) as watch:
                while (records := await watch.next()) is not None:
                    for record in records:
                        with suppress(ProtocolError):  # it is of another version
                            entry = goal_entry(record.data) if record.data else None
                            if entry is not None and entry.goal.status.is_active:
                                owner = entry.goal.worker, entry.incarnation
                                found.append(FoundGoal(entry.goal, self._workers.has(*owner)))
                        await slices.pause()
        except BrokerAway as exc:
            raise ConnectionLost(f"the goals of the fleet cannot be listed: {exc}") from exc
        return found

    async def changes(self, pause: float) -> None:
        """Wait until a worker comes or goes, for `pause` seconds at most."""
        with anyio.move_on_after(pause):
            await self._workers.news.wait()

    def lose(self, goal: RemoteGoal, error: ActionError, since: float | None) -> None:
        """Lead a goal to its owner that its connection cannot continue with, or could not since
        that time.
        """
        if self._is_closed:
            goal.fail(error)
        else:
            is_again = goal.lost_at is not None
            if goal.lost_at is None:
                goal.lost_at = current_time() if since is None else since
            self._lost[goal] = error
            self._tasks.start_soon(self._route, goal, goal.lost_at, is_again)

    def close(self) -> None:
        """End the goals that are lost now, or later."""
        self._is_closed = True
        lost, self._lost = self._lost, {}
        for goal, error in lost.items():
            goal.fail(error)

    async def _route(self, goal: RemoteGoal, lost_at: float, is_again: bool) -> None:
        gives_up = lost_at + self.patience
        pause = FIRST_PAUSE
        if is_again:
            pause = min(max(current_time() - lost_at, FIRST_PAUSE), LONGEST_PAUSE)
            await self.changes(pause)
        while goal in self._lost:
            is_over = is_again and current_time() >= gives_up
            if await self._is_routed(goal, is_over=is_over):
                self._lost.pop(goal, None)
                return
            if current_time() >= gives_up:
                error = self._lost.pop(goal)
                goal.fail(
                    ConnectionLost(
                        f"no worker has gone on with goal {goal.goal_id} within"
                        f" {self.patience:g} s: {error}"
                    )
                )
                return
            await self.changes(min(pause, max(gives_up - current_time(), 0)))
            pause = min(2 * pause, LONGEST_PAUSE)

    async def _is_routed(self, goal: RemoteGoal, *, is_over: bool) -> bool:
        """Return whether a lost goal is with an owner that lives, or has ended.

        If its time is over, it goes to no owner any more.
        """
        try:
            found = await self.find(goal.action, goal.goal_id)
        except ConnectionLost as exc:
            logger.debug("%s", exc)
            return False
        except ProtocolError as exc:
            goal.fail(exc)
            return True
        if goal not in self._lost:
            return True
        if found is None and await self._may_be_written():
            return False
        if found is None:
            goal.finish(UNKNOWN_OUTCOME, 0, goal.newest_attempt)
        elif found.goal.ended_at and isinstance(self._lost[goal], UnknownGoal):
            finish(goal, found.goal)  # its owner has forgotten it
        elif found.is_alive and not is_over:
            self.connections.adopt(found.goal.worker, goal)
        elif found.goal.ended_at and not found.is_alive:
            finish(goal, found.goal)
        else:
            return False
        return True

    async def _may_be_written(self) -> bool:
        """Return whether a record that is missing may come yet: its stream was lost."""
        try:
            return await self._broker.is_new(self._names.goals, self._workers.longest_lease)
        except BrokerAway:
            return True


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

    async def retry(
        self, ask: Callable[[], Awaitable[T]], is_over: Callable[[], bool] = lambda: False
    ) -> T:
        """Return the answer to a request, which is made again after an error of a connection,
        unless `is_over` then.
        """
        while True:
            try:
                return await ask()
            except (ConnectionLost, ServerNotFound) as exc:
                if is_over():
                    raise
                await self.wait(exc)


def finish(goal: RemoteGoal, stored: StoredGoal) -> None:
    """End a goal by its record."""
    goal.told_info = stored.info
    goal.finish(stored.outcome, stored.feedback_count, max(stored.attempt, 1))


def ended_goal(opening: SendGoal | Follow, stored: StoredGoal) -> RemoteGoal:
    """Return a goal that has ended, and whose owner is gone or has forgotten it, by its record."""
    goal = RemoteGoal(stored.goal_id, opening, 1, lambda message: None, math.inf)
    place, attempt = stored.feedback_count, max(stored.attempt, 1)
    following = Following(opening.id, stored.stamp, stored.status, False, place, attempt)
    following.goal = stored.goal or None
    goal.on_message(following)
    finish(goal, stored)
    return goal


def gone(found: FoundGoal) -> ConnectionLost:
    """Return the error for a goal that no living worker has."""
    goal = found.goal
    former = (
        f"{excerpt(goal.worker)!r}, which had it, is gone" if goal.worker else "it was released"
    )
    return ConnectionLost(
        f"goal {goal.goal_id} has no worker: {former}, and no other one has taken it over; start a"
        f" worker that has room, and whose version can read the goal"
    )


def moving(found: FoundGoal) -> ConnectionLost:
    """Return the error for a goal that its owner does not know."""
    goal = found.goal
    return ConnectionLost(
        f"goal {goal.goal_id} is active, and worker {excerpt(goal.worker)!r}, which has it by its"
        f" record, has not begun to serve it yet; ask again"
    )
