"""The liveliness of writers: assertions of this participant, and silent writers of others."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

from msgspec import Struct

from fibaction_transports.rtps.endpoints.history import StoredSample
from fibaction_transports.rtps.endpoints.sample import Sample, padded
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import LivelinessChanged
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE, Guid
from fibaction_transports.rtps.qos import Liveliness, Qos

ASSERTIONS_PER_LEASE = 3
"""Assertions within the shortest lease: two of them may be lost."""
SHORTEST_ASSERTION = 0.01
"""The shortest time between two assertions, in seconds."""

_LITTLE = b"\x00\x01\x00\x00"
_KIND_PLACE = 4 + PREFIX_SIZE
_KINDS = {
    b"\x00\x00\x00\x01": Liveliness.AUTOMATIC,
    b"\x00\x00\x00\x02": Liveliness.BY_PARTICIPANT,
}
_ASSERTION = b"\x00\x00\x00\x01" + struct.pack("<I", 1) + b"\x00"


class _Followed(Struct):
    """A matched writer whose lease is finite."""

    kind: Liveliness
    lease: float
    heard: float
    is_alive: bool = True


class WriterLiveliness:
    """Follows the matched writers that promise to show that they are alive."""

    def __init__(self, shared: SharedParts) -> None:
        self._shared = shared
        self._followed: dict[tuple[Guid, Guid], _Followed] = {}

    def follow(self, reader: Guid, writer: Guid, qos: Qos, now: float) -> None:
        """Follow a writer for a reader that is matched with it."""
        if qos.liveliness_lease < math.inf:
            followed = _Followed(qos.liveliness, qos.liveliness_lease, now)
            self._followed[reader, writer] = followed
            self._shared.timers.set_earlier(self.on_leases_due, now + followed.lease)

    def forget(self, reader: Guid, writer: Guid) -> None:
        """Follow a writer no longer."""
        self._followed.pop((reader, writer), None)

    def receive(self, sample: Sample, now: float) -> None:
        """Take an assertion of a participant: it holds for all its writers of one kind."""
        kind = _KINDS.get(sample.payload[_KIND_PLACE : _KIND_PLACE + 4])
        prefix = sample.payload[4:_KIND_PLACE]
        for (reader, writer), followed in self._followed.items():
            if writer.prefix == prefix == sample.writer.prefix and followed.kind == kind:
                self._hear(reader, writer, followed, now)

    def hear(self, writer: Guid, now: float) -> None:
        """Note that a writer has sent something that shows that it is alive."""
        for (reader, other), followed in self._followed.items():
            by_participant = followed.kind == Liveliness.BY_PARTICIPANT
            if other == writer or (by_participant and other.prefix == writer.prefix):
                self._hear(reader, other, followed, now)

    def on_leases_due(self, now: float) -> None:
        """Tell of the writers that have been silent for their leases."""
        earliest = math.inf
        for (reader, writer), followed in self._followed.items():
            due = followed.heard + followed.lease
            if followed.is_alive and due <= now:
                followed.is_alive = False
                self._shared.emit(LivelinessChanged(reader, writer, is_alive=False))
            elif followed.is_alive:
                earliest = min(earliest, due)
        if earliest < math.inf:
            self._shared.timers.set(self.on_leases_due, earliest)

    def _hear(self, reader: Guid, writer: Guid, followed: _Followed, now: float) -> None:
        followed.heard = now
        if not followed.is_alive:
            followed.is_alive = True
            self._shared.emit(LivelinessChanged(reader, writer, is_alive=True))
            self._shared.timers.set_earlier(self.on_leases_due, now + followed.lease)


class Assertions:
    """Asserts that this participant is alive, as often as its writers promise."""

    def __init__(self, writer: DataWriter, shared: SharedParts) -> None:
        self._writer = writer
        self._shared = shared
        self._pause = math.inf

    def plan(self, writers: Iterable[DataWriter], now: float) -> None:
        """Assert as often as the writers of this participant promise; never if none does.

        Writers that are not automatic are alive as long as they send samples.
        """
        leases = (
            writer.qos.liveliness_lease
            for writer in writers
            if writer.qos.liveliness == Liveliness.AUTOMATIC
        )
        shortest = min(leases, default=math.inf)
        self._pause = max(shortest / ASSERTIONS_PER_LEASE, SHORTEST_ASSERTION)
        if shortest < math.inf:
            self._shared.timers.set_earlier(self.on_assertion_due, now)
        else:
            self._shared.timers.cancel(self.on_assertion_due)

    def on_assertion_due(self, now: float) -> None:
        """Assert that the writers of this participant are alive."""
        payload = padded(_LITTLE + self._shared.prefix + _ASSERTION)
        self._writer.write_sample(StoredSample(payload=payload), now)
        self._shared.timers.set(self.on_assertion_due, now + self._pause)
