"""`Membership`: the lease of a worker, by which the fleet knows that it is there.

Theory of operation
-------------------

A worker joins by storing a `LeaseEntry` with a time to live, and stores it again three times in
that time. The brokers judge the time to live: when it is over, the other workers see a marker, and
take over the goals. So a worker must stop before that. It *fences* itself at `valid_until`: a
margin before the end of the lease, counted from the moment before the last successful renewal was
sent, by the monotonic clock of the event loop. No clock is ever compared with that of another
machine.

A fence makes all goals of the worker lost for it, and each part of the worker is told
(`MemberPart`): their executors are interrupted (`LostExecutors`), and another worker takes the
goals over (`takeover`). Then the worker joins again, with a new incarnation, as soon as the brokers
answer. A process that was frozen finds in its first turns that `valid_until` has passed: `check` is
called before each write.

While an executor blocks the event loop, a thread renews the lease in its place (`LeaseThread`):
otherwise another worker would run the goal while the first one still does. The thread sees that by
`fence_in_time`, which notes the time as long as the event loop runs, and takes the last entry as it
was stored. What both write is guarded by a lock. A lease that has ended is not renewed by it.

An answer that does not come says nothing. The worker tries again until the lease ends, and a write
that is refused after a lost answer may be its own: the entry has the incarnation of who wrote it.
"""

from __future__ import annotations

import math
import secrets
import time
from threading import Lock

from anyio import current_time, move_on_after, sleep

from fibaction import __version__
from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import ProtocolError, TransportError
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    INCARNATION_SIZE,
    LeaseEntry,
    encode,
    lease_entry,
)

MARGIN = 1 / 5
"""The part of a lease that a worker leaves unused, so that it has stopped when the lease ends."""
RENEWALS = 3
"""The number of renewals in the time of one lease."""
RESEND_PART = 1 / 6
"""The part of a lease after which a renewal that is not answered is sent again."""
BEATS = 6
"""The number of times in a lease at which the event loop notes that it runs, at least."""
BLOCKED_PART = 1 / 4
"""The part of a lease after which an event loop that has noted nothing counts as blocked."""
OVERDUE_PART = 2 / 5
"""The part of a lease that is left of its certain time when a blocked event loop is helped."""
CHANGE_INTERVAL = 1.0
"""Seconds between two renewals because something has changed."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds before the first and the later ones of repeated tries."""
LEFT_TTL = 5.0
"""Seconds that the end of a lease is remembered."""

logger = clean_logger("fibaction.nats")


class Term:
    """The time in which a lease is valid for certain, without I/O."""

    def __init__(self, lease: float) -> None:
        self.lease = lease
        self.valid_until = -math.inf
        """Time until which the lease is valid for certain."""
        self.renew_at = -math.inf
        """Time of the next renewal."""
        self._sent: float | None = None  # the first write whose answer has not come

    def sent(self, now: float) -> None:
        """Note that a renewal is sent now."""
        if self._sent is None:
            self._sent = now

    def stored(self) -> None:
        """Note that the lease is stored, by the earliest of the writes that were sent."""
        assert self._sent is not None
        self.extend(self._sent)
        self.renew_at = self._sent + self.lease / RENEWALS
        self._sent = None

    def extend(self, sent: float) -> None:
        """Note that the lease is stored by a write that was sent at that time."""
        self.valid_until = max(self.valid_until, sent + self.lease * (1 - MARGIN))

    def end(self) -> None:
        """Forget the lease."""
        self.valid_until = self.renew_at = -math.inf
        self._sent = None


class MemberPart:
    """A part of a worker that is told of the worker's membership."""

    def describe(self, entry: LeaseEntry) -> None:
        """Complete the lease before it is stored."""

    def fenced(self) -> None:
        """Let go of the goals: all of them are lost for this worker."""

    def joined(self) -> None:
        """Go on: the worker has joined the fleet again."""


