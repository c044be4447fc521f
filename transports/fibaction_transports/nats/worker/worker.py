"""`Worker`: one member of a fleet, which serves actions and keeps their goals at the brokers.

Its parts get each other by their constructors, in this order: the journals, which all others know;
the leases of other workers; what takes goals over; what repairs streams; the limits; the store for
the servers; and the offers to clients. What a part has to do when the worker is fenced, or joins
again, is in that part (`MemberPart`).
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import AsyncExitStack, asynccontextmanager

from anyio import CancelScope
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Endpoint
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import GoalStore, KeyPlaces, StoredGoal, no_obstacle
from fibaction.border.peer_text import excerpt
from fibaction.wire.wire_server import open_server
from fibaction.words.errors import ConnectionLost, StoreError, TransportError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerAway
from fibaction_transports.nats.lines import WorkerLines
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import LeaseEntry, ServedAction
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.fleet_limits import FleetLimits
from fibaction_transports.nats.worker.journal import FleetJournal, WorkerJournals
from fibaction_transports.nats.worker.lease import MemberPart, Membership
from fibaction_transports.nats.worker.lease_thread import OpenBroker, lease_thread
from fibaction_transports.nats.worker.lost_streams import LostStreams
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.worker.offers import Offers
from fibaction_transports.nats.worker.takeover import Takeover
from fibaction_transports.nats.workers import FleetWorkers


class FleetStore(GoalStore):
    """The store of one worker: the goals of all its servers, kept by the brokers."""

    tells_statuses = True

    def __init__(
        self,
        journals: WorkerJournals,
        takeover: Takeover,
        places: Callable[[str, int], Awaitable[KeyPlaces]],
        make_keys: Callable[[], Awaitable[None]],
    ) -> None:
        """Take the function for `GoalJournal.key_places`, and the one that makes their stream."""
        self._make_keys = make_keys
        self._journals = journals
        self._takeover = takeover
        self._places = places

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
        """See `GoalStore.open`. Goals are claimed from when the block begins, and those that are
        left after it are released.

        Raises:
            StoreError: It is open already.
        """
        journals = self._journals
        if action in journals.by_action:
            raise StoreError(f"this worker serves the action {excerpt(action)!r} already")
        journal = FleetJournal(
            journals, action, max_results, claim, lose, obstacle, self._places, self._make_keys
        )
        journals.by_action[action] = journal
        try:
            async with Background() as tasks:
                self._takeover.start(journal, tasks, ends_unreadable=ends_unreadable)
                yield journal
        finally:
            with CancelScope(shield=True):
                await journal.release_rest()
                await journals.history.settle()
            journals.has_goals_left = journals.has_goals_left or len(journal) > 0
            del journals.by_action[action]
            journals.room.notify()


class Worker(MemberPart):
    """A worker that has joined its fleet."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        settings: FleetSettings,
        membership: Membership,
        tasks: TaskGroup,
    ) -> None:
        """Work in the background, in these tasks."""
        self._broker = broker
        self._names = names
        self._settings = settings
        self._membership = membership
        self._journals = WorkerJournals(broker, names, membership, tasks)
        workers = FleetWorkers(broker, names, tasks, membership.lease)
        lost = LostWorkers(broker, names, membership, workers)
        self._takeover = Takeover(self._journals, workers, lost)
        self._streams = LostStreams(self._journals, self._takeover, settings.replicas)
        limits = FleetLimits(
            broker,
            names,
            membership,
            workers,
            tasks,
            has_ended=lost.has_ended,
            open_stream=self._streams.open_keys,
        )
        self.store = FleetStore(
            self._journals, self._takeover, limits.places, self._streams.make_keys
        )
        """The store for the servers of this worker."""
        self._offers = Offers(self._journals)
        self._served: tuple[ServedAction, ...] = ()
        membership.add(self)

    @property
    def name(self) -> str:
        """The name of the worker."""
        return self._membership.worker

    @property
    def has_goals_left(self) -> bool:
        """True if a server has stopped whose goals could not be released."""
        return self._journals.has_goals_left

    async def start(self) -> None:
        """Stay in the fleet, and take goals over.

        Raises:
            TransportError: The brokers do not answer.
        """
        tasks = self._journals.tasks
        tasks.start_soon(self._membership.run, name="lease of the worker")
        tasks.start_soon(self._membership.fence_in_time, name="fence of the worker")
        try:
            await self._takeover.open()
            await self._streams.open()
            if self._settings.history is not None:
                await self._streams.open_history(self._settings.history)
                self._journals.history.open(tasks, self._membership.lease)
        except (BrokerAway, ConnectionLost) as exc:
            raise TransportError(f"cannot join the fleet: {exc}") from exc
        tasks.start_soon(self._streams.run, name="streams of the fleet")

    @asynccontextmanager
    async def serve(self, endpoints: Iterable[Endpoint]) -> AsyncGenerator[None, None]:
        """Serve these endpoints to the clients of the fleet for as long as the block lasts.

        Raises:
            TransportError: The brokers do not answer.
        """
        mapping = {endpoint.info.name: endpoint for endpoint in endpoints}
        async with AsyncExitStack() as stack:
            server = await stack.enter_async_context(open_server(mapping, self._settings))
            lines = WorkerLines(
                self._broker, self._names, self.name, server.new_reader, server.start
            )
            try:
                await lines.open()
            except BrokerAway as exc:
                raise TransportError(f"cannot serve in the fleet: {exc}") from exc
            stack.callback(lines.close)
            stack.push_async_callback(server.drain)  # while the lines are open
            kept = self._journals.by_action
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

    def describe(self, entry: LeaseEntry) -> None:
        """See `MemberPart.describe`."""
        unreadable = self._journals.unreadable
        entry.actions = tuple(
            replace(one, unreadable=unreadable.get(one.info.name, 0)) for one in self._served
        )


@asynccontextmanager
async def open_worker(
    broker: Broker,
    names: FleetNames,
    settings: FleetSettings,
    open_broker: OpenBroker | None = None,
) -> AsyncGenerator[Worker, None]:
    """Join a fleet for as long as the block lasts. The streams are there, and the settings name
    the worker and its lease. With `open_broker`, executors may block the event loop for longer.

    Raises:
        TransportError: The name of the worker is in use, or the brokers do not answer.
    """
    membership = Membership(broker, names, settings.worker, settings.lease)
    await membership.join()
    worker: Worker | None = None
    try:
        async with AsyncExitStack() as stack:
            tasks = await stack.enter_async_context(Background())
            worker = Worker(broker, names, settings, membership, tasks)
            await worker.start()
            if open_broker is not None:
                await stack.enter_async_context(lease_thread(membership, open_broker))
            yield worker
    finally:
        with CancelScope(shield=True):
            await membership.leave(is_clean=worker is None or not worker.has_goals_left)
