"""Questions about the types of other participants (TypeLookup).

Only questions are sent here, and none are answered: the services of ROS tell the types of this
participant. A participant answers all that ask on one topic, so answers to others are left alone.
"""

from __future__ import annotations

from collections.abc import Sequence

from fibaction_transports.rtps.discovery import participant_data as bits
from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.discovery.remote_participant import RemoteParticipant
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import TypesAnswered
from fibaction_transports.rtps.messages import ids
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.type_questions import question_payload, read_answer
from fibaction_transports.rtps.qos import Qos

_EXCHANGE = Qos(depth=100)


class TypeLookup:
    """The writer of questions and the reader of answers, matched with all who answer."""

    def __init__(self, local: LocalEndpoints, shared: SharedParts) -> None:
        self._shared = shared
        questions = Guid(shared.prefix + ids.TYPE_QUESTIONS_WRITER)
        answers = Guid(shared.prefix + ids.TYPE_ANSWERS_READER)
        self._writer = DataWriter(questions, "TypeLookupRequest", "", _EXCHANGE, shared)
        self._reader = DataReader(answers, "TypeLookupReply", "", _EXCHANGE, shared, self._take)
        local.writers[questions.entity] = self._writer
        local.readers[answers.entity] = self._reader

    def match(self, participant: RemoteParticipant, now: float) -> None:
        """Exchange questions and answers with a participant, if it answers any."""
        data = participant.data
        if data.endpoints & bits.ANSWERS_TYPES == bits.ANSWERS_TYPES:
            reader = Guid(data.prefix + ids.TYPE_QUESTIONS_READER)
            self._writer.match(reader, participant.discovery, _EXCHANGE, now)
            writer = Guid(data.prefix + ids.TYPE_ANSWERS_WRITER)
            self._reader.match(writer, participant.discovery, _EXCHANGE, data.vendor, now)

    def unmatch(self, prefix: bytes, now: float) -> None:
        """End the exchange with a participant."""
        self._writer.unmatch(Guid(prefix + ids.TYPE_QUESTIONS_READER), now)
        self._reader.unmatch(Guid(prefix + ids.TYPE_ANSWERS_WRITER))

    def ask(self, prefix: bytes, type_ids: Sequence[bytes], now: float) -> int:
        """Ask a participant about types, and return the number of the question: the event
        `TypesAnswered` has the answer. Return 0 if it does not answer such questions.
        """
        reader = Guid(prefix + ids.TYPE_QUESTIONS_READER)
        if reader not in self._writer.readers:
            return 0
        number = self._writer.last + 1
        to = Guid(prefix + ids.TYPE_ANSWERS_WRITER)
        payload = question_payload(self._writer.guid, number, to, type_ids)
        return self._writer.write(payload, now, only_to=reader)

    def _take(self, _: Guid, sample: Sample, now: float) -> None:
        try:
            answer = read_answer(sample.payload)
        except InvalidPacket:
            self._shared.counters.invalid += 1
            return
        if answer.asker == self._writer.guid:
            prefix = sample.writer.prefix
            self._shared.emit(TypesAnswered(prefix, answer.number, answer.types))