class Membership:
    """The membership of one worker in its fleet."""

    def __init__(self, broker: Broker, names: FleetNames, worker: str, lease: float) -> None:
        self._broker = broker
        self._names = names
        self._subject = names.worker(worker)
        self.worker = worker
        self.incarnation = b""
        """The incarnation of this worker; empty while it is not in the fleet."""
        self.since = time.time_ns()
        self._parts: list[MemberPart] = []
        self._term = Term(lease)
        self._mine: set[bytes] = set()
        self._sequence = 0
        self._data = b""  # the lease as it was sent last
        self.alive_at = -math.inf
        """Time at which the event loop ran."""
        self._lock = Lock()  # for what a `LeaseThread` writes, too
        self._rest_until = -math.inf  # the end of the lease that was given up
        self._wanted = 0  # the number of changes so far
        self._stored = 0  # the number of those that the stored lease has
        self._changes = Notifier()
        self._news = Notifier()
        self._last_put = -math.inf

    @property
    def lease(self) -> float:
        """Seconds after which the worker counts as lost."""
        return self._term.lease

    @property
    def valid_until(self) -> float:
        """Time by the event loop's clock until which its goals belong to it for certain."""
        return self._term.valid_until

    def add(self, part: MemberPart) -> None:
        """Tell a part of the worker of the membership, after those that were added before."""
        self._parts.append(part)

    def check(self) -> bool:
        """Return whether the worker is in the fleet now; fence it if its time is over."""
        now = current_time()
        if self.incarnation and now >= self._term.valid_until:
            silent = now - self.alive_at
            is_blocked = silent > self.lease * BLOCKED_PART
            self._fence(
                f"its event loop has not run for {silent:.1f} s: the process was stopped, or an"
                " executor has blocked it in code that keeps Python's lock"
                if is_blocked
                else "the brokers did not answer in time"
            )
        return bool(self.incarnation)

    def note_change(self) -> None:
        """Store the lease again soon, because something in it has changed."""
        self._wanted += 1
        self._changes.notify()

    def rewrite(self) -> None:
        """Store the lease at once as the first one of a new stream: the old stream was lost."""
        self._sequence = 0
        self._last_put = -math.inf
        self.note_change()

    async def update(self) -> None:
        """Store the lease again at once, and wait until it is stored."""
        self._last_put = -math.inf
        self.note_change()
        wanted = self._wanted
        while self._stored < wanted:
            await self._news.wait()

    # Join

    async def join(self) -> None:
        """Join the fleet.

        The lease of a lost process of this name is waited for: it ends soon.

        Raises:
            TransportError: The name is in use, or the brokers do not answer.
        """
        deadline = current_time() + 2 * self.lease
        seen, first = 0, current_time()
        pause = FIRST_PAUSE
        while not self.incarnation:
            try:
                record = await self._broker.get(self._names.workers, self._subject)
                holder = self._holder(record)
                if holder is None:
                    await self._try_to_join(0 if record is None else record.sequence)
                    continue
                assert record is not None
                if seen and record.sequence != seen:
                    raise TransportError(
                        f"the worker name {excerpt(self.worker)!r} is in use in fleet"
                        f" {excerpt(self._names.fleet)!r}: give this worker another one"
                    )
                seen = record.sequence
            except BrokerAway as exc:
                if current_time() - first > self.lease:
                    raise TransportError(f"cannot join the fleet: {exc}") from exc
            if current_time() > deadline:
                raise TransportError(
                    f"cannot join the fleet: the lease of {excerpt(self.worker)!r} does not end"
                )
            await sleep(pause)
            pause = min(2 * pause, self.lease / RENEWALS / 2, LONGEST_PAUSE)

    def _holder(self, record: BrokerRecord | None) -> LeaseEntry | None:
        """Return the lease of another process under this name; None if there is none."""
        if record is None or not record.data:
            return None
        try:
            entry = lease_entry(record.data)
        except ProtocolError as exc:
            raise TransportError(f"cannot join the fleet: {exc}") from exc
        return entry if entry.incarnation and entry.incarnation not in self._mine else None

    async def _try_to_join(self, expected: int) -> None:
        incarnation = secrets.token_bytes(INCARNATION_SIZE)
        self._mine.add(incarnation)
        self._term.end()
        self._term.sent(current_time())
        self._sequence = 0
        change = self._wanted
        stored = await self._put(self._entry(incarnation), expected)
        if isinstance(stored, int):
            self._keep(stored, change)
            self.alive_at = current_time()
            if self.alive_at < self._term.valid_until:
                self.incarnation = incarnation
        elif stored.kind in (PutFailure.TOO_LARGE, PutFailure.FULL):
            raise TransportError(f"cannot join the fleet: {stored.text}")

    def _entry(self, incarnation: bytes) -> LeaseEntry:
        entry = LeaseEntry(self.worker, incarnation, self.since, self.lease, version=__version__)
        for part in self._parts:
            part.describe(entry)
        return entry

    async def _put(
        self, entry: LeaseEntry | None, expected: int, ttl: float | None = None
    ) -> int | PutError:
        """Store the lease, or delete it, and wait for the answer."""
        data = b"" if entry is None else encode(entry)
        self._data = data
        self._last_put = current_time()
        with move_on_after(self.lease * RESEND_PART):
            return await self._broker.put_and_wait(
                self._subject, data, expected=expected, ttl=ttl or self.lease
            )
        return PutError(PutFailure.UNKNOWN, "no answer")

    # Stay

    async def run(self) -> None:
        """Renew the lease, until canceled; fence the worker if that fails, and join again."""
        while True:
            if self.check():
                await self._wait()
                if self.check():
                    await self._renew_in_time()
            else:
                await self._join_again()

    async def fence_in_time(self) -> None:
        """Fence the worker as soon as its time is over, until canceled."""
        while True:
            is_in = self.check()
            now = self.alive_at = current_time()
            left = self._term.valid_until - now if is_in else LONGEST_PAUSE
            await sleep(min(left, self.lease / BEATS))

    async def _wait(self) -> None:
        """Wait for the time of the next renewal."""
        while (left := self._next() - current_time()) > 0:
            with move_on_after(left):
                await self._changes.wait()

    def _next(self) -> float:
        if self._stored < self._wanted:
            return min(self._last_put + CHANGE_INTERVAL, self._term.renew_at)
        return self._term.renew_at

    async def _renew_in_time(self) -> None:
        pause = FIRST_PAUSE
        while self.incarnation and not await self._renewed(self.incarnation):
            with move_on_after(pause):
                await self._changes.wait()
            pause = min(2 * pause, LONGEST_PAUSE)

    async def _renewed(self, incarnation: bytes) -> bool:
        """Store the lease again; return whether that is done, or in vain."""
        change = self._wanted
        self._term.sent(current_time())
        stored = await self._put(self._entry(incarnation), self._sequence)
        if self.incarnation != incarnation:
            return True
        if isinstance(stored, int):
            self._keep(stored, change)
            return True
        if stored.kind is not PutFailure.REFUSED:
            logger.warning("worker %r: the lease is not renewed: %s", self.worker, stored.text)
            return False
        try:
            record = await self._broker.get(self._names.workers, self._subject)
        except BrokerAway:
            return False
        if self.incarnation != incarnation:
            return True
        if record is None or record.sequence <= self._sequence:
            return False  # by a broker that is behind: sequences only grow
        if record.data and self._has(record, incarnation):
            self._keep(record.sequence, self._stored)
            return True
        self._fence("its lease has ended")
        return True

    @staticmethod
    def _has(record: BrokerRecord, incarnation: bytes) -> bool:
        try:
            return lease_entry(record.data).incarnation == incarnation
        except ProtocolError:
            return False

    def _keep(self, sequence: int, change: int) -> None:
        self._stored = change
        with self._lock:
            self._sequence = max(self._sequence, sequence)
            self._term.stored()
        self._news.notify()
        self.check()

    def _fence(self, why: str) -> None:
        logger.error("worker %r gives up its goals, and joins again: %s", self.worker, why)
        with self._lock:
            self.incarnation = b""
            # Until then no other worker takes the goals over: executors have that time to end.
            self._rest_until = self._term.valid_until + self._term.lease * MARGIN
            self._term.end()
        for part in self._parts:
            part.fenced()

    async def _join_again(self) -> None:
        await sleep(max(0.0, self._rest_until - current_time()))
        try:
            await self.join()
        except TransportError as exc:
            logger.warning("worker %r: %s", self.worker, exc)
            await sleep(LONGEST_PAUSE)
        else:
            logger.warning("worker %r has joined again", self.worker)
            for part in self._parts:
                part.joined()

    # In another thread, for an event loop that is blocked

    def is_blocked(self, now: float) -> bool:
        """Return whether the lease is to be renewed for an event loop that does not run."""
        left = self._term.valid_until - now
        is_due = 0 < left <= self.lease * OVERDUE_PART
        return bool(self.incarnation) and is_due and now - self.alive_at > self.lease * BLOCKED_PART

    async def renew_blocked(self, broker: Broker) -> None:
        """Store the lease again as it was stored last, by a connection of this thread's own."""
        incarnation, sequence = self.incarnation, self._sequence
        while True:
            # Always after the sequence: the event loop may run again, and have stored newer data.
            data, sent = self._data, current_time()
            if self.incarnation != incarnation:  # it was fenced, or leaves
                return
            stored = await broker.put_and_wait(
                self._subject, data, expected=sequence, ttl=self.lease
            )
            if isinstance(stored, int):
                break
            record = await broker.get(self._names.workers, self._subject)
            if record is None or record.sequence <= sequence or not self._has(record, incarnation):
                return  # the lease has ended, or the next try finds it
            sequence = record.sequence  # by a write whose answer the event loop has not read
        with self._lock:
            if self.incarnation == incarnation:
                self._sequence = max(self._sequence, stored)
                self._term.extend(sent)

    # Leave

    async def leave(self, *, is_clean: bool) -> None:
        """End the lease. `is_clean` says that the worker has no goals left.

        Then nobody has to look for them, which an entry without an incarnation tells.
        """
        incarnation, self.incarnation = self.incarnation, b""
        if not incarnation:
            return
        left = LeaseEntry(self.worker, b"", self.since, self.lease) if is_clean else None
        with move_on_after(self.lease, shield=True):
            while not isinstance(await self._put(left, self._sequence, LEFT_TTL), int):
                if not await self._found(incarnation):
                    return

    async def _found(self, incarnation: bytes) -> bool:
        """Return whether the lease of that incarnation is still there, and note its sequence."""
        try:
            record = await self._broker.get(self._names.workers, self._subject)
        except BrokerAway:
            return False
        if record is None or not record.data or not self._has(record, incarnation):
            return False
        self._sequence = record.sequence
        return True
