"""The statuses of all goals of an action of a fleet, from their records.

Theory of operation
-------------------

All followers of an action in this process share one watch of the records, since a broker has to
serve each watch. The first follower opens it, and the last one that leaves closes it. Each follower
is a `StatusSubscription`, with a queue of its own.

A follower that comes later must know all that has happened before it came, and the watch may be
late. So the records are listed once more for it, and what is newer than what the watch has told is
taken from there: a record has a sequence, and is taken once.

A broker tells the newest record only, so a status may be overwritten before it was told. The
statuses in between are filled in. A record that is forgotten, or has expired, is told as UNKNOWN.

Goals of workers without records (gateways) are followed at these workers, over their connections.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractAsyncContextManager

import anyio
from anyio import CancelScope
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.wire.client.remote_statuses import RemoteStatuses
from fibaction.wire.messages import AskPlaces
from fibaction.wire.messages import Places as PlacesAnswer
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
)
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerRecord, BrokerWatch
from fibaction_transports.nats.client.worker_connections import WorkerConnections
from fibaction_transports.nats.names import FleetNames, last_token
from fibaction_transports.nats.records import GoalEntry, goal_entry
from fibaction_transports.nats.workers import WATCH_PAUSE, FleetWorkers

MOST_PLACES = 10_000
"""Goals whose places one worker is asked for, at most."""
PLACES_TIMEOUT = 2.0
"""Seconds that a list waits for the places of goals at one worker."""

logger = clean_logger("fibaction.nats")


class AllStatuses:
    """The statuses that one client follows, by action."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        workers: FleetWorkers,
        connections: WorkerConnections,
        tasks: TaskGroup,
    ) -> None:
        self.broker = broker
        self.names = names
        self.workers = workers
        self.connections = connections
        self.tasks = tasks
        self._watched: dict[str, FleetStatuses] = {}

    async def follow(self, action: str) -> StatusSubscription:
        """Follow the statuses of all goals of an action.

        Raises:
            ServerNotFound: The action is not served, and no goal of it is known.
            ConnectionLost: The brokers do not answer.
        """
        await self.workers.ready()
        watched = self._watched.get(action)
        if watched is None or watched.is_closed:
            watched = self._watched[action] = FleetStatuses(self, action)
        return await watched.follow()

    def fail(self, error: ActionError) -> None:
        """End all statuses with an error."""
        for watched in self._watched.values():
            watched.fail(error)


