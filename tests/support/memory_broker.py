"""`MemoryBroker`: the brokers of a fleet, for tests, in memory, on real or virtual time.

`MemoryBrokers` is what all members of a fleet share; each member has a `MemoryBroker`. What a
member sends is carried out in its order, in a later turn of the event loop. A test chooses faults:
brokers that a member does not reach (`is_away`), lost and old answers, delays and restarts, and
what happens before a call is carried out (`before`).
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from heapq import heappop, heappush
from typing import NamedTuple, TypeAlias

from anyio import current_time, move_on_after

from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background
from fibaction.words.goal_query import GoalHistory
from fibaction_transports.nats.broker.broker import (
    NO_RESPONDERS,
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerStream,
    BrokerSubscription,
    BrokerWatch,
    Message,
    NoResponders,
    Note,
    OnMessage,
    PutError,
    PutFailure,
    Stored,
)
from fibaction_transports.nats.names import FleetNames

ANSWER_TIMEOUT = 2.0
"""Seconds after which a member gives up an answer."""
MARKER_TIME = 60.0
"""Seconds after which a marker is forgotten."""
NOTE_TIMEOUT = 5.0
"""Seconds after which a note that was not removed comes again."""
Before: TypeAlias = Callable[[str, str], Awaitable[None]]
"""What happens before a call, of that name and subject, is carried out; it may raise."""


async def nothing(_call: str, _subject: str) -> None:
    """Do nothing before a call."""


def matches(pattern: str, subject: str) -> bool:
    """Return whether a subject is one of a pattern with wildcards."""
    wanted, given = pattern.split("."), subject.split(".")
    if wanted[-1] == ">":
        wanted.pop()
        if len(given) <= len(wanted):
            return False
        given = given[: len(wanted)]
    return len(wanted) == len(given) and all(
        one in ("*", other) for one, other in zip(wanted, given, strict=True)
    )


class Write(NamedTuple):
    """A record that a member wants to store."""

    member: str
    subject: str
    data: bytes


class _Kept(NamedTuple):
    record: BrokerRecord
    ends: float


class MemoryNote:
    """A note in the queue."""

    def __init__(self, subject: str, data: bytes) -> None:
        self.subject = subject
        self.data = data
        self.hidden_until = -math.inf


class MemoryReader:
    """A reader that has asked for a note."""

    def __init__(self, broker: MemoryBroker, subject: str) -> None:
        self._broker = broker
        self.subject = subject

    def is_before(self, other: MemoryReader) -> bool:
        """Return whether it has a note before a reader that has asked later."""
        return self.subject == other.subject and not self._broker.is_away


class MemoryBrokers:
    """The brokers of a fleet, entered with `async with`."""

    def __init__(self) -> None:
        self.goals_are_full = False
        """True if the stream of the goals stores nothing more."""
        self.is_full = False
        """True if no more records are taken."""
        self.loses_answer: Callable[[Write], bool] = lambda _write: False
        """The function that decides whether the answer to a stored record is lost."""
        self.delay: Callable[[], float] = lambda: 0.0
        """The function that returns the seconds until something that was sent is carried out."""
        self.writes: list[Write] = []
        """All records that were stored, markers as well."""
        self.members: list[MemoryBroker] = []
        self.notes: list[MemoryNote] = []
        """The notes that were not removed."""
        self.readers: list[MemoryReader] = []
        """The readers that wait for a note, in the order in which they have asked."""
        self.notes_changed = Notifier()
        self.stream: BrokerStream | None = BrokerStream("first", math.inf)
        """The answer to members about each stream."""
        self.records: dict[str, _Kept] = {}
        self.heads: dict[str, bytes] = {}
        """The heads of the records of the past, by subject."""
        self.history: GoalHistory | None = None
        """The bounds of the history that was made last; these brokers remove nothing by them."""
        self._sequences: dict[str, int] = {}
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._news = Notifier()
        self._tasks: Background

    async def __aenter__(self) -> MemoryBrokers:
        self._tasks = Background()
        tasks = await self._tasks.__aenter__()
        tasks.start_soon(self._run)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._tasks.__aexit__(None, None, None)

    def member(self, name: str = "") -> MemoryBroker:
        """Return the connection of one more member."""
        member = MemoryBroker(self, name or f"member{len(self.members)}")
        self.members.append(member)
        return member

    def restart(self) -> None:
        """Begin all watches anew, as after a restart of the brokers."""
        for member in self.members:
            member.begin_anew()

    def lose_streams(self) -> None:
        """Forget all that is stored: the streams are gone until `stream` is another one."""
        self.records.clear()
        self.notes.clear()
        self._sequences.clear()
        self.stream = None

    # Time

    def at(self, time: float, act: Callable[[], None]) -> None:
        """Do something at a time, in a later turn of the event loop."""
        heappush(self._due, (time, next(self._numbers), act))
        self._news.notify()

    async def _run(self) -> None:
        while True:
            while self._due and self._due[0][0] <= current_time():
                heappop(self._due)[-1]()
            with move_on_after(max(0, self._due[0][0] - current_time()) if self._due else None):
                await self._news.wait()

    # Records

    def newest(self, subject: str) -> BrokerRecord | None:
        """Return the newest record of a subject."""
        kept = self.records.get(subject)
        return None if kept is None else kept.record

    def record_of(self, subject: str) -> BrokerRecord:
        """Return the newest record of a subject that has one."""
        return self.records[subject].record

    def matching(self, subject: str) -> list[BrokerRecord]:
        """Return the newest record of each subject that matches, in the order of sequences."""
        found = [kept.record for one, kept in self.records.items() if matches(subject, one)]
        return sorted(found, key=lambda record: record.sequence)

    def put(self, subject: str, data: bytes, expected: int, ttl: float) -> int | PutError:
        """Store a record, and return its sequence."""
        newest = self.newest(subject)
        if self.is_full or (self.goals_are_full and ".goal." in subject):
            return PutError(PutFailure.FULL, "maximum bytes exceeded")
        if (0 if newest is None else newest.sequence) != expected:
            return PutError(PutFailure.REFUSED, "wrong last sequence")
        return self.store(subject, data, ttl)

    def store(self, subject: str, data: bytes, ttl: float) -> int:
        """Store a record whatever there is, and return its sequence."""
        stream = subject.split(".")[2]
        sequence = self._sequences[stream] = self._sequences.get(stream, 0) + 1
        if not data:
            ttl = MARKER_TIME
        record = BrokerRecord(subject, data, sequence)
        ends = current_time() + max(1, math.ceil(ttl)) if ttl < math.inf else math.inf
        kept = self.records[subject] = _Kept(record, ends)
        if ends < math.inf:
            self.at(ends, lambda: self._expire(kept))
        for member in self.members:
            member.on_record(record)
        return sequence

    def _expire(self, kept: _Kept) -> None:
        record = kept.record
        if self.records.get(record.subject) is kept:
            if record.data:
                self.store(record.subject, b"", math.inf)
            else:
                del self.records[record.subject]

    # Messages

    def deliver(self, message: Message) -> bool:
        """Deliver a message; return whether somebody listens."""
        found = [
            one
            for member in self.members
            if not member.is_away
            for one in member.subscriptions
            if matches(one.subject, message.subject)
        ]
        groups: dict[str, list[MemorySubscription]] = {}
        for one in found:
            groups.setdefault(one.queue or f"_{id(one)}", []).append(one)
        for group in groups.values():
            min(group, key=lambda one: one.delivered).take(message)
        return bool(found)


class MemorySubscription(BrokerSubscription):
    """A subscription of one member."""

    def __init__(self, broker: MemoryBroker, subject: str, take: OnMessage, queue: str) -> None:
        self._broker = broker
        self._take = take
        self.subject = subject
        self.queue = queue
        self.delivered = 0

    def take(self, message: Message) -> None:
        """Take a message."""
        self.delivered += 1
        self._take(message)

    def close(self) -> None:
        """See `BrokerSubscription.close`."""
        if self in self._broker.subscriptions:
            self._broker.subscriptions.remove(self)


class MemoryWatch(BrokerWatch):
    """A watch of one member."""

    def __init__(self, broker: MemoryBroker, subject: str) -> None:
        self._broker = broker
        self.subject = subject
        self._news = Notifier()
        self._found: deque[list[BrokerRecord] | None] = deque()
        self.has_heads = False
        """True if it has the heads of records in place of their data."""
        self.begin()

    def begin(self) -> None:
        """Return all records, and then None."""
        self._found.clear()
        if found := self._broker.shared.matching(self.subject):
            self._found.append(found)
        self._found.append(None)
        self._news.notify()

    def add(self, record: BrokerRecord) -> None:
        """Return one more record."""
        self._found.append([record])
        self._news.notify()

    async def next(self) -> list[BrokerRecord] | None:
        """See `BrokerWatch.next`."""
        while not self._found or self._broker.is_away:
            await self._news.wait()
        records = self._found.popleft()
        if records is None or not self.has_heads:
            return records
        heads = self._broker.shared.heads
        return [one._replace(data=heads[one.subject]) for one in records]


class MemoryBroker(Broker):
    """The connection of one member."""

    max_record = 2**20
    brokers = 1

    def __init__(self, shared: MemoryBrokers, name: str) -> None:
        self.shared = shared
        self.name = name
        self.subscriptions: list[MemorySubscription] = []
        self._watches: list[MemoryWatch] = []
        self.watch_delay = 0.0
        """Seconds until the watches are told of a new record."""
        self.before: Before = nothing
        """What happens before a call that waits for the brokers."""
        self.old: dict[str, list[BrokerRecord | None]] = {}
        """The answers of a broker that is behind to `get`, by subject, the last first."""
        self._is_away = False
        self._inboxes = itertools.count()
        self._sent_until = -math.inf

    @property
    def is_connected(self) -> bool:
        """See `Broker.is_connected`."""
        return not self._is_away

    @property
    def is_away(self) -> bool:
        """True if this member does not reach the brokers."""
        return self._is_away

    @is_away.setter
    def is_away(self, value: bool) -> None:
        self._is_away = value
        if not value:
            self.begin_anew()
            self.shared.notes_changed.notify()

    def begin_anew(self) -> None:
        """Begin all watches anew."""
        for watch in self._watches:
            watch.begin()

    def on_record(self, record: BrokerRecord) -> None:
        """Tell the watches of a new record."""
        for watch in self._watches:
            if not self._is_away and matches(watch.subject, record.subject):
                if self.watch_delay:
                    self.shared.at(current_time() + self.watch_delay, partial(watch.add, record))
                else:
                    watch.add(record)

    def _send(self, act: Callable[[], None]) -> None:
        """Do something at the brokers, in the order of the calls."""
        self._sent_until = max(self._sent_until, current_time() + self.shared.delay())
        self.shared.at(self._sent_until, act)

    def _check_there(self) -> None:
        if self._is_away:
            raise BrokerAway("the brokers do not answer")

    # Messages

    def publish(self, subject: str, data: bytes, reply: str = "") -> None:
        """See `Broker.publish`."""

        def deliver() -> None:
            if self._is_away:
                return
            if not self.shared.deliver(Message(subject, data, reply)) and reply:
                self.shared.deliver(Message(reply, b"", "", {"Status": NO_RESPONDERS}))

        self._send(deliver)

    async def subscribe(
        self, subject: str, on_message: OnMessage, queue: str = ""
    ) -> BrokerSubscription:
        """See `Broker.subscribe`."""
        await self.before("subscribe", subject)
        self._check_there()
        subscription = MemorySubscription(self, subject, on_message, queue)
        self.subscriptions.append(subscription)
        return subscription

    async def request(self, subject: str, data: bytes, timeout: float) -> bytes:
        """See `Broker.request`."""
        answers: list[Message] = []
        news = Notifier()

        def answered(message: Message) -> None:
            answers.append(message)
            news.notify()

        inbox = await self.subscribe(f"_INBOX.{self.name}.{next(self._inboxes)}", answered)
        try:
            self.publish(subject, data, self.subscriptions[-1].subject)
            with move_on_after(timeout):
                while not answers:
                    await news.wait()
        finally:
            inbox.close()
        if not answers:
            raise BrokerAway(f"no answer to {subject}")
        if answers[0].has_no_responders:
            raise NoResponders
        return answers[0].data

    async def flush(self) -> None:
        """See `Broker.flush`."""
        sent = Notifier()
        self._send(sent.notify)
        await sent.wait()
        self._check_there()

    # Records

    async def create_streams(
        self,
        names: FleetNames,
        *,
        replicas: int = 0,
        has_keys: bool = False,
        history: GoalHistory | None = None,
    ) -> None:
        """See `Broker.create_streams`."""
        await self.before("create_streams", "keys" if has_keys else "")
        self.shared.history = history or self.shared.history

    async def find_stream(self, stream: str) -> BrokerStream | None:
        """See `Broker.find_stream`."""
        with move_on_after(ANSWER_TIMEOUT):
            await self.flush()
            return self.shared.stream
        raise BrokerAway(f"no answer about {stream}")

    def put(
        self,
        subject: str,
        data: bytes,
        *,
        expected: int,
        ttl: float | None = None,
        head: bytes = b"",
        then: Stored,
    ) -> None:
        """See `Broker.put`."""
        if head:
            self.shared.heads[subject] = head

        def fail() -> None:
            then(PutError(PutFailure.UNKNOWN, "no answer"))

        def store() -> None:
            if self._is_away:
                self.shared.at(current_time() + ANSWER_TIMEOUT, fail)
                return
            if len(data) > self.max_record - 2 * len(head):
                then(PutError(PutFailure.TOO_LARGE, "maximum payload exceeded"))
                return
            stored = self.shared.put(subject, data, expected, math.inf if ttl is None else ttl)
            if not isinstance(stored, PutError):
                write = Write(self.name, subject, data)
                self.shared.writes.append(write)
                if self.shared.loses_answer(write):
                    self.shared.at(current_time() + ANSWER_TIMEOUT, fail)
                    return
            then(stored)

        self._send(store)

    async def get(self, stream: str, subject: str) -> BrokerRecord | None:
        """See `Broker.get`."""
        await self.before("get", subject)
        if old := self.old.get(subject):
            return old.pop()
        with move_on_after(ANSWER_TIMEOUT):
            await self.flush()
            return self.shared.newest(subject)
        raise BrokerAway(f"no answer about {subject}")

    @asynccontextmanager
    async def watch(
        self, stream: str, subject: str, *, heads_since: int | None = None
    ) -> AsyncGenerator[MemoryWatch, None]:
        """See `Broker.watch`; `heads_since` leaves out nothing."""
        await self.before("watch", subject)
        self._check_there()
        watch = MemoryWatch(self, subject)
        watch.has_heads = heads_since is not None
        self._watches.append(watch)
        try:
            yield watch
        finally:
            self._watches.remove(watch)

    # Notes

    def add_note(self, subject: str, data: bytes) -> None:
        """See `Broker.add_note`."""

        def add() -> None:
            if self._is_away:
                self.shared.at(current_time() + 1, add)
                return
            self.shared.notes.append(MemoryNote(subject, data))
            self.shared.notes_changed.notify()

        self._send(add)

    async def notes(self, subject: str) -> AsyncGenerator[Note, None]:
        """See `Broker.notes`."""
        shared = self.shared
        while True:
            reader = MemoryReader(self, subject)
            shared.readers.append(reader)
            try:
                while (note := self._next_note(reader)) is None:
                    await shared.notes_changed.wait()
            finally:
                shared.readers.remove(reader)
                shared.notes_changed.notify()
            note.hidden_until = current_time() + NOTE_TIMEOUT
            shared.at(note.hidden_until, shared.notes_changed.notify)
            yield Note(note.data, partial(self._remove, note))

    def _next_note(self, reader: MemoryReader) -> MemoryNote | None:
        """Return the next note for a reader; None if another one has asked before."""
        now, subject = current_time(), reader.subject
        first = next(one for one in self.shared.readers if one is reader or one.is_before(reader))
        if self._is_away or first is not reader:
            return None
        for note in self.shared.notes:
            if note.subject == subject and note.hidden_until <= now:
                return note
        return None

    def _remove(self, note: MemoryNote) -> None:
        if not self._is_away and note in self.shared.notes:
            self.shared.notes.remove(note)
