"""The endpoints of this participant: those of the user's topics, and those of discovery."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

from fibaction_transports.rtps.discovery import known_participants as bits
from fibaction_transports.rtps.discovery.known_participants import (
    ParticipantData,
    RemoteParticipant,
)
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.endpoints.writer_proxy import WriterProxy
from fibaction_transports.rtps.messages import ids
from fibaction_transports.rtps.messages.ids import BUILTIN, UNKNOWN_ENTITY, Guid, is_builtin
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.qos import Durability, Qos

_BUILTIN_READERS = {0xC2: b"\xc7", 0xC3: b"\xc4"}
"""The kinds of the readers of discovery, by those of its writers: with a key, and without one."""


class LocalEndpoints:
    """The endpoints of a participant, by their entities."""

    def __init__(self) -> None:
        self.writers: dict[bytes, DataWriter] = {}
        self.readers: dict[bytes, DataReader] = {}

    def user_writers(self) -> list[DataWriter]:
        """Return the writers of the user's topics."""
        return [found for entity, found in self.writers.items() if not is_builtin(entity)]

    def user_readers(self) -> list[DataReader]:
        """Return the readers of the user's topics."""
        return [found for entity, found in self.readers.items() if not is_builtin(entity)]

    def matched(self, entity: bytes, writer: Guid) -> Sequence[WriterProxy]:
        """Return what takes something of a writer, at the matched readers that it is for."""
        if entity == UNKNOWN_ENTITY:
            if writer[-1] & BUILTIN != BUILTIN:
                readers = self.readers.values()
                return [each.proxies[writer] for each in readers if writer in each.proxies]
            entity = writer.entity[:3] + _BUILTIN_READERS.get(writer[-1], b"\xc7")
        reader = self.readers.get(entity)
        if reader is None or writer not in reader.proxies:
            return ()
        return (reader.proxies[writer],)

    def close(self) -> None:
        """Let every endpoint forget what it is matched with."""
        for writer in self.writers.values():
            writer.close()
        for reader in self.readers.values():
            reader.close()


SampleHandler: TypeAlias = Callable[[Sample, float], None]

_QOS = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)


class _BuiltinTopic(NamedTuple):
    """A writer of discovery and its reader, and the bits that say that a participant has them."""

    topic: str
    writer: bytes
    reader: bytes
    announcer: int
    detector: int


PUBLICATIONS = _BuiltinTopic(
    "DCPSPublication",
    ids.PUBLICATIONS_WRITER,
    ids.PUBLICATIONS_READER,
    bits.PUBLICATIONS_ANNOUNCER,
    bits.PUBLICATIONS_DETECTOR,
)
SUBSCRIPTIONS = _BuiltinTopic(
    "DCPSSubscription",
    ids.SUBSCRIPTIONS_WRITER,
    ids.SUBSCRIPTIONS_READER,
    bits.SUBSCRIPTIONS_ANNOUNCER,
    bits.SUBSCRIPTIONS_DETECTOR,
)
LIVELINESS = _BuiltinTopic(
    "DCPSParticipantMessage",
    ids.LIVELINESS_WRITER,
    ids.LIVELINESS_READER,
    bits.LIVELINESS_ANNOUNCER,
    bits.LIVELINESS_DETECTOR,
)
_PAIRS = (PUBLICATIONS, SUBSCRIPTIONS, LIVELINESS)


class BuiltinEndpoints:
    """A writer and a reader for each topic of discovery, matched with every participant."""

    def __init__(
        self,
        local: LocalEndpoints,
        shared: SharedParts,
        *,
        on_endpoint: SampleHandler,
        on_assertion: SampleHandler,
    ) -> None:
        self._shared = shared
        self._writers: dict[_BuiltinTopic, DataWriter] = {}
        self._readers: dict[_BuiltinTopic, DataReader] = {}
        for pair in _PAIRS:
            handler = on_assertion if pair is LIVELINESS else on_endpoint
            writer = DataWriter(Guid(shared.prefix + pair.writer), pair.topic, "", _QOS, shared)
            reader = DataReader(
                Guid(shared.prefix + pair.reader),
                pair.topic,
                "",
                _QOS,
                shared,
                self._checked(handler),
            )
            self._writers[pair] = local.writers[pair.writer] = writer
            self._readers[pair] = local.readers[pair.reader] = reader

    @property
    def publications(self) -> DataWriter:
        """The writer that announces writers."""
        return self._writers[PUBLICATIONS]

    @property
    def subscriptions(self) -> DataWriter:
        """The writer that announces readers."""
        return self._writers[SUBSCRIPTIONS]

    @property
    def liveliness(self) -> DataWriter:
        """The writer that asserts liveliness."""
        return self._writers[LIVELINESS]

    def match(self, participant: RemoteParticipant, now: float) -> None:
        """Exchange discovery with a participant, as far as it has the endpoints for it."""
        data = participant.data
        for pair in _PAIRS:
            if data.endpoints & pair.detector:
                reader = Guid(data.prefix + pair.reader)
                self._writers[pair].match(reader, participant.discovery, _QOS, now)
            if data.endpoints & pair.announcer:
                writer = Guid(data.prefix + pair.writer)
                own = self._readers[pair]
                own.match(writer, participant.discovery, _QOS, data.vendor, now)

    def unmatch(self, prefix: bytes, now: float) -> None:
        """End the exchange with a participant."""
        for pair in _PAIRS:
            self._writers[pair].unmatch(Guid(prefix + pair.reader), now)
            self._readers[pair].unmatch(Guid(prefix + pair.writer))

    def has_all(self, data: ParticipantData) -> bool:
        """Return whether all announcements of a participant's endpoints have come, as far as it
        has told.
        """
        return all(
            self._readers[pair].is_complete(Guid(data.prefix + pair.writer))
            for pair in (PUBLICATIONS, SUBSCRIPTIONS)
            if data.endpoints & pair.announcer
        )

    def _checked(self, handler: SampleHandler) -> Callable[[Guid, Sample, float], None]:
        """Return a callback for samples, which drops and counts those that are broken."""

        def take(_: Guid, sample: Sample, now: float) -> None:
            try:
                handler(sample, now)
            except InvalidPacket:
                self._shared.counters.invalid += 1

        return take
