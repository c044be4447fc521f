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

"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from anyio.abc import TaskGroup

from fibaction.border.abc import Connection, Endpoint
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import StoredGoal
from fibaction.types.action import Action, ActionInfo
from fibaction.wire.messages import AskPeers, Peers
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import ConnectionLost
from fibaction.words.goals import ActionPeers, GoalID, WorkerInfo
from fibaction_transports.nats.broker.broker import Broker
from fibaction_transports.nats.client.call_routes import CallRoutes
from fibaction_transports.nats.client.endpoint import FleetEndpoint, FleetParts
from fibaction_transports.nats.client.free_workers import RoomFinder
from fibaction_transports.nats.client.statuses import AllStatuses
from fibaction_transports.nats.client.worker_connections import Lines
from fibaction_transports.nats.fleet_history import FleetHistory, given_up_goals, rerun_goal
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.workers import FleetWorkers

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
