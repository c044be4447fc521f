"""Submessages that wait to be sent, packed into as few datagrams as possible."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from msgspec import structs

from fibaction_transports.rtps.budgets import PeerBudget
from fibaction_transports.rtps.limits import RtpsCounters
from fibaction_transports.rtps.messages.encoder import packet_head, submessage_bytes
from fibaction_transports.rtps.messages.ids import UNKNOWN_ENTITY, UNKNOWN_PREFIX
from fibaction_transports.rtps.messages.locators import Address
from fibaction_transports.rtps.messages.submessages import (
    Data,
    DataFragment,
    Destination,
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


class _Queue:
    """The submessages for one route."""

    __slots__ = ("entries", "heartbeats", "samples")

    def __init__(self) -> None:
        self.entries: list[_Entry | None] = []
        """In order; None for a heartbeat that a newer one has replaced."""
        self.heartbeats: dict[tuple[bytes, bytes], int] = {}
        """The place of the newest heartbeat for each reader of each writer."""
        self.samples: dict[tuple[bytes, int], tuple[int, Data]] = {}
        """Each sample with its place, by its writer and its number."""


class Outbox:
    """The submessages that a participant wants to send, by their routes.

    They become bytes when a datagram is taken, so a large sample for several readers is not copied
    for each of them beforehand. A sample for several readers of one participant is sent once. Of
    several heartbeats of a writer for a reader, the newest is sent: it says what the others say,
    and asks for one acknowledgement.
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
        self._counters = counters
        self._waiting: dict[PeerRoute, _Queue] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, route: PeerRoute, submessage: Submessage, time: float | None = None) -> None:
        """Send a submessage after those that wait for the same route."""
        if self._count >= self._limit:
            self._counters.unsent += 1
            return
        self._count += 1
        queue = self._waiting.get(route)
        if queue is None:
            queue = self._waiting[route] = _Queue()
        if isinstance(submessage, WriterHeartbeat):
            self._replace(queue, submessage)
        elif isinstance(submessage, Data) and self._is_joined(queue, submessage, time):
            return
        queue.entries.append(_Entry(submessage, time))

    def has_heartbeat(self, route: PeerRoute, reader: bytes, writer: bytes) -> bool:
        """Return whether a heartbeat of a writer for a reader waits."""
        queue = self._waiting.get(route)
        return queue is not None and (reader, writer) in queue.heartbeats

    def _replace(self, queue: _Queue, heartbeat: WriterHeartbeat) -> None:
        """Take the older heartbeat of the same ends away."""
        ends = heartbeat.reader, heartbeat.writer
        replaced = queue.heartbeats.get(ends)
        if replaced is not None:
            queue.entries[replaced] = None
            self._count -= 1
        queue.heartbeats[ends] = len(queue.entries)

    def _is_joined(self, queue: _Queue, data: Data, time: float | None) -> bool:
        """Return whether the sample waits already, and now goes to this reader as well."""
        here = len(queue.entries), data
        at, first = queue.samples.setdefault((data.writer, data.number), here)
        if first is data:
            return False
        if first.reader != data.reader:
            queue.entries[at] = _Entry(structs.replace(first, reader=UNKNOWN_ENTITY), time)
        self._count -= 1
        return True

    def datagrams(self) -> Iterator[tuple[bytes, Address]]:
        """Take the datagrams one by one, with the addresses that they are for."""
        while self._waiting:
            route = next(iter(self._waiting))
            queue = self._waiting.pop(route)
            entries = [each for each in queue.entries if each is not None]
            self._count -= len(entries)
            budget = self._budgets.get(route.prefix)
            for datagram in self._packed(route, entries):
                if budget is None or budget.may_send(len(datagram)):
                    yield datagram, route.address
                else:
                    self._counters.withheld += 1

    def _packed(self, route: PeerRoute, entries: list[_Entry]) -> Iterator[bytes]:
        first = self._head
        if route.prefix != UNKNOWN_PREFIX:
            first += submessage_bytes(Destination(route.prefix))
        parts, size, time, samples = [first], len(first), None, 0
        for entry in entries:
            part = submessage_bytes(entry.submessage)
            if (size + len(part) > PACKED or samples >= SAMPLES) and len(parts) > 1:
                yield b"".join(parts)
                parts, size, time, samples = [first], len(first), None, 0
            samples += isinstance(entry.submessage, Data)
            if entry.time != time and isinstance(entry.submessage, Data | DataFragment):
                time = entry.time
                parts.append(submessage_bytes(Timestamp(time)))
            parts.append(part)
            size += len(part)
        yield b"".join(parts)
