"""`FleetConnection`: the client's half of a fleet.

Theory of operation
-------------------

A client of a fleet has one connection to the brokers, and over it a wire connection to each worker
that has goals of it. Its parts know each other in one direction only:

- `FleetWorkers` knows which workers are alive, from their leases.
- `WorkerConnections` has the wire connections, with one session for all of them.
- `RoomFinder` finds a worker that has room for a new goal.
- `CallRoutes` reads records, and leads goals to their owners when they are lost.
- `AllStatuses` follows the statuses of all goals, from their records.
- `FleetHistory` reads the goals of the past.
- `FleetEndpoint` turns the methods of an `Endpoint` into calls at workers.

The goals that were given up are listed from their records, and run again as new ones.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from anyio.abc import TaskGroup

from fibaction.border.abc import Connection, Endpoint
from fibaction.border.event_loop import Background, Slices
from fibaction.border.goal_store import StoredGoal
from fibaction.types.action import Action, ActionInfo
from fibaction.wire.messages import AskPeers, Peers
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import ConnectionLost, StoreError
from fibaction.words.goals import ActionPeers, GoalID, WorkerInfo
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, PutError, PutFailure
from fibaction_transports.nats.client.call_routes import CallRoutes
from fibaction_transports.nats.client.endpoint import FleetEndpoint, FleetParts
from fibaction_transports.nats.client.free_workers import RoomFinder
from fibaction_transports.nats.client.statuses import AllStatuses
from fibaction_transports.nats.client.worker_connections import Lines
from fibaction_transports.nats.history.fleet_history import FleetHistory
from fibaction_transports.nats.names import FleetNames, action_of
from fibaction_transports.nats.records import NONCE_SIZE, GoalEntry, encode, goal_entry
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.workers import FleetWorkers

ROOM_TO_GROW = 512
"""Bytes that are added to the record of a goal that is to run again: see `record_writes`."""
SECOND = 1_000_000_000
LISTING = 5.0
"""Seconds that the first list of the workers may take, at least."""


class FleetConnection(Connection):
    """A connection to all workers of a fleet."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        lines: Lines,
        settings: ClientSettings,
        tasks: TaskGroup,
    ) -> None:
        self._workers = FleetWorkers(broker, names, tasks, LISTING)
        self._routes = CallRoutes(broker, names, self._workers, lines, settings, tasks)
        self._connections = self._routes.connections
        self._statuses = AllStatuses(broker, names, self._workers, self._connections, tasks)
        places = RoomFinder(
            broker, names, self._workers, tasks, max(self._routes.patience, LISTING)
        )
        self._parts = FleetParts(
            self._workers,
            self._connections,
            self._routes,
            places,
            self._statuses,
            partial(FleetHistory, broker, names),
            broker.max_record,
        )
        self._broker = broker
        self._names = names
        tasks.start_soon(self._connections.close_idle)

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return FleetEndpoint(self._parts, action.info if isinstance(action, Action) else action)

    async def actions(self) -> list[ActionInfo]:
        await self._workers.ready()
        return self._workers.actions()

    async def workers(self) -> list[WorkerInfo]:
        await self._workers.ready()
        return self._workers.infos()

    async def given_up(self) -> dict[str, list[StoredGoal]]:
        return await given_up_goals(self._broker, self._names)

    async def rerun(self, action: str, goal_id: GoalID) -> GoalID:
        return await rerun_goal(self._broker, self._names, action, goal_id)

    async def peers(self, action: str) -> ActionPeers:
        async def ask(worker: str) -> list[str]:
            calls = self._connections.calls_of(worker)
            answer: Peers = await calls.ask(lambda call_id: AskPeers(call_id, action), Peers)
            return answer.clients

        endpoint = FleetEndpoint(self._parts, ActionInfo(action))
        workers = await endpoint.workers()
        clients = {one for answer in await endpoint.of_all(workers, ask) for one in answer}
        return ActionPeers(tuple(workers), tuple(sorted(clients)))

    async def leave(self) -> None:
        """Say goodbye to all workers, and end all calls."""
        self._workers.close()
        self._routes.close()
        self._statuses.fail(ConnectionLost("the connection to the fleet was closed here"))
        await self._connections.leave()


@asynccontextmanager
async def open_fleet(
    broker: Broker, names: FleetNames, settings: FleetSettings
) -> AsyncGenerator[FleetConnection, None]:
    """Open a connection to a fleet for as long as the block lasts."""
    from fibaction_transports.nats.lines import ClientLines

    lines = ClientLines(broker, names, max_frame=settings.max_frame)
    await lines.open()
    async with Background() as tasks:
        connection = FleetConnection(broker, names, lines, settings, tasks)
        try:
            yield connection
        finally:
            await connection.leave()


async def given_up_goals(broker: Broker, names: FleetNames) -> dict[str, list[StoredGoal]]:
    """Return the goals of a fleet that were given up, by their actions, in the order of their ends.

    Raises:
        ConnectionLost: The brokers do not answer.
    """
    found: dict[str, list[StoredGoal]] = {}
    slices = Slices()
    try:
        async with broker.watch(names.goals, names.all_goals()) as watch:
            while (records := await watch.next()) is not None:
                for record in records:
                    goal = goal_entry(record.data).goal if record.data else None
                    if goal is not None and goal.is_given_up:
                        found.setdefault(action_of(record.subject), []).append(goal)
                    await slices.pause()
    except BrokerAway as exc:
        raise ConnectionLost(f"the goals of the fleet cannot be listed: {exc}") from exc
    for goals in found.values():
        goals.sort(key=lambda goal: goal.ended_at)
    return found


async def rerun_goal(broker: Broker, names: FleetNames, action: str, goal_id: GoalID) -> GoalID:
    """Store a new goal for one that was given up, and return its ID. A worker takes it, and
    runs it from the checkpoint of the old one, of which only the outcome is kept.

    Raises:
        StoreError: The goal was not given up, runs again already, or cannot be stored.
        ConnectionLost: The brokers do not answer.
    """
    subject = names.goal(action, goal_id)
    try:
        record = await broker.get(names.goals, subject)
    except BrokerAway as exc:
        raise ConnectionLost(f"the record of goal {goal_id} cannot be read: {exc}") from exc
    entry = goal_entry(record.data) if record is not None and record.data else None
    if record is None or entry is None or not entry.goal.is_given_up:
        raise StoreError(f"goal {goal_id} was not given up, or is not kept any more")
    new = entry.goal.as_new(time.time_ns())
    nonce = secrets.token_bytes(NONCE_SIZE) + bytes(ROOM_TO_GROW)
    to_run = names.goal(action, new.goal_id)
    stored = await _put(broker, to_run, GoalEntry(new, b"", nonce), 0)
    if isinstance(stored, PutError):
        if stored.kind is PutFailure.REFUSED:
            raise StoreError(f"goal {goal_id} runs again already, as goal {new.goal_id}")
        raise StoreError(f"goal {goal_id} cannot be run again: {stored.text}")
    broker.add_note(names.left(action), bytes(new.goal_id))
    entry.goal.drop_request()
    await _put(broker, subject, entry, record.sequence)
    return new.goal_id


async def _put(broker: Broker, subject: str, entry: GoalEntry, expected: int) -> int | PutError:
    """Store a record, and return the answer."""
    goal = entry.goal
    ttl = max(1.0, (goal.keep_until - time.time_ns()) / SECOND) if goal.keep_until else None
    return await broker.put_and_wait(subject, encode(entry), expected=expected, ttl=ttl)
