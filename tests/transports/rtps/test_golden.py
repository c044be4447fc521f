"""Packets of Fast DDS 3 and Cyclone DDS 11, as they were received on a loopback interface."""

from __future__ import annotations

from pathlib import Path

from fibaction_transports.rtps.discovery.endpoint_discovery import read_endpoint
from fibaction_transports.rtps.discovery.known_participants import read_participant
from fibaction_transports.rtps.endpoints.sample import received_sample
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.codec import read_packet, submessage_bytes
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS, FAST_DDS, Guid
from fibaction_transports.rtps.messages.parameters import read_list
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    Destination,
    FragmentNack,
    NumberSet,
    Packet,
    Timestamp,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Reliability
from tests.transports.rtps.world import TYPE

E = b"\0\0\3\xc7"


def packets() -> dict[str, bytes]:
    text = Path(__file__).with_name("golden.txt").read_text()
    found = [block.split("\n", 1) for block in text.strip().split("\n\n")]
    return {name: bytes.fromhex(content) for name, content in found}


GOLDEN = packets()


def read(name: str) -> Packet:
    return read_packet(GOLDEN[name])


def payload(packet: Packet) -> bytes | memoryview:
    """Return the payload of the one sample in a packet."""
    (data,) = (each for each in packet.submessages if isinstance(each, Data))
    assert data.payload is not None
    return data.payload


def test_a_participant_of_fast_dds_is_read() -> None:
    packet = read("fast_dds participant")
    assert packet.vendor == FAST_DDS
    participant = read_participant(read_list(payload(packet)), packet.vendor)
    assert participant.prefix == packet.prefix
    assert (participant.lease, participant.name, participant.domain) == (20, "/", 78)
    assert participant.user_data == b"enclave=/;\0"
    addresses = [each.udp_address for each in participant.discovery_locators]
    assert addresses == [("192.0.2.2", 26910)]
    assert participant.data_locators[0].kind == 19
    assert participant.endpoints == 0xFC3F


def test_a_participant_of_cyclone_is_read() -> None:
    packet = read("cyclone participant")
    assert packet.vendor == CYCLONE_DDS
    participant = read_participant(read_list(payload(packet)), packet.vendor)
    assert participant.prefix == packet.prefix
    assert (participant.lease, participant.endpoints) == (10, 0xFC3F)


def test_a_writer_of_cyclone_is_read() -> None:
    packet = read("cyclone writer")
    parameters = read_list(payload(packet))
    guid = parameters.guid(pids.ENDPOINT_GUID)
    assert guid is not None
    endpoint = read_endpoint(parameters, guid)
    assert endpoint.guid == Guid(packet.prefix + b"\0\0\2\3")
    assert (endpoint.topic, endpoint.type_name) == ("rt/from_stock", TYPE)
    assert (endpoint.qos.reliability, endpoint.qos.depth) == (Reliability.RELIABLE, 50)


def test_samples_are_read() -> None:
    fast, cyclone = read("fast_dds data"), read("cyclone data")
    destination, time, data = fast.submessages
    assert isinstance(destination, Destination)
    assert isinstance(time, Timestamp)
    assert isinstance(data, Data)
    sample = received_sample(Guid(fast.prefix + data.writer), data, time.time)
    assert sample.payload.startswith(b"\0\1\0\0\x09\0\0\0hello 37\0")
    assert sample.time is not None
    time, data, heartbeat = cyclone.submessages
    assert isinstance(data, Data)
    assert isinstance(heartbeat, WriterHeartbeat)
    sample = received_sample(Guid(cyclone.prefix + data.writer), data, None)
    assert sample.payload == b"\0\1\0\0\x09\0\0\0hello 20\0\0\0\0"
    assert (heartbeat.first, heartbeat.last) == (21, 21)
    assert data.reader == bytes(4)


def test_heartbeats_and_acknowledgements_are_read() -> None:
    heartbeat = read("fast_dds heartbeat").submessages[-1]
    assert heartbeat == WriterHeartbeat(E, b"\0\0\3\xc2", 1, 11, 1, False, False)
    assert read("fast_dds acknack").submessages[-1] == AckNack(
        E, b"\0\0\3\xc2", NumberSet(1, (1,)), 1, False
    )
    nacks = read("fast_dds fragment_nack").submessages
    assert isinstance(nacks[1], FragmentNack)
    assert isinstance(nacks[2], AckNack)
    beats = read("cyclone heartbeats").submessages[1:]
    assert [type(each) for each in beats] == [WriterHeartbeat] * 3
    assert isinstance(read("cyclone acknack").submessages[-1], AckNack)


def test_an_assertion_of_cyclone_is_read() -> None:
    packet = read("cyclone assertion")
    assert bytes(payload(packet)[4:20]) == packet.prefix + b"\0\0\0\1"


def test_what_cyclone_and_this_library_write_is_the_same() -> None:
    for name in ("cyclone heartbeats", "cyclone acknack", "cyclone assertion", "cyclone data"):
        packet = read(name)
        for submessage in packet.submessages:
            if not isinstance(submessage, Timestamp):  # which has more digits than a float
                assert submessage_bytes(submessage) in GOLDEN[name]
