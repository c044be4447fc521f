"""The liveliness of writers: assertions of this participant, and silent writers of others."""

from __future__ import annotations

import math
import struct

from msgspec import Struct

from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.endpoints.sample import Sample, StoredSample, padded
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import LivelinessChanged
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE, Guid
from fibaction_transports.rtps.qos import Liveliness, Qos

ASSERTIONS_PER_LEASE = 3
"""Assertions within the shortest lease: two of them may be lost."""
SHORTEST_ASSERTION = 0.01
"""The shortest time between two assertions, in seconds."""
SHORTEST_FOLLOWED = 0.01
"""The shortest lease that is followed, in seconds."""

_LITTLE = b"\x00\x01\x00\x00"
_KIND_PLACE = 4 + PREFIX_SIZE
_KINDS = {
    b"\x00\x00\x00\x01": Liveliness.AUTOMATIC,
    b"\x00\x00\x00\x02": Liveliness.BY_PARTICIPANT,
}
_ASSERTION = b"\x00\x00\x00\x01" + struct.pack("<I", 1) + b"\x00"


class _Followed(Struct):
    """A matched writer whose lease is finite."""

    reader: Guid
    writer: Guid
    kind: Liveliness
    lease: float
    heard: float
    is_alive: bool = True


class _FollowedParticipant(Struct):
    """The followed writers of one participant."""

    writers: dict[Guid, dict[Guid, _Followed]] = {}
    """By the writer, and by the reader that it is matched with."""
    asserted: dict[Liveliness, float] = {}
    """The times at which all its writers of a kind were last shown to be alive."""
    silent: dict[tuple[Guid, Guid], _Followed] = {}
    """Those that are not alive."""

    def due(self, followed: _Followed) -> float:
        """Return the time at which a writer is not alive any more."""
        heard = max(followed.heard, self.asserted.get(followed.kind, followed.heard))
        return heard + followed.lease


class WriterLiveliness:
    """Follows the matched writers that promise to show that they are alive.

    What a participant asserts for all its writers is noted once, not for each of them.
    """

    def __init__(self, shared: SharedParts) -> None:
        self._shared = shared
        self._participants: dict[bytes, _FollowedParticipant] = {}

    def follow(self, reader: Guid, writer: Guid, qos: Qos, now: float) -> None:
        """Follow a writer for a reader that is matched with it."""
        if qos.liveliness_lease < math.inf:
            lease = max(qos.liveliness_lease, SHORTEST_FOLLOWED)
            followed = _Followed(reader, writer, qos.liveliness, lease, now)
            participant = self._participants.setdefault(writer.prefix, _FollowedParticipant())
            participant.writers.setdefault(writer, {})[reader] = followed
            self._shared.timers.set_earlier(self.on_leases_due, now + lease)

    def forget(self, reader: Guid, writer: Guid) -> None:
        """Follow a writer no longer."""
        participant = self._participants.get(writer.prefix)
        if participant is None or writer not in participant.writers:
            return
        participant.writers[writer].pop(reader, None)
        participant.silent.pop((reader, writer), None)
        if not participant.writers[writer]:
            del participant.writers[writer]
        if not participant.writers:
            del self._participants[writer.prefix]

    def receive(self, sample: Sample, now: float) -> None:
        """Take an assertion of a participant: it holds for all its writers of one kind."""
        kind = _KINDS.get(sample.payload[_KIND_PLACE : _KIND_PLACE + 4])
        prefix = sample.payload[4:_KIND_PLACE]
        participant = self._participants.get(prefix)
        if participant is not None and kind is not None and prefix == sample.writer.prefix:
            self._hear_all(participant, kind, now)

    def hear(self, prefix: bytes, writer: Guid, now: float) -> None:
        """Note that a writer of a participant has sent something that shows that it is alive."""
        participant = self._participants.get(prefix)
        if participant is None:
            return
        for followed in participant.writers.get(writer, {}).values():
            followed.heard = now
            if not followed.is_alive:
                self._revive(participant, followed, now)
        participant.asserted[Liveliness.BY_PARTICIPANT] = now
        if participant.silent:
            self._hear_all(participant, Liveliness.BY_PARTICIPANT, now)

    def on_leases_due(self, now: float) -> None:
        """Tell of the writers that have been silent for their leases."""
        earliest = math.inf
        for participant in self._participants.values():
            for readers in participant.writers.values():
                for followed in readers.values():
                    if followed.is_alive and (due := participant.due(followed)) > now:
                        earliest = min(earliest, due)
                    elif followed.is_alive:
                        self._tell_silent(participant, followed)
        if earliest < math.inf:
            # Many leases that end one shortly after the other are looked at together.
            when = max(earliest, now + SHORTEST_FOLLOWED)
            self._shared.timers.set(self.on_leases_due, when)

    def _tell_silent(self, participant: _FollowedParticipant, followed: _Followed) -> None:
        followed.is_alive = False
        participant.silent[followed.reader, followed.writer] = followed
        self._shared.emit(LivelinessChanged(followed.reader, followed.writer, is_alive=False))

    def _hear_all(self, participant: _FollowedParticipant, kind: Liveliness, now: float) -> None:
        participant.asserted[kind] = now
        for followed in [each for each in participant.silent.values() if each.kind == kind]:
            self._revive(participant, followed, now)

    def _revive(self, participant: _FollowedParticipant, followed: _Followed, now: float) -> None:
        followed.heard = now
        followed.is_alive = True
        del participant.silent[followed.reader, followed.writer]
        self._shared.emit(LivelinessChanged(followed.reader, followed.writer, is_alive=True))
        self._shared.timers.set_earlier(self.on_leases_due, now + followed.lease)


class Assertions:
    """Asserts that this participant is alive, as often as its writers promise.

    Participants are told that have a reader of such a writer: with many participants, all of which
    tell all others several times a second, this would be most of what each of them does.
    """

    def __init__(self, writer: DataWriter, local: LocalEndpoints, shared: SharedParts) -> None:
        self._writer = writer
        self._local = local
        self._shared = shared
        self._pause = math.inf

    def plan(self, now: float) -> None:
        """Assert as often as the writers of this participant promise; never if none does.

        Writers that are not automatic are alive as long as they send samples.
        """
        leases = (writer.qos.liveliness_lease for writer in self._promising())
        shortest = min(leases, default=math.inf)
        self._pause = max(shortest / ASSERTIONS_PER_LEASE, SHORTEST_ASSERTION)
        if shortest < math.inf:
            self._shared.timers.set_earlier(self.on_assertion_due, now)
        else:
            self._shared.timers.cancel(self.on_assertion_due)

    def on_assertion_due(self, now: float) -> None:
        """Assert that the writers of this participant are alive."""
        told = {reader.prefix for writer in self._promising() for reader in writer.readers}
        if told:
            payload = padded(_LITTLE + self._shared.prefix + _ASSERTION)
            self._writer.write_sample(StoredSample(payload=payload), now, only_at=told)
        self._shared.timers.set(self.on_assertion_due, now + self._pause)

    def _promising(self) -> list[DataWriter]:
        """Return the writers whose liveliness is to be shown by assertions."""
        return [
            writer
            for writer in self._local.user_writers()
            if writer.qos.liveliness == Liveliness.AUTOMATIC
            and writer.qos.liveliness_lease < math.inf
        ]
