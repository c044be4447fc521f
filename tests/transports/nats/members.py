"""Members of a fleet over brokers in memory, whose servers note what they are told."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import AsyncExitStack, asynccontextmanager

from anyio import fail_after
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction import GoalID
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background
from fibaction.border.goal_store import KeySlots, StoredGoal, Then
from fibaction.types.action import ActionInfo
from fibaction.words.errors import StoreError
from fibaction.words.goals import Sender
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    GoalEntry,
    LeaseEntry,
    ServedAction,
    encode,
    goal_entry,
)
from fibaction_transports.nats.worker.journal import FleetJournal, WorkerJournals
from fibaction_transports.nats.worker.lease import MemberPart, Membership
from fibaction_transports.nats.worker.lost_streams import LostStreams
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from fibaction_transports.nats.worker.takeover import Takeover
from fibaction_transports.nats.worker.worker import FleetStore
from fibaction_transports.nats.workers import FleetWorkers
from tests.support.memory_broker import MemoryBrokers

NAMES = FleetNames("test")
LEASE = 6.0


def goal(number: int = 1, **changes: object) -> StoredGoal:
    made = StoredGoal(GoalID(bytes([number]) * 16), number, Sender("me"), b"digest", b"goal")
    fields = {"is_running": True, "attempt": 1, "meta": {"traceparent": f"00-{number}"}}
    return replace(made, **{**fields, **changes})


def waiting(number: int = 1) -> StoredGoal:
    return goal(number, is_running=False, attempt=0)


class Member:
    """A worker whose server notes what it is told, and begins what it is given."""

    def __init__(self, shared: MemoryBrokers, name: str) -> None:
        self.broker = shared.member(name)
        self.name = name
        self.membership = Membership(self.broker, NAMES, name, LEASE)
        self.journals: WorkerJournals
        self.journal: FleetJournal
        self.takeover: Takeover
        self.streams: LostStreams
        self.store: FleetStore
        self.claimed: list[StoredGoal] = []
        self.lost: list[GoalID] = []
        self.cannot_run: set[GoalID] = set()
        self.begins = True
        self.answers: list[tuple[str, StoreError | None]] = []
        self.news = Notifier()

    def claim(self, one: StoredGoal) -> None:
        self.claimed.append(replace(one))
        self.news.notify()
        if self.begins:
            one.is_running, one.attempt = True, one.attempt + 1
            self.journal.begin(one, lambda _error: None)

    def obstacle(self, one: StoredGoal) -> str:
        return "it has no field `unit`" if one.goal_id in self.cannot_run else ""

    def then(self, name: str) -> Then:
        def answered(error: StoreError | None) -> None:
            self.answers.append((name, error))
            self.news.notify()

        return answered

    def write(self, kind: str, one: StoredGoal, name: str = "") -> None:
        getattr(self.journal, kind)(one, self.then(name or kind))

    @property
    def errors(self) -> list[type[StoreError] | None]:
        return [None if error is None else type(error) for _, error in self.answers]

    async def answered(self, count: int) -> None:
        with fail_after(2 * LEASE):
            while len(self.answers) < count:
                await self.news.wait()

    def accept(self, *goals: StoredGoal) -> None:
        for one in goals:
            self.journal.accept(one, lambda _error: None)

    async def claims(self, count: int, within: float = 3 * LEASE) -> list[StoredGoal]:
        with fail_after(within):
            while len(self.claimed) < count:
                await self.news.wait()
        return self.claimed


class ServesCount(MemberPart):
    """Says in the lease that the worker serves the action."""

    def describe(self, entry: LeaseEntry) -> None:
        entry.actions = (ServedAction(ActionInfo("count"), is_kept=True),)


@asynccontextmanager
async def staying(membership: Membership) -> AsyncGenerator[TaskGroup, None]:
    """Let a worker join, and stay in the fleet while the block lasts; give tasks for it."""
    await membership.join()
    async with Background() as tasks:
        tasks.start_soon(membership.run)
        tasks.start_soon(membership.fence_in_time)
        yield tasks


async def no_slots(_limit: str, _most: int) -> KeySlots:
    raise NotImplementedError


@asynccontextmanager
async def member(
    shared: MemoryBrokers,
    name: str = "robot",
    *,
    running: float = 0,
    max_results: int = 9,
    is_frozen: bool = False,
    cannot_run: Iterable[StoredGoal] = (),
    ends_unreadable: bool = False,
    key_slots: Callable[[str, int], Awaitable[KeySlots]] = no_slots,
) -> AsyncGenerator[Member, None]:
    made = Member(shared, name)
    made.cannot_run = {one.goal_id for one in cannot_run}
    made.membership.add(ServesCount())
    await made.membership.join()
    async with AsyncExitStack() as stack:
        tasks = await stack.enter_async_context(Background())
        stack.callback(lambda: setattr(made.broker, "is_away", False))
        if not is_frozen:
            tasks.start_soon(made.membership.run)
            tasks.start_soon(made.membership.fence_in_time)
        workers = FleetWorkers(made.broker, NAMES, tasks, 5)
        made.journals = WorkerJournals(made.broker, NAMES, made.membership, tasks)
        lost = LostWorkers(made.broker, NAMES, made.membership, workers)
        takeover = made.takeover = Takeover(made.journals, workers, lost)
        await takeover.open()
        made.streams = LostStreams(made.journals, takeover, 0)
        made.store = FleetStore(made.journals, takeover, key_slots, made.streams.make_keys)
        made.journal = await stack.enter_async_context(
            made.store.open(
                "count",
                max_results=max_results,
                claim=made.claim,
                lose=made.lost.append,
                obstacle=made.obstacle,
                ends_unreadable=ends_unreadable,
            )
        )
        made.journal.set_capacity(running, 9)
        await made.broker.flush()
        yield made


def entry(shared: MemoryBrokers, one: StoredGoal) -> GoalEntry:
    record = shared.record_of(NAMES.goal("count", one.goal_id))
    return goal_entry(record.data)


def keep(shared: MemoryBrokers, one: StoredGoal, incarnation: bytes = b"") -> None:
    """Store a record as an earlier worker did."""
    shared.put(NAMES.goal("count", one.goal_id), encode(GoalEntry(one, incarnation, b"1")), 0, 9e9)
