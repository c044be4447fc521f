"""Questions about the types of other participants, and the answers, as Fast DDS writes them."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.discovery import known_participants
from fibaction_transports.rtps.discovery.type_lookup import (
    question_payload,
    read_answer,
    read_type_id,
)
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import TypesAnswered
from fibaction_transports.rtps.messages import ids
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.messages.parameters import TYPE_INFORMATION, Parameters
from fibaction_transports.rtps.outbox import PeerRoute
from fibaction_transports.rtps.qos import Qos
from tests.transports.rtps.world import Node, World

# Recorded between two nodes of ROS 2 Kilted.
ASKER = Guid(bytes.fromhex("010f78fd300189f500000000000300c3"))
ANSWERER = Guid(bytes.fromhex("010f78fd8374ef7d00000000000301c3"))
TYPE = bytes.fromhex("f22a44dcf128eae659dd368b3408fa")
QUESTION = bytes.fromhex(
    "00070000010f78fd300189f500000000000300c3000000000d000000310000006464732e6275696c74696e2e544f53"
    "2e30313066373866643833373465663764303030303030303030303033303163330000000023000000d35282011b"
    "0000006560535c1300000001000000f22a44dcf128eae659dd368b3408fa"
)
HEAD = bytes.fromhex("00070000010f78fd300189f500000000000300c3000000000d000000")
ANSWER = HEAD + bytes.fromhex(
    "00000000d4000000d3528201cc00000000000000c4000000d14a805207000000010000006161610077658e5b"
    "0400000000000000"
)
UNKNOWN = HEAD + bytes.fromhex("0500000004000000ffffff7f")
INFORMATION = bytes.fromhex(
    "58000000011000502400000014000000f1ffe108329aab421ee173d8b7e6510055000000ffffffff0400000000000000"
    "021000502400000014000000f270dc0d0ad1f7950b49d06e8774ef00ab000000ffffffff0400000000000000"
)


def test_a_question_is_as_fast_dds_asks_it() -> None:
    assert question_payload(ASKER, 13, ANSWERER, [TYPE]) == QUESTION


def test_an_answer_has_the_number_of_its_question_and_the_types() -> None:
    assert read_answer(ANSWER) == (ASKER, 13, b"\x01\0\0\0aaa")
    assert read_answer(UNKNOWN) == (ASKER, 13, b"")
    other_call = ANSWER.replace(b"\xd3\x52\x82\x01", b"\xd3\x52\x82\x02")
    assert read_answer(other_call) == (ASKER, 13, b"")


@pytest.mark.parametrize("broken", [b"", ANSWER[:20], ANSWER[:50], b"\0\1" + ANSWER[2:]])
def test_a_broken_answer_is_invalid(broken: bytes) -> None:
    with pytest.raises(InvalidPacket):
        read_answer(broken)


def type_id(*information: bytes) -> bytes:
    return read_type_id(Parameters(tuple((TYPE_INFORMATION, one) for one in information)))


def test_an_endpoint_announces_the_id_of_its_type() -> None:
    assert type_id(INFORMATION) == bytes.fromhex("f270dc0d0ad1f7950b49d06e8774ef")


@pytest.mark.parametrize(
    "information",
    [b"", INFORMATION[:48], INFORMATION[:70], INFORMATION.replace(b"\xf2\x70", b"\xf1\x70")],
    ids=["empty", "minimal", "cut off", "another kind"],
)
def test_an_id_that_is_not_there_is_empty(information: bytes) -> None:
    assert type_id(information) == type_id() == b""


class Answers:
    """The two endpoints of a participant that answers questions about its types."""

    def __init__(self, node: Node, asking: Node, now: float) -> None:
        participant, shared = node.participant, node.participant._shared
        self.asked: list[bytes] = []
        reader = DataReader(
            Guid(participant.prefix + ids.TYPE_QUESTIONS_READER), "", "", Qos(), shared, self._take
        )
        writer = DataWriter(
            Guid(participant.prefix + ids.TYPE_ANSWERS_WRITER), "", "", Qos(), shared
        )
        participant._local.readers[reader.guid.entity] = reader
        participant._local.writers[writer.guid.entity] = writer
        (remote,) = participant.remote_participants
        prefix = asking.participant.prefix
        vendor, route = remote.data.vendor, remote.discovery
        reader.match(Guid(prefix + ids.TYPE_QUESTIONS_WRITER), route, Qos(), vendor, now)
        writer.match(Guid(prefix + ids.TYPE_ANSWERS_READER), route, Qos(), now)
        self.writer = writer

    def _take(self, _: Guid, sample: Sample, now: float) -> None:
        self.asked.append(sample.payload)


@pytest.fixture
def everybody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_participants, "ANSWERS_TYPES", 0)


@pytest.mark.usefixtures("everybody_answers")
def test_a_participant_is_asked_and_only_its_answer_to_this_question_is_told() -> None:
    world = World()
    one, other = world.pair()
    prefix = other.participant.prefix
    answers = Answers(other, one, world.now)
    number = one.participant.ask_types(prefix, [TYPE], world.now)
    asker = Guid(one.participant.prefix + ids.TYPE_QUESTIONS_WRITER)
    world.run(1)
    assert answers.asked == [question_payload(asker, number, answers.writer.guid, [TYPE])]

    invalid = one.participant.counters.invalid
    for payload in (ANSWER, b"broken", ANSWER.replace(ASKER, asker)):
        answers.writer.write(payload, world.now)
    world.run(1)
    assert one.all(TypesAnswered) == [TypesAnswered(prefix, 13, b"\x01\0\0\0aaa")]
    assert one.participant.counters.invalid == invalid + 1

    other.participant.close(world.now)
    world.run(1)
    assert one.participant.ask_types(prefix, [TYPE], world.now) == 0


def test_an_answer_to_nobody_in_particular_is_for_the_reader_of_answers() -> None:
    one = World().join().participant
    writer = Guid(bytes(12) + ids.TYPE_ANSWERS_WRITER)
    reader = one._local.readers[ids.TYPE_ANSWERS_READER]
    reader.match(writer, PeerRoute(("127.0.0.1", 1)), Qos(), ids.FAST_DDS, 0.0)
    assert one._local.matched(ids.UNKNOWN_ENTITY, writer) == (reader.proxies[writer],)