class FleetStatuses:
    """The statuses of all goals of one action, for all who follow them here."""

    def __init__(self, shared: AllStatuses, action: str) -> None:
        self._shared = shared
        self._action = action
        self._followers: dict[StatusSubscription, None] = {}
        self._expected = 0  # followers that are being made
        self._goals: dict[GoalID, GoalInfo] = {}
        self._owners: dict[GoalID, tuple[str, bytes]] = {}  # worker and incarnation
        self._sequences: dict[str, int] = {}  # of the record of each subject
        self._listed: set[str] | None = None  # the subjects that were told since the last list
        self._is_ready = False
        self._is_running = False
        self._gateways: dict[str, RemoteStatuses] = {}
        self._ready = Notifier()
        self._scope = CancelScope()
        self.is_closed = False
        """True after the last follower has left."""

    async def follow(self) -> StatusSubscription:
        """Return a new follower, which begins with all goals that are known now.

        Raises:
            ServerNotFound, ConnectionLost: As for `AllStatuses.follow`.
        """
        self._expected += 1
        try:
            if not self._is_running:
                self._is_running = True
                self._shared.tasks.start_soon(self._run)
                await self._wait_until_ready()
            else:
                await self._wait_until_ready()
                await self._list_once()
            for lease in self._shared.workers.serving(self._action, is_kept=False):
                await self._follow_gateway(lease.worker)
            if not (self._goals or self._shared.workers.serving(self._action)):
                raise self._shared.workers.not_served(self._action)
            await self._learn_places()
            statuses = StatusSubscription(self._in_order(), self.leave)
            self._followers[statuses] = None
            return statuses
        finally:
            self._expected -= 1
            self._close_if_unused()

    def leave(self, statuses: StatusSubscription) -> None:
        """Remove a follower; the last one closes the watch."""
        self._followers.pop(statuses, None)
        self._close_if_unused()

    def fail(self, error: ActionError) -> None:
        """End all followers with an error."""
        for statuses in tuple(self._followers):
            statuses.fail(error)

    def _close_if_unused(self) -> None:
        if not (self._followers or self._expected):
            self.is_closed = True
            self._scope.cancel()
            for statuses in tuple(self._gateways.values()):
                statuses.close()

    def _in_order(self) -> list[GoalInfo]:
        """Return the goals: those that have ended, in that order, then the active ones."""
        goals = self._goals.values()
        active = [self._with_worker(info) for info in goals if info.status.is_active]
        ended = [info for info in goals if not info.status.is_active]
        return [*ended, *sorted(active, key=lambda info: info.stamp)]

    def _with_worker(self, info: GoalInfo) -> GoalInfo:
        """Return an active goal with whether a living worker has it."""
        owner = self._owners.get(info.goal_id)  # a gateway has no records
        has_worker = owner is None or self._shared.workers.has(*owner)
        return info if has_worker else replace(info, has_worker=False)

    # The watch

    async def _run(self) -> None:
        with self._scope:
            while True:
                try:
                    async with self._watched() as watch:
                        await self._read(watch)
                except BrokerAway as exc:
                    logger.debug("the records of %s cannot be watched: %s", self._action, exc)
                    await anyio.sleep(WATCH_PAUSE)

    def _watched(self) -> AbstractAsyncContextManager[BrokerWatch]:
        names = self._shared.names
        return self._shared.broker.watch(names.goals, names.goal(self._action))

    async def _read(self, watch: BrokerWatch) -> None:
        while True:
            records = await watch.next()
            if records is not None:
                self._take_all(records)
                continue
            if self._listed is not None:
                self._forget_unlisted(self._listed)
            self._listed = set()
            if not self._is_ready:
                self._is_ready = True
                self._ready.notify()

    async def _wait_until_ready(self) -> None:
        with anyio.move_on_after(self._shared.workers.timeout):
            while not self._is_ready:
                await self._ready.wait()
            return
        raise ConnectionLost("the brokers have not told the goals of the fleet in time")

    async def _list_once(self) -> None:
        """Take what is newer than what the watch has told so far."""
        try:
            async with self._watched() as watch:
                while (records := await watch.next()) is not None:
                    self._take_all(records)
        except BrokerAway as exc:
            raise ConnectionLost(f"the goals of the fleet cannot be listed: {exc}") from exc

    def _forget_unlisted(self, listed: set[str]) -> None:
        """Forget the goals whose records have gone while the watch was interrupted."""
        for subject in tuple(self._sequences):
            if subject not in listed:
                self._forget(subject)

    def _take_all(self, records: Iterable[BrokerRecord]) -> None:
        if not self._is_ready:
            records = sorted(records, key=lambda record: record.sequence)
        for record in records:
            if self._listed is not None:
                self._listed.add(record.subject)
            if record.sequence > self._sequences.get(record.subject, 0):
                self._take(record)

    def _take(self, record: BrokerRecord) -> None:
        if not record.data:
            self._forget(record.subject)
            return
        try:
            entry: GoalEntry = goal_entry(record.data)
        except ProtocolError as exc:
            logger.warning("%s: %s", record.subject, exc)
            return
        self._sequences[record.subject] = record.sequence
        goal = entry.goal
        info = goal.info
        self._owners[goal.goal_id] = goal.worker, entry.incarnation
        before = self._goals.get(goal.goal_id)
        if not self._is_ready:
            self._learn(info)
            return
        status = None if before is None else before.status
        for step in steps(status, info.status, has_begun=goal.attempt > 0):
            is_last = step is info.status
            self._put(info if is_last else replace(info, status=step, ended_at=None, reason=""))

    def _forget(self, subject: str) -> None:
        self._sequences.pop(subject, None)
        goal_id = GoalID.parse(last_token(subject))
        self._owners.pop(goal_id, None)
        info = self._goals.get(goal_id)
        if info is not None:
            self._put(replace(info, status=GoalStatus.UNKNOWN))

    def _put(self, info: GoalInfo) -> None:
        self._learn(info)
        for statuses in tuple(self._followers):
            statuses.put(info)

    def _learn(self, info: GoalInfo) -> None:
        if not info.status.is_active:
            self._goals.pop(info.goal_id, None)
        if info.status is not GoalStatus.UNKNOWN:
            self._goals[info.goal_id] = info

    # Places of goals that wait

    async def _learn_places(self) -> None:
        """Ask the workers of the goals that wait for their places."""
        waiting = {
            self._owners[info.goal_id][0]
            for info in self._goals.values()
            if info.status is GoalStatus.ACCEPTED and info.goal_id in self._owners
        }
        async with anyio.create_task_group() as tasks:
            for worker in waiting:
                if self._shared.workers.get(worker) is not None:
                    tasks.start_soon(self._learn_places_of, worker)

    async def _learn_places_of(self, worker: str) -> None:
        calls = self._shared.connections.calls_of(worker)
        with anyio.move_on_after(PLACES_TIMEOUT):
            try:
                answer: PlacesAnswer = await calls.ask(
                    lambda call_id: AskPlaces(call_id, self._action, MOST_PLACES), PlacesAnswer
                )
            except ActionError as exc:
                logger.debug("the places of goals at %s are not known: %s", worker, exc)
                return
            for goal_id, place, length in answer.goals:
                info = self._goals.get(GoalID(goal_id))
                if info is not None and info.status is GoalStatus.ACCEPTED:
                    self._goals[info.goal_id] = replace(info, place=place, queue_length=length)

    # Gateways

    async def _follow_gateway(self, worker: str) -> None:
        """Follow the goals of a worker that has no records, if they are not followed yet."""
        if worker in self._gateways:
            return
        calls = self._shared.connections.calls_of(worker)
        statuses = await calls.follow_statuses(self._action)
        for info in await statuses.listed():
            self._put(info)
        self._gateways[worker] = statuses
        self._shared.tasks.start_soon(self._read_gateway, worker, statuses)

    async def _read_gateway(self, worker: str, statuses: RemoteStatuses) -> None:
        with statuses:
            try:
                while (info := await statuses.receive()) is not None:
                    self._put(info)
            except ActionError as exc:
                logger.debug("the goals at %s are lost: %s", worker, exc)
        self._gateways.pop(worker, None)


def steps(before: GoalStatus | None, after: GoalStatus, *, has_begun: bool) -> Iterator[GoalStatus]:
    """Yield the statuses of a goal after one that was told, or after none, up to another."""
    if before is None:
        before = GoalStatus.ACCEPTED
        yield before
    if after <= before:
        return  # it was told by another way
    needs_begin = has_begun or after in (GoalStatus.SUCCEEDED, GoalStatus.ABORTED)
    if before < GoalStatus.EXECUTING < after and needs_begin:
        yield GoalStatus.EXECUTING
    if before < GoalStatus.CANCELING and after is GoalStatus.CANCELED:
        yield GoalStatus.CANCELING
    yield after
