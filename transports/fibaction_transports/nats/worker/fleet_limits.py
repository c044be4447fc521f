"""`FleetLimits`: the limits that one worker has together with the other workers of its fleet.

The stream of their records is made when the first server that needs it starts, so a fleet without
such limits has none. `FleetSlots` is one limit; it has a `KeyTurns`, and a task for it, for each
key whose goals run or wait here.

Theory of operation
-------------------

The scheduler notes how many goals of the key run here, and how many could begin (`note`). One task,
`run`, compares that with the record of the key, and writes what follows from both (`next_entry`),
over the record that it has read: if another worker was faster, it reads again. It ends when the
record has nothing of this worker left.

A slot is used (`granted`) when this worker's own write says so, or when a record says so that is
newer than this worker's last write: then another worker has given it the slot. `_held` is the
number of slots in the newest record that was looked at, so each slot is granted once. What is
held without a goal goes back with the next write.

A write without an answer may be stored later. Then nothing is granted by what is read, before
another write is stored over the same record, or a newer record is there: each of these makes sure
that the doubtful one has been stored, or never will be.

A worker that waits is told of its slot by a hint. Hints may be lost, and workers may be killed, so
it also looks at the record now and then, and leaves out the workers whose lease has ended.

The stream of the records may be lost. In a new one, nobody gets a slot for the time of a lease, in
which each worker writes again how many goals it runs.
"""

from __future__ import annotations

import math
import random
import secrets
from collections.abc import Awaitable, Callable

from anyio import current_time, move_on_after, sleep
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Notifier
from fibaction.border.goal_store import KeySlots
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ProtocolError, StoreError, TransportError
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerSubscription,
    Message,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    NONCE_SIZE,
    Demand,
    KeyEntry,
    encode,
    given,
    key_entry,
    next_entry,
)
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, MemberPart, Membership
from fibaction_transports.nats.workers import FleetWorkers

LOOK_AGAIN = 1.0
"""Seconds after which a worker that waits looks at the record without a hint."""
SHOWN = 100
"""Bytes of a key that its record has, for people: clients may send long ones."""
CLASH_PAUSE = 0.02
"""Seconds, at most, until a worker writes again after another one was faster."""

logger = clean_logger("fibaction.nats")


