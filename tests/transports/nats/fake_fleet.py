"""A broker in memory, and workers in this process, to which lines can be dialed."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import anyio

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    Endpoint,
    GoalHandle,
    GoalID,
    GoalStatus,
)
from fibaction.border.abc import Connection
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import (
    GoalJournal,
    GoalStore,
    GoalTaken,
    StoredGoal,
    Then,
    no_obstacle,
)
from fibaction.wire.channel import Line
from fibaction.wire.settings import ClientSettings, WireSettings
from fibaction.wire.wire_server import open_server
from fibaction.words.errors import ServerNotFound
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from fibaction_transports.nats.broker.broker import (
    BrokerRecord,
    BrokerStream,
    BrokerSubscription,
    Message,
    NoResponders,
    PutError,
)
from fibaction_transports.nats.client.connection import FleetConnection
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    GoalEntry,
    LeaseEntry,
    RoomOffer,
    ServedAction,
    encode,
    goal_entry,
)
from tests.support.memory_broker import (
    MemoryBroker,
    MemoryBrokers,
    MemorySubscription,
    MemoryWatch,
)
from tests.wire.memory import MemoryChannel, pair

NAMES = FleetNames("test")
COUNT = Action("count", goal=int, feedback=int, result=str)
"""Counts up to its goal; below 0, it then waits for a cancel."""
GOAL_ID = GoalID(bytes(range(16)))
THREE, MINUS_THREE = COUNT.goal.encode(3), COUNT.goal.encode(-3)
ENDED: dict[str, Any] = {
    "status": GoalStatus.SUCCEEDED,
    "result": COUNT.result.encode("3"),
    "feedback_count": 3,
    "ended_at": 1,
    "goal": b"",
}
"""The fields of a record after the end."""


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(abs(goal.request)):
        yield number
    if goal.request < 0:
        await anyio.sleep_forever()
    yield str(goal.request)


def server(**settings: Any) -> ActionServer[int, int, str]:
    return ActionServer(COUNT, count, result_timeout=math.inf, **settings)


def client_of(connection: Connection) -> ActionClient[int, int, str]:
    return ActionClient(connection.endpoint(COUNT), COUNT)


class FakeBroker(MemoryBroker):
    """The one connection of a fleet in memory, which carries everything out at once."""

    def __init__(self) -> None:
        super().__init__(MemoryBrokers(), "all")
        self.shared.members.append(self)
        self.gets = 0
        self.watches = 0
        self.questions: list[bytes] = []

    def _send(self, act: Callable[[], None]) -> None:
        act()

    async def flush(self) -> None:
        await anyio.lowlevel.checkpoint()
        self._check_there()

    async def find_stream(self, stream: str) -> BrokerStream | None:
        await self.before("find_stream", stream)
        return await super().find_stream(stream)

    async def request(self, subject: str, data: bytes, timeout: float) -> bytes:
        await self.flush()
        self.questions.append(data)
        try:
            return await super().request(subject, data, timeout)
        except NoResponders:
            self.questions.remove(data)
            raise

    def listen(self, subject: str, answer: Callable[[bytes], bytes | None]) -> BrokerSubscription:
        """Answer questions, in turn with others; None is no answer."""

        def on_message(message: Message) -> None:
            if (data := answer(message.data)) is not None:
                self.publish(message.reply, data)

        self.subscriptions.append(MemorySubscription(self, subject, on_message, "group"))
        return self.subscriptions[-1]

    def store(self, subject: str, data: bytes) -> int:
        """Store a record whatever there is; it is its own head."""
        self.shared.heads[subject] = data
        return self.shared.store(subject, data, math.inf)

    async def get(self, stream: str, subject: str) -> BrokerRecord | None:
        self.gets += 1
        return await super().get(stream, subject)

    @asynccontextmanager
    async def watch(
        self, stream: str, subject: str, *, heads_since: int | None = None
    ) -> AsyncGenerator[MemoryWatch, None]:
        self.watches += 1
        async with super().watch(stream, subject, heads_since=heads_since) as watch:
            yield watch


class FakeJournal(GoalJournal):
    """Writes the records of goals, as the owner that its worker is."""

    def __init__(self, broker: FakeBroker, action: str, worker: FakeWorker) -> None:
        self._broker = broker
        self._action = action
        self._worker = worker
        self.expected: dict[GoalID, int] = {}

    def accept(self, goal: StoredGoal, then: Then) -> None:
        goal.worker = self._worker.name
        entry = encode(GoalEntry(goal, self._worker.incarnation, b"\0\0\0\0"))

        def stored(answer: int | PutError) -> None:
            if isinstance(answer, PutError):
                then(GoalTaken("another worker has the goal"))
            else:
                self.expected[goal.goal_id] = answer
                then(None)

        self._broker.put(
            NAMES.goal(self._action, goal.goal_id),
            entry,
            expected=self.expected.get(goal.goal_id, 0),
            then=stored,
        )

    begin = cancel = checkpoint = end = release = accept


class FakeStore(GoalStore):
    """The store of the servers of one worker."""

    def __init__(self, broker: FakeBroker, worker: FakeWorker) -> None:
        self._broker = broker
        self._worker = worker

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
    ) -> AsyncGenerator[GoalJournal, None]:
        journal = FakeJournal(self._broker, action, self._worker)
        self._worker.journals[action] = journal, claim, lose
        yield journal


class FakeWorker:
    """A worker that serves its endpoints over lines in memory."""

    def __init__(self, broker: FakeBroker, name: str, *, is_kept: bool = True) -> None:
        self.broker = broker
        self.name = name
        self.incarnation = name.encode().ljust(8, b"\1")[:8]
        self.is_kept = is_kept
        self.room = 1000
        self.has_room = True
        self.is_frozen = False
        self.server: Any = None
        self.lines: list[MemoryChannel] = []
        self.asked: list[bytes] = []
        self.listening: list[BrokerSubscription] = []
        self.journals: dict[str, Any] = {}
        self.actions: tuple[ServedAction, ...] = ()
        self.since = 1

    @asynccontextmanager
    async def serve(self, *servers: Endpoint) -> AsyncGenerator[FakeWorker, None]:
        """Serve while the block lasts."""
        async with AsyncExitStack() as stack:
            for server in servers:
                if self.is_kept and isinstance(server, ActionServer):
                    server.keep_in(FakeStore(self.broker, self))
                await stack.enter_async_context(server)  # type: ignore[arg-type]
            endpoints = {one.info.name: one for one in servers}
            self.server = await stack.enter_async_context(open_server(endpoints, WireSettings()))
            self.actions = tuple(ServedAction(one.info, self.is_kept) for one in servers)
            for action in endpoints:
                self.listen(NAMES.offer(action))
            self.renew()
            stack.callback(self.die)
            yield self

    def listen(self, subject: str) -> None:
        """Answer questions."""
        self.listening.append(self.broker.listen(subject, self._answer))

    def deafen(self) -> None:
        """Answer no more questions."""
        for one in self.listening:
            one.close()

    def _answer(self, question: bytes) -> bytes | None:
        self.asked.append(question)
        return None if self.is_frozen else encode(RoomOffer(self.name, min(self.room, 16)))

    def renew(self) -> None:
        """Write the lease."""
        lease = LeaseEntry(
            self.name, self.incarnation, self.since, 5.0, self.actions, 0, self.has_room
        )
        self.broker.store(NAMES.worker(self.name), encode(lease))

    def hang_up(self) -> None:
        """Cut all lines, and take no more."""
        self.server = None
        for line in self.lines:
            line.cut()

    def flicker(self) -> None:
        """Cut all lines, and take the next."""
        for line in self.lines:
            line.cut()
        self.lines.clear()

    def end_lease(self) -> None:
        """Let the lease end."""
        self.broker.store(NAMES.worker(self.name), b"")

    def die(self) -> None:
        """End everything at once."""
        self.deafen()
        self.hang_up()
        self.end_lease()

    def own(self, goal_id: GoalID, **changes: Any) -> None:
        """Store the record of a goal, without knowing it."""
        fields: dict[str, Any] = {
            "stamp": 7,
            "digest": digest_of(THREE),
            "goal": THREE,
            "worker": self.name,
            "attempt": 1,
            **changes,
        }
        goal = StoredGoal(goal_id, sender=UNKNOWN_SENDER, **fields)
        entry = GoalEntry(goal, self.incarnation, b"\0\0\0\0")
        self.broker.store(NAMES.goal("count", goal_id), encode(entry))

    def take_over(self, action: str, goal_id: GoalID) -> None:
        """Become the owner of a goal of another worker."""
        subject = NAMES.goal(action, goal_id)
        record = self.broker.shared.record_of(subject)
        stored = goal_entry(record.data).goal
        stored.worker = self.name
        journal, claim, _ = self.journals[action]
        journal.expected[goal_id] = self.broker.store(
            subject, encode(GoalEntry(stored, self.incarnation, b"\0\0\0\0"))
        )
        claim(stored)


class FakeLines:
    """Dials lines to the workers of a test."""

    def __init__(self, workers: dict[str, FakeWorker]) -> None:
        self._workers = workers
        self.dialed: list[str] = []

    async def open(self) -> None:
        """Do nothing."""

    async def dial(self, worker: str) -> Line:
        self.dialed.append(worker)
        found = self._workers.get(worker)
        if found is None or found.server is None:
            raise ServerNotFound(f"worker {worker!r} is not there")
        far, near = pair("client", worker)
        found.lines.append(near)
        found.server.start(far)
        return near


class FakeFleet:
    """A broker, workers and clients in one process."""

    def __init__(self) -> None:
        self.broker = FakeBroker()
        self.workers: dict[str, FakeWorker] = {}
        self.lines = FakeLines(self.workers)

    def worker(self, name: str, *, is_kept: bool = True) -> FakeWorker:
        """Add a worker, which does not serve yet."""
        worker = self.workers[name] = FakeWorker(self.broker, name, is_kept=is_kept)
        return worker

    @asynccontextmanager
    async def serving(self, *names: str) -> AsyncGenerator[list[FakeWorker], None]:
        """Let workers of these names serve while the block lasts."""
        async with AsyncExitStack() as stack:
            made = [self.worker(name).serve(server()) for name in names]
            yield [await stack.enter_async_context(one) for one in made]

    @asynccontextmanager
    async def connect(self, **settings: Any) -> AsyncGenerator[FleetConnection, None]:
        """Connect a client."""
        async with Background() as tasks:
            connection = FleetConnection(
                self.broker,
                NAMES,
                self.lines,
                ClientSettings(**settings),
                tasks,
            )
            try:
                yield connection
            finally:
                await connection.leave()
