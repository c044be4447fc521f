"""Questions about the types of other participants (TypeLookup).

Only questions are sent here, and none are answered: the services of ROS tell the types of this
participant. A participant answers all that ask on one topic, so answers to others are left alone.

A type is named by its ID: a byte for its kind, and 14 bytes of a hash. The messages are
little-endian CDR of version 2, which Fast DDS 3 uses: its own questions and answers were
recorded for the tests. https://www.omg.org/spec/DDS-XTypes/1.3 has the types.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from fibaction_transports.rtps.discovery import known_participants as bits
from fibaction_transports.rtps.discovery.known_participants import RemoteParticipant
from fibaction_transports.rtps.discovery.local_endpoints import LocalEndpoints
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import TypesAnswered
from fibaction_transports.rtps.messages import ids
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.layout import InvalidPacket, Layout, halves
from fibaction_transports.rtps.messages.parameters import TYPE_INFORMATION, Parameters
from fibaction_transports.rtps.qos import Qos

COMPLETE: Final = 0xF2
"""The kind of the types that have the names of their fields."""
TYPE_ID_SIZE: Final = 15

_ENCAPSULATION = b"\x00\x07\x00\x00"
_INSTANCE = b"dds.builtin.TOS."
_GET_TYPES = 0x018252D3
_TYPE_IDS, _TYPES = 0x5C536065, 0x52804AD1
_COMPLETE_INFORMATION = 0x50001002
_MEMBER = Layout("II")
_ANSWER_HEAD = struct.Struct("<16siIi")
_ANSWER_BODY = struct.Struct("<IIIiIII")
_TYPES_PLACE = len(_ENCAPSULATION) + _ANSWER_HEAD.size + _ANSWER_BODY.size


class TypeAnswer(NamedTuple):
    """The answer to a question."""

    asker: Guid
    number: int
    """The number of the question."""
    types: bytes
    """The types with their IDs; empty if they are not told."""


def read_type_id(parameters: Parameters) -> bytes:
    """Return the ID of a type with its names, as an endpoint announces it; empty without one."""
    member, place = _MEMBER[parameters.order], 4
    for information in parameters.all(TYPE_INFORMATION):
        while place + member.size <= len(information):
            kind, size = member.unpack_from(information, place)
            if kind == _COMPLETE_INFORMATION:
                found = information[place + 12 : place + 12 + TYPE_ID_SIZE]
                return found if len(found) == TYPE_ID_SIZE and found[0] == COMPLETE else b""
            place += member.size + size + -size % 4
    return b""


def question_payload(asker: Guid, number: int, to: Guid, type_ids: Sequence[bytes]) -> bytes:
    """Return a question about types to a participant, by the writer of its answers."""
    instance = _INSTANCE + to.hex().encode() + b"\0"
    padding = bytes(-len(instance) % 4)
    ids = struct.pack("<I", len(type_ids)) + b"".join(type_ids)
    member = struct.pack("<II", _TYPE_IDS, len(ids)) + ids
    call = struct.pack("<III", 8 + len(member), _GET_TYPES, len(member)) + member
    head = asker + struct.pack("<iII", *halves(number), len(instance))
    return _ENCAPSULATION + head + instance + padding + call


def read_answer(payload: bytes) -> TypeAnswer:
    """Read an answer.

    Raises:
        InvalidPacket: It is too short, or of another encoding.
    """
    if not payload.startswith(_ENCAPSULATION[:2]):
        raise InvalidPacket("answer about types is not little-endian CDR of version 2")
    place = len(_ENCAPSULATION)
    try:
        asker, high, low, error = _ANSWER_HEAD.unpack_from(payload, place)
        types = b""
        if not error:
            _, call, _, code, _, member, size = _ANSWER_BODY.unpack_from(
                payload, place + _ANSWER_HEAD.size
            )
            if (call, code, member) == (_GET_TYPES, 0, _TYPES):
                types = payload[_TYPES_PLACE : _TYPES_PLACE + size]
    except struct.error as exc:
        raise InvalidPacket("answer about types is too short") from exc
    return TypeAnswer(Guid(asker), (high << 32) | low, types)


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