class KeyTurns:
    """The turns of one worker at one key."""

    def __init__(
        self,
        fleet: FleetLimits,
        subject: str,
        key: bytes,
        most: int,
        granted: Callable[[bytes], None],
    ) -> None:
        self._fleet = fleet
        self._subject = subject
        self._key = key
        self._most = most
        self._granted = granted
        self._running = 0
        self._asked = 0
        self._incarnation = b""
        self._sequence = 0  # of the newest record that was looked at
        self._held = 0  # the slots of this incarnation in it
        self._has_written = False  # since then, records say what others have given
        self._doubt: int | None = None  # the sequence that a write without an answer is to replace
        self._stream = 0  # counts the streams that were lost
        self._is_hinted = False
        self._news = Notifier()

    @property
    def is_needed(self) -> bool:
        """True if goals of the key run here, or could begin."""
        return bool(self._running or self._asked)

    def note(self, running: int, asked: int) -> None:
        """Note the goals that run here, and those for which there is to be a slot."""
        if (running, asked) != (self._running, self._asked):
            self._running, self._asked = running, asked
            self._news.notify()

    def look(self) -> None:
        """Look at the record soon: it may have a slot for this worker."""
        self._is_hinted = True
        self._news.notify()

    def rewrite(self) -> None:
        """Write the goals that run here again: the stream was lost, and there is a new one."""
        self._stream += 1
        self._forget_record()
        self.look()

    def _forget_record(self) -> None:
        self._sequence, self._held = 0, 0
        self._has_written, self._doubt = False, None

    async def run(self) -> None:
        """Take turns, until nothing of this worker is left in the record."""
        while True:
            self._is_hinted = False
            pause = await self._look_and_write()
            if pause is None:
                if not self.is_needed:
                    return
                pause = LOOK_AGAIN if self._asked else math.inf
            if not self._is_hinted:
                with move_on_after(pause):
                    await self._news.wait()

    async def _look_and_write(self) -> float | None:
        """Bring the record up to date; return the seconds after which to try again, None if it is
        as it should be.
        """
        fleet = self._fleet
        if not fleet.membership.check():
            return LONGEST_PAUSE if self.is_needed else None
        at = fleet.membership.incarnation, self._stream
        try:
            record = await fleet.broker.get(fleet.names.keys, self._subject)
            entry = self._entry_of(record)
            gone = await self._gone(entry)
            gives = not (await self._may_miss_slots(record, entry))
        except BrokerAway:
            return LONGEST_PAUSE
        if not self._is_still(at):
            return 0.0
        if self._incarnation != fleet.membership.incarnation:
            self._incarnation = fleet.membership.incarnation
            self._forget_record()
        sequence = 0 if record is None else record.sequence
        if record is not None and sequence < self._sequence:
            return CLASH_PAUSE  # by a broker that is behind: sequences only grow
        self._look_at(entry, sequence)
        wanted = self._next(entry, gone, gives=gives)
        if self._doubt is None and self._agrees_with(entry) and wanted.says_the_same(entry):
            return None
        return await self._write(entry, wanted, sequence)

    def _entry_of(self, record: BrokerRecord | None) -> KeyEntry:
        if record is None or not record.data:
            return KeyEntry(self._key[:SHOWN])
        try:
            return key_entry(record.data)
        except ProtocolError as exc:
            logger.warning("%s: %s", record.subject, exc)
            return KeyEntry(self._key[:SHOWN], gives_none=True)

    async def _gone(self, entry: KeyEntry) -> set[bytes]:
        """Return the incarnations in a record whose lease has ended."""
        shares = {one.incarnation: one for one in (*entry.holders, *entry.waiting)}
        return {
            one.incarnation
            for one in shares.values()
            if await self._fleet.has_ended(one.worker, one.incarnation)
        }

    async def _may_miss_slots(self, record: BrokerRecord | None, entry: KeyEntry) -> bool:
        """Return whether slots may be missing in a record, because the stream was lost."""
        if record is not None and record.data and not entry.gives_none:
            return False
        fleet = self._fleet
        return await fleet.broker.is_new(fleet.names.keys, fleet.longest_lease)

    def _look_at(self, entry: KeyEntry, sequence: int) -> None:
        """Take the slots that others have given to this worker."""
        if self._doubt is not None:
            if sequence <= self._doubt:
                return
            self._doubt = None
        if sequence > self._sequence:
            held = entry.held_by(self._incarnation)
            new = held - self._held if self._has_written else 0
            self._sequence, self._held = sequence, held
            self._grant(new)

    def _grant(self, count: int) -> None:
        """Let goals begin, as long as some want to."""
        for _ in range(count):
            if self._asked:
                self._granted(self._key)

    def _next(self, entry: KeyEntry, gone: set[bytes], *, gives: bool) -> KeyEntry:
        worker = self._fleet.membership.worker
        demand = Demand(worker, self._incarnation, self._running, self._asked)
        return next_entry(entry, demand, gone, self._most, gives=gives)

    async def _write(self, before: KeyEntry, entry: KeyEntry, sequence: int) -> float | None:
        """Write a record over another one, or delete that if it is empty; return the seconds after
        which to look again.
        """
        at, running = (self._incarnation, self._stream), self._running
        nonce = secrets.token_bytes(NONCE_SIZE)
        data = b"" if entry.is_empty else encode(replace(entry, nonce=nonce))
        answer = await self._fleet.broker.put_and_wait(self._subject, data, expected=sequence)
        if isinstance(answer, PutError):
            return self._failed(answer, sequence) if self._is_still(at) else 0.0
        for worker in given(before, entry):
            if worker != self._fleet.membership.worker:
                turn = self._fleet.names.turn(worker)
                self._fleet.broker.publish(turn, self._subject.encode())
        if not self._is_still(at):
            return 0.0
        held = entry.held_by(self._incarnation)
        self._sequence, self._held = answer, held
        self._has_written, self._doubt = True, None
        self._grant(held - running)
        return None if self._agrees_with(entry) else 0.0

    def _is_still(self, at: tuple[bytes, int]) -> bool:
        """Return whether the worker has the same lease, and the records the same stream."""
        membership = self._fleet.membership
        return membership.check() and at == (membership.incarnation, self._stream)

    def _agrees_with(self, entry: KeyEntry) -> bool:
        """Return whether a record says what runs here, and what waits."""
        me = self._incarnation
        return (entry.held_by(me), entry.asked_by(me)) == (self._running, self._asked)

    def _failed(self, error: PutError, sequence: int) -> float:
        if error.kind is PutFailure.REFUSED:
            return random.uniform(0, CLASH_PAUSE)
        if error.kind is PutFailure.UNKNOWN:
            self._doubt = sequence
            return CLASH_PAUSE
        logger.warning("the slots of a key are not stored, and its goals wait: %s", error.text)
        return LONGEST_PAUSE


