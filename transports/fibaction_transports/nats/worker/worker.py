"""`Worker`: one member of a fleet, which serves actions and keeps their goals at the brokers."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager

from anyio import CancelScope
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Endpoint
from fibaction.border.event_loop import Background
from fibaction.wire.wire_server import open_server
from fibaction.words.errors import ConnectionLost, TransportError
from fibaction_transports.nats.broker.broker import Broker, BrokerAway
from fibaction_transports.nats.lines.line import WorkerLines
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import LeaseEntry, ServedAction
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.lease import Membership
from fibaction_transports.nats.worker.limits.fleet_limits import FleetLimits
from fibaction_transports.nats.worker.lost_streams import LostStreams
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.worker.offers import Offers
from fibaction_transports.nats.worker.store import FleetStore
from fibaction_transports.nats.worker.takeover import Takeover
from fibaction_transports.nats.workers import FleetWorkers


class Worker:
    """A worker that has joined its fleet."""

    def __init__(
        self, broker: Broker, names: FleetNames, settings: FleetSettings, membership: Membership
    ) -> None:
        self._broker = broker
        self._names = names
        self._settings = settings
        self._membership = membership
        self.store = FleetStore(broker, names, membership)
        """The store for the servers of this worker."""
        self._offers = Offers(broker, names, membership, self.store)
        self._served: tuple[ServedAction, ...] = ()
        self._takeover: Takeover
        membership.describe = self._describe
        membership.on_join = self._joined
        membership.on_fence = self._fenced
        self.store.on_room = self._room_changed

    @property
    def name(self) -> str:
        """The name of the worker."""
        return self._membership.worker

    async def open(self, tasks: TaskGroup) -> None:
        """Start the work in the background, in these tasks.

        Raises:
            TransportError: The brokers do not answer.
        """
        self.store.tasks = tasks
        tasks.start_soon(self._membership.run, name="lease of the worker")
        tasks.start_soon(self._membership.fence_in_time, name="fence of the worker")
        lease = self._membership.lease
        workers = FleetWorkers(self._broker, self._names, tasks, lease)
        self._takeover = Takeover(self._broker, self._names, self.store, self._membership, workers)
        streams = LostStreams(
            self._broker,
            self._names,
            self._settings.replicas,
            self._membership,
            self.store,
            self._takeover,
        )
        lost = LostWorkers(self._broker, self._names, self._membership, workers)
        self.store.limits = FleetLimits(
            self._broker,
            self._names,
            self._membership,
            workers,
            tasks,
            has_ended=lost.has_ended,
            open_stream=streams.open_keys,
        )
        try:
            await self._takeover.open()
            await streams.open()
        except (BrokerAway, ConnectionLost) as exc:
            raise TransportError(f"cannot join the fleet: {exc}") from exc
        tasks.start_soon(streams.run, name="streams of the fleet")

    @asynccontextmanager
    async def serve(self, endpoints: Iterable[Endpoint]) -> AsyncGenerator[None, None]:
        """Serve these endpoints to the clients of the fleet for as long as the block lasts.

        Raises:
            TransportError: The brokers do not answer.
        """
        mapping = {endpoint.info.name: endpoint for endpoint in endpoints}
        async with AsyncExitStack() as stack:
            server = await stack.enter_async_context(open_server(mapping, self._settings.server))
            lines = WorkerLines(
                self._broker, self._names, self.name, server.new_reader, server.start
            )
            try:
                await lines.open()
            except BrokerAway as exc:
                raise TransportError(f"cannot serve in the fleet: {exc}") from exc
            stack.callback(lines.close)
            stack.push_async_callback(server.drain)  # while the lines are open
            kept = self.store.journals
            self._served = tuple(
                ServedAction(endpoint.info, name in kept) for name, endpoint in mapping.items()
            )
            tasks = await stack.enter_async_context(Background())
            stack.callback(self._serve_nothing)
            for name in mapping:
                tasks.start_soon(self._offers.run, name)
            await self._offers.ready()
            await self._membership.update()
            yield

    def _serve_nothing(self) -> None:
        self._served = ()
        self._membership.note_change()

    def _describe(self, entry: LeaseEntry) -> None:
        unreadable = self.store.unreadable
        entry.actions = tuple(
            replace(one, unreadable=unreadable.get(one.info.name, 0)) for one in self._served
        )
        entry.goals = len(self.store)
        entry.has_room = self._offers.has_room

    def _room_changed(self) -> None:
        self._offers.note_room()
        self._takeover.room.notify()

    def _fenced(self) -> None:
        self.store.lose_all()
        self._room_changed()

    def _joined(self) -> None:
        self._room_changed()
        self._takeover.rescan.notify()
        self.store.limits.look_at_all()


@asynccontextmanager
async def open_worker(
    broker: Broker, names: FleetNames, settings: FleetSettings
) -> AsyncGenerator[Worker, None]:
    """Join a fleet for as long as the block lasts. The streams are there, and the settings name
    the worker and its lease.

    Raises:
        TransportError: The name of the worker is in use, or the brokers do not answer.
    """
    membership = Membership(broker, names, settings.worker, settings.lease)
    await membership.join()
    worker = Worker(broker, names, settings, membership)
    try:
        async with Background() as tasks:
            await worker.open(tasks)
            yield worker
    finally:
        with CancelScope(shield=True):
            await membership.leave(is_clean=not worker.store.has_goals_left)
