"""`Worker`: one member of a fleet, which serves actions and keeps their goals at the brokers.

Its parts get each other by their constructors, in this order: the journals, which all others know;
the leases of other workers; what takes goals over; what repairs streams; the limits; the store for
the servers; and the offers to clients. What a part has to do when the worker is fenced, or joins
again, is in that part (`MemberPart`).

A worker listens to the questions about an action only while its server has room, and the brokers
give each question to one of the workers that listen. So a worker with no room is not asked.

While an executor blocks the event loop, a `LeaseThread` renews the lease. Each renewal has a
connection of its own, which belongs to the event loop of the thread, and is closed after it: they
are needed rarely. What is renewed, and when, is in `Membership`.
"""

from __future__ import annotations

import math
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from threading import Event, Thread
from typing import TypeAlias

import anyio
from anyio import CancelScope, move_on_after, sleep
from anyio.abc import TaskGroup
from anyio.lowlevel import checkpoint
from msgspec.structs import replace

from fibaction.border.abc import Endpoint, Notifier
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import GoalStore, KeySlots, StoredGoal, no_obstacle
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.wire.wire_server import open_server
from fibaction.words.errors import ConnectionLost, ProtocolError, StoreError, TransportError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerSubscription, Message
from fibaction_transports.nats.lines import WorkerLines
from fibaction_transports.nats.names import OFFER_GROUP, FleetNames
from fibaction_transports.nats.records import LeaseEntry, RoomOffer, ServedAction, encode, question
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.fleet_limits import FleetLimits
from fibaction_transports.nats.worker.journal import FleetJournal, WorkerJournals
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, MARGIN, MemberPart, Membership
from fibaction_transports.nats.worker.lost_streams import LostStreams
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.worker.takeover import Takeover
from fibaction_transports.nats.workers import FleetWorkers

MOST_OFFERED = 16
"""The largest number of goals of one offer."""
LOOKS_IN_A_LEASE = 16
"""The number of looks in the time of one lease."""
JOIN_TIMEOUT = 1.0
"""Seconds for the thread to end. It ends at once, unless it is renewing the lease."""
TEXT = (
    "worker %r: its event loop is blocked, and a thread renews the lease: its goals stay here, and"
    " answer nobody meanwhile"
)

OpenBroker: TypeAlias = Callable[[], AbstractAsyncContextManager[Broker]]
"""Opens a connection to the brokers in the event loop that runs."""

logger = clean_logger("fibaction.nats")


class Offers(MemberPart):
    """The answers of one worker."""

    def __init__(self, journals: WorkerJournals) -> None:
        self._broker = journals.broker
        self._names = journals.names
        self._membership = journals.membership
        self._journals = journals
        self._open: dict[str, BrokerSubscription] = {}
        self._busy = 0  # the actions whose subscriptions are not as they should be
        self._ready = Notifier()
        self._membership.add(self)

    def describe(self, entry: LeaseEntry) -> None:
        """See `MemberPart.describe`: a worker has room if it listens to questions."""
        entry.has_room = bool(self._open)

    async def ready(self) -> None:
        """Wait until the worker listens to all questions for which it has room."""
        await checkpoint()  # the tasks begin
        while self._busy:
            await self._ready.wait()

    async def run(self, action: str) -> None:
        """Listen to questions about an action while there is room, until canceled."""
        subjects = self._names.offer(action), self._names.queue(action)
        try:
            while True:
                changes = [
                    (subject, room > 0)
                    for subject, room in zip(subjects, self._room(action), strict=True)
                    if (room > 0) != (subject in self._open)
                ]
                if not changes:
                    await self._journals.room.wait()
                self._busy += 1
                try:
                    for subject, listens in changes:
                        await self._listen(action, subject, listens=listens)
                finally:
                    self._busy -= 1
                    self._ready.notify()
        finally:
            for subject in subjects:
                self._close(subject)

    def _room(self, action: str) -> tuple[float, float]:
        """Return the room for goals that run, and for goals that wait."""
        if not self._membership.incarnation:
            return 0, 0
        journal = self._journals.by_action.get(action)
        return (math.inf, 0) if journal is None else (journal.running, journal.waiting)

    async def _listen(self, action: str, subject: str, *, listens: bool) -> None:
        if not listens:
            self._close(subject)
            return

        def answer(message: Message) -> None:
            self._answer(action, message)

        try:
            self._open[subject] = await self._broker.subscribe(subject, answer, OFFER_GROUP)
        except BrokerAway:
            await sleep(LONGEST_PAUSE)
        self._membership.note_change()

    def _close(self, subject: str) -> None:
        subscription = self._open.pop(subject, None)
        if subscription is not None:
            subscription.close()
            self._membership.note_change()

    def _answer(self, action: str, message: Message) -> None:
        try:
            asked = question(message.data)
        except ProtocolError:
            return
        # Without room by now, one goal is sent here, and then elsewhere.
        goals = max(1, min(asked.goals, MOST_OFFERED, sum(self._room(action))))
        self._broker.publish(message.reply, encode(RoomOffer(self._membership.worker, int(goals))))


class FleetStore(GoalStore):
    """The store of one worker: the goals of all its servers, kept by the brokers."""

    def __init__(
        self,
        journals: WorkerJournals,
        takeover: Takeover,
        slots: Callable[[str, int], Awaitable[KeySlots]],
        make_keys: Callable[[], Awaitable[None]],
    ) -> None:
        """Take the function for `GoalJournal.key_slots`, and the one that makes their stream."""
        self._make_keys = make_keys
        self._journals = journals
        self._takeover = takeover
        self._slots = slots

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
            journals, action, max_results, claim, lose, obstacle, self._slots, self._make_keys
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
            self._journals, self._takeover, limits.slots, self._streams.make_keys
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


class LeaseThread(Thread):
    """The thread that renews the lease of one worker, if its event loop does not."""

    def __init__(self, membership: Membership, open_broker: OpenBroker) -> None:
        super().__init__(name=f"fibaction lease {membership.worker}", daemon=True)
        self._membership = membership
        self._open_broker = open_broker
        self._stopped = Event()

    async def stop(self) -> None:
        """Renew nothing more, and wait for the end of the thread, also if canceled."""
        self._stopped.set()
        with CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.join, JOIN_TIMEOUT)

    def run(self) -> None:
        """Look whether the event loop is blocked, again and again."""
        me, told_at = self._membership, 0.0
        while not self._stopped.wait(me.lease / LOOKS_IN_A_LEASE):
            if me.is_blocked(time.monotonic()):
                if told_at != me.alive_at:
                    told_at = me.alive_at
                    logger.warning(TEXT, me.worker)
                try:
                    anyio.run(self._renew, backend="asyncio")
                except (BrokerAway, TransportError) as exc:
                    logger.warning("worker %r: the lease is not renewed: %s", me.worker, exc)

    async def _renew(self) -> None:
        with move_on_after(self._membership.lease * MARGIN):
            async with self._open_broker() as broker:
                await self._membership.renew_blocked(broker)


@asynccontextmanager
async def lease_thread(
    membership: Membership, open_broker: OpenBroker
) -> AsyncGenerator[None, None]:
    """Renew the lease of a worker whose event loop is blocked, while the block lasts."""
    thread = LeaseThread(membership, open_broker)
    try:
        thread.start()
    except RuntimeError as exc:  # the system has no threads, or no more of them
        logger.warning("goals that block worker %r are lost for it: %s", membership.worker, exc)
        yield
        return
    try:
        yield
    finally:
        await thread.stop()


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
