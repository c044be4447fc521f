"""Submessages that wait to be sent, packed into as few datagrams as possible."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from msgspec import Struct, structs

from fibaction_transports.rtps.limits import PeerBudget, RtpsCounters
from fibaction_transports.rtps.messages.codec import (
    DESTINATION_HEAD,
    packet_head,
    submessage_bytes,
    submessage_pieces,
)
from fibaction_transports.rtps.messages.ids import UNKNOWN_ENTITY, UNKNOWN_PREFIX, Address
from fibaction_transports.rtps.messages.submessages import (
    Data,
    DataFragment,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

PACKED = 64_000
"""The longest datagram with several submessages, in bytes."""
SAMPLES = 64
"""The most samples of one datagram: of discovery, a receiver like this one takes no more."""


class PeerRoute(NamedTuple):
    """An address, and the participant there that the submessages are for."""

    address: Address
    prefix: bytes = UNKNOWN_PREFIX


class _Entry(NamedTuple):
    """A submessage, and the time of its sample."""

    submessage: Submessage
    time: float | None


class _Queue(Struct):
    """The submessages for one route."""

    entries: list[_Entry | None] = []
    """In order; None for a heartbeat that a newer one has replaced."""
    heartbeats: dict[tuple[bytes, bytes], int] = {}
    """The index of the newest heartbeat for each reader of each writer."""
    samples: dict[tuple[bytes, int], tuple[int, Data]] = {}
    """Each sample with its index, by its writer and its number."""


class Outbox:
    """The submessages that a participant wants to send, by their routes.

    They become bytes when a datagram is taken, so a large sample for several readers is not copied
    for each of them beforehand. A sample for several readers of one participant is sent once. Of
    several heartbeats of a writer for a reader, the newest is sent: it says what the others say,
    and asks for one acknowledgement. Acknowledgements that may wait join the next datagram.
    """

    def __init__(
        self,
        vendor: bytes,
        prefix: bytes,
        limit: int,
        budgets: Mapping[bytes, PeerBudget],
        counters: RtpsCounters,
    ) -> None:
        self._head = packet_head(vendor, prefix)
        self._limit = limit
        self._budgets = budgets
        self.counters = counters
        self._waiting: dict[PeerRoute, _Queue] = {}
        self.owed: dict[PeerRoute, dict[Callable[[], None], None]] = defaultdict(dict)
        """Callbacks for the next datagram of each route, to which they may add."""
        self.count = 0
        """The number of submessages that wait."""

    def add(self, route: PeerRoute, submessage: Submessage, time: float | None = None) -> None:
        """Send a submessage after those that wait for the same route."""
        if self.count >= self._limit:
            self.counters.unsent += 1
            return
        self.count += 1
        queue = self._waiting.get(route)
        if queue is None:
            queue = self._waiting[route] = _Queue()
        if isinstance(submessage, WriterHeartbeat):
            # The older heartbeat of the same ends is not sent.
            ends = submessage.reader, submessage.writer
            replaced = queue.heartbeats.get(ends)
            if replaced is not None:
                queue.entries[replaced] = None
                self.count -= 1
            queue.heartbeats[ends] = len(queue.entries)
        elif isinstance(submessage, Data):
            here = len(queue.entries), submessage
            first = queue.samples.setdefault((submessage.writer, submessage.number), here)
            if first is not here:
                self.count -= 1
                self._join(queue, first, submessage, time)
                return
        queue.entries.append(_Entry(submessage, time))

    def has_heartbeat(self, route: PeerRoute, reader: bytes, writer: bytes) -> bool:
        """Return whether a heartbeat of a writer for a reader waits."""
        queue = self._waiting.get(route)
        return queue is not None and (reader, writer) in queue.heartbeats

    @staticmethod
    def _join(queue: _Queue, waiting: tuple[int, Data], data: Data, time: float | None) -> None:
        """Send a sample that waits already to this reader as well."""
        index, first = waiting
        if first.reader != data.reader:
            queue.entries[index] = _Entry(structs.replace(first, reader=UNKNOWN_ENTITY), time)

    def datagrams(self) -> Iterator[tuple[bytes, Address]]:
        """Take the datagrams one by one, with the addresses that they are for."""
        while self._waiting:
            route = next(iter(self._waiting))
            for acknowledge in self.owed.pop(route, ()):
                acknowledge()
            queue = self._waiting.pop(route)
            entries = [each for each in queue.entries if each is not None]
            self.count -= len(entries)
            budget = self._budgets.get(route.prefix)
            for datagram in self._packed(route, entries):
                if budget is None or budget.may_send(len(datagram)):
                    yield datagram, route.address
                else:
                    self.counters.withheld += 1

    def _packed(self, route: PeerRoute, entries: list[_Entry]) -> Iterator[bytes]:
        first = self._head
        if route.prefix != UNKNOWN_PREFIX:
            first += DESTINATION_HEAD + route.prefix
        parts: list[bytes | memoryview] = [first]
        size, time, samples = len(first), None, 0
        for entry in entries:
            head, payload = pieces = submessage_pieces(entry.submessage)
            more = len(head) + len(payload)
            if (size + more > PACKED or samples >= SAMPLES) and len(parts) > 1:
                yield b"".join(parts)
                parts = [first]
                size, time, samples = len(first), None, 0
            samples += isinstance(entry.submessage, Data)
            if entry.time != time and isinstance(entry.submessage, (Data, DataFragment)):
                time = entry.time
                parts.append(submessage_bytes(Timestamp(time)))
            parts += pieces
            size += more
        yield b"".join(parts)
