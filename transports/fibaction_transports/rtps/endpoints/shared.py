"""The parts that all endpoints of a participant share, and samples that arrive in fragments."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from io import BytesIO

from fibaction_transports.rtps.endpoints.catch_up import AnswerTime
from fibaction_transports.rtps.events import Event
from fibaction_transports.rtps.limits import ByteAccount, PeerBudget, RtpsCounters, RtpsLimits
from fibaction_transports.rtps.messages.ids import OWN_VENDOR
from fibaction_transports.rtps.messages.layout import MAX_BITS
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.submessages import DataFragment, NumberSet
from fibaction_transports.rtps.outbox import Outbox
from fibaction_transports.rtps.timers import Timers

_OVERHEAD = 512
"""Bytes that are counted for an incomplete sample beside its content."""
_ARRIVED = 1
AT_ONCE = 4
"""Large samples in the memory of most programs: the newest two, and the message of each."""
SMALL = 2**17
"""Bytes of a sample from which on the C library takes its memory from the system, and gives it back
when it is freed, which costs as much as two copies. The GNU one keeps twice the largest block that
was ever freed, so a block is made and freed for the first of larger samples."""
LARGEST = 2**25 - 2**16
"""Bytes of the largest block that it looks at, with its head and the rest of its last page."""


class PartialSample:
    """One sample, some of whose fragments have not arrived."""

    def __init__(
        self, fragment: DataFragment, sender: bytes, home: dict[int, PartialSample]
    ) -> None:
        """Make room for the sample of a fragment from a participant, without its content.

        It is in its home, by its number, until it is complete or given up.
        """
        self.sender = sender
        self.number = fragment.number
        self.home = home
        self.inline_qos: Parameters | None = None
        self._size = fragment.sample_size
        self._content = BytesIO(bytes(fragment.sample_size))  # which gives its bytes without a copy
        self._fragment_size = fragment.fragment_size
        self._left = -(-fragment.sample_size // fragment.fragment_size)
        self._arrived = bytearray(self._left)
        self.requests = 0
        """Requests for missing fragments since the last one that came."""

    @property
    def size(self) -> int:
        """Bytes that are counted for it."""
        return self._size + len(self._arrived) + _OVERHEAD

    @property
    def is_complete(self) -> bool:
        """True if every fragment has arrived."""
        return not self._left

    def add(self, fragment: DataFragment) -> bool:
        """Put fragments into their places; return False if they are of another sample."""
        size = self._fragment_size
        if fragment.sample_size != self._size or fragment.fragment_size != size:
            return False
        if fragment.inline_qos is not None:
            self.inline_qos = fragment.inline_qos
        self.requests = 0
        first = fragment.first - 1
        self._content.seek(first * size)
        self._content.write(fragment.payload)
        last = first + fragment.count
        self._left -= self._arrived.count(0, first, last)
        self._arrived[first:last] = bytes([_ARRIVED]) * fragment.count
        return True

    def content(self) -> bytes:
        """Return the sample, of which each fragment has arrived."""
        return self._content.getvalue()

    def missing(self) -> NumberSet:
        """Return the numbers of missing fragments, as many as a request can name."""
        first = self._arrived.find(0)
        end = min(first + MAX_BITS, len(self._arrived))
        numbers = (at + 1 for at in range(first, end) if not self._arrived[at])
        return NumberSet(first + 1, tuple(numbers))


class PartialSamples:
    """The incomplete samples of all readers. If they need too much memory, one of the participant
    that holds most is given up: the one that has been without a new fragment for the longest time.
    """

    def __init__(self, limits: RtpsLimits) -> None:
        self._sample_limit = limits.sample
        self._limit = limits.incomplete
        self._largest = SMALL
        """The largest sample for which the memory is kept: see `SMALL`."""
        self._waiting: dict[bytes, OrderedDict[PartialSample, None]] = {}
        self._held_by: dict[bytes, int] = {}
        self.held = 0
        """Bytes that all of them need."""

    def start(
        self, fragment: DataFragment, sender: bytes, home: dict[int, PartialSample]
    ) -> PartialSample | None:
        """Put a new sample from a participant into its home; return None if it exceeds a limit."""
        if fragment.sample_size > self._sample_limit:
            return None
        if fragment.sample_size > self._largest:
            self._largest = fragment.sample_size
            bytes(min(AT_ONCE * self._largest, LARGEST))
        partial = PartialSample(fragment, sender, home)
        if partial.size > self._limit:
            return None
        while self.held + partial.size > self._limit:
            largest = max(self._held_by, key=self._held_by.__getitem__)
            self.remove(next(iter(self._waiting[largest])))
        self._hold(partial.sender, partial.size)
        self._waiting.setdefault(sender, OrderedDict())[partial] = None
        home[partial.number] = partial
        return partial

    def touch(self, partial: PartialSample) -> None:
        """Note that a fragment has arrived."""
        self._waiting[partial.sender].move_to_end(partial)

    def remove(self, partial: PartialSample) -> None:
        """Take a sample out of its home: it is complete, or not needed."""
        del self._waiting[partial.sender][partial]
        del partial.home[partial.number]
        self._hold(partial.sender, -partial.size)
        if not self._waiting[partial.sender]:
            del self._waiting[partial.sender]
            del self._held_by[partial.sender]

    def _hold(self, sender: bytes, size: int) -> None:
        self.held += size
        self._held_by[sender] = self._held_by.get(sender, 0) + size


_LARGEST_COUNT = 2**31 - 1


class SharedParts:
    """The parts of a participant that its endpoints use."""

    def __init__(
        self, prefix: bytes, limits: RtpsLimits, fragment_size: int, emit: Callable[[Event], None]
    ) -> None:
        self.prefix = prefix
        self.limits = limits
        self.fragment_size = fragment_size
        self.emit = emit
        self.counters = RtpsCounters()
        self.timers = Timers()
        self.budgets: dict[bytes, PeerBudget] = {}
        """The budget of each known participant, by its prefix."""
        self.outbox = Outbox(OWN_VENDOR, prefix, limits.outbox, self.budgets, self.counters)
        self.partials = PartialSamples(limits)
        self.held = ByteAccount(limits.held)
        self.answer_time = AnswerTime()
        self._count = 0

    def next_count(self) -> int:
        """Return the count of the next heartbeat or acknowledgement, larger than all before."""
        self._count = self._count % _LARGEST_COUNT + 1
        return self._count