class FleetLimits(MemberPart):
    """The limits of one worker."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        membership: Membership,
        workers: FleetWorkers,
        tasks: TaskGroup,
        *,
        has_ended: Callable[[str, bytes], Awaitable[bool]],
        open_stream: Callable[[Callable[[], None]], Awaitable[None]],
    ) -> None:
        """Run in tasks of the worker. `open_stream` makes the stream of the records, and calls its
        argument each time it was lost and is there again.
        """
        self.broker = broker
        self.names = names
        self.membership = membership
        self.has_ended = has_ended
        """The function that tells whether an incarnation of a worker has no lease any longer."""
        self.tasks = tasks
        """The tasks of the worker."""
        self.turns: dict[str, KeyTurns] = {}
        """The turns at keys, by the subjects of their records."""
        self._workers = workers
        self._open_stream = open_stream
        self._limits: dict[str, FleetSlots] = {}
        self._hints: BrokerSubscription | None = None
        membership.add(self)

    @property
    def longest_lease(self) -> float:
        """The longest lease of a worker of the fleet, in seconds."""
        return max(self._workers.longest_lease, self.membership.lease)

    async def slots(self, limit: str, most: int) -> FleetSlots:
        """Return the slots of a limit: see `GoalJournal.key_slots`.

        Raises:
            StoreError: The brokers do not answer.
        """
        until = current_time() + self.membership.lease
        while True:
            try:
                if self._hints is None:
                    subject = self.names.turn(self.membership.worker)
                    self._hints = await self.broker.subscribe(subject, self._on_hint)
                await self._open_stream(self._rewrite)
                break
            except (BrokerAway, TransportError) as exc:
                if current_time() >= until:
                    raise StoreError(
                        f"cannot join the fleet: fleet_limit={limit!r} cannot be used: {exc}"
                    ) from exc
            await sleep(LONGEST_PAUSE)
        slots = self._limits.get(limit)
        if slots is None:
            slots = self._limits[limit] = FleetSlots(self, limit)
        slots.most = most
        return slots

    def _on_hint(self, message: Message) -> None:
        turns = self.turns.get(message.data.decode("ascii", "replace"))
        if turns is not None:
            turns.look()

    def joined(self) -> None:
        """See `MemberPart.joined`: look at the records of all keys soon."""
        for turns in self.turns.values():
            turns.look()

    def _rewrite(self) -> None:
        for turns in self.turns.values():
            turns.rewrite()


class FleetSlots(KeySlots):
    """The slots of one limit, as one worker asks for them."""

    def __init__(self, limits: FleetLimits, limit: str) -> None:
        self.most = 0
        """The number of slots of each key."""
        self._limits = limits
        self._limit = limit
        self._granted: Callable[[bytes], None] = _decline
        self._is_open = False
        self._turns: dict[bytes, KeyTurns] = {}

    def open(self, granted: Callable[[bytes], None]) -> None:
        """See `KeySlots.open`."""
        if self._is_open:
            raise ValueError(
                f"two schedules of this worker have fleet_limit={self._limit!r}: give their servers"
                f" the same Schedule object"
            )
        self._is_open, self._granted = True, granted

    def close(self) -> None:
        """See `KeySlots.close`."""
        self._is_open, self._granted = False, _decline
        for turns in self._turns.values():
            turns.note(0, 0)

    def note(self, key: bytes, running: int, asked: int) -> None:
        """See `KeySlots.note`."""
        turns = self._turns.get(key)
        if turns is None:
            if not (running or asked):
                return
            subject = self._limits.names.key(self._limit, key)
            turns = KeyTurns(self._limits, subject, key, self.most, self._grant)
            self._turns[key] = self._limits.turns[subject] = turns
            self._limits.tasks.start_soon(self._take_turns, subject, key)
        turns.note(running, asked)

    def _grant(self, key: bytes) -> None:
        self._granted(key)

    async def _take_turns(self, subject: str, key: bytes) -> None:
        await self._turns[key].run()
        del self._turns[key], self._limits.turns[subject]


def _decline(_key: bytes) -> None:
    """Let no goal begin."""
