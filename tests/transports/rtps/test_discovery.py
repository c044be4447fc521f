"""Participants find each other, match, and notice when one is gone."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from fibaction_transports.rtps.discovery.endpoint_discovery import EndpointData, endpoint_payload
from fibaction_transports.rtps.discovery.known_participants import (
    ParticipantData,
    participant_payload,
    reachable,
)
from fibaction_transports.rtps.endpoints.sample import DISPOSED, StoredSample
from fibaction_transports.rtps.events import (
    EndpointMatched,
    EndpointUnmatched,
    LivelinessChanged,
    ParticipantFound,
    ParticipantLost,
    QosMismatch,
)
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.codec import read_packet
from fibaction_transports.rtps.messages.ids import (
    FAST_DDS,
    LIVELINESS_WRITER,
    PARTICIPANT,
    PUBLICATIONS_READER,
    PUBLICATIONS_WRITER,
    SPDP_WRITER,
    UNKNOWN_ENTITY,
    Guid,
    Locator,
    udp_locator,
)
from fibaction_transports.rtps.messages.layout import BIG
from fibaction_transports.rtps.messages.parameters import (
    Parameters,
    list_payload,
    parameters_bytes,
    read_list,
)
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    NumberSet,
    SourceInfo,
    WriterHeartbeat,
)
from fibaction_transports.rtps.participant import Participant, ParticipantSettings
from fibaction_transports.rtps.qos import Durability, Liveliness, Qos, Reliability
from tests.transports.rtps.target import HOST, STRANGER, Target, announcement, hello, packet
from tests.transports.rtps.world import TOPIC, TYPE, Node, World, payload, reader_of, writer_of


def prefixes(node: Node) -> list[bytes]:
    return [event.prefix for event in node.all(ParticipantFound)]


def test_a_participant_is_incomplete_until_its_endpoints_and_its_samples_have_come() -> None:
    world = World()
    one, other = world.join(), world.join()
    kept = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)
    writer = writer_of(world, one, kept)
    writer.write(payload("kept"), world.now)
    reader = reader_of(world, other, kept)
    withheld = {PUBLICATIONS_WRITER, writer.guid.entity}

    def is_lost(datagram: bytes, address: object) -> bool:
        samples = (each for each in read_packet(datagram).submessages if isinstance(each, Data))
        return any(each.writer in withheld for each in samples)

    def incomplete(found_after: float = -1.0) -> int:
        return other.participant.incomplete_participants(found_after, reader)

    world.is_lost = is_lost
    world.run(1.0)
    assert len(other.participant.remote_participants) == 1
    assert (incomplete(), reader.is_complete(writer.guid)) == (1, False)
    withheld.remove(PUBLICATIONS_WRITER)
    assert world.run_until(lambda: writer.guid in reader.writers)
    world.run(0.1)
    assert (incomplete(), incomplete(found_after=world.now)) == (1, 0)
    withheld.clear()
    assert world.run_until(lambda: incomplete() == 0)
    assert other.texts(reader) == ["kept"]
    assert other.participant.count_remote_endpoints() == 1
    modest = reader_of(world, other, Qos(reliability=Reliability.BEST_EFFORT))
    assert modest.is_complete(writer.guid)


def test_participants_find_each_other_and_match_what_was_there_before_and_comes_later() -> None:
    world = World()
    one, other = world.join(), world.join()
    writer = one.participant.create_writer(TOPIC, TYPE, Qos(), world.now, user_data=b"hash")
    reader = reader_of(world, other)
    world.run(0.2)
    assert prefixes(one) == [other.participant.prefix]
    assert prefixes(other) == [one.participant.prefix]
    later = reader_of(world, other)
    world.run(0.2)
    assert list(writer.readers) == [reader.guid, later.guid]
    assert reader.writers == later.writers == [writer.guid]
    assert other.all(EndpointMatched) == [
        EndpointMatched(reader.guid, writer.guid),
        EndpointMatched(later.guid, writer.guid),
    ]
    (known,) = other.participant.remote_endpoints
    assert (known.topic, known.type_name, known.user_data) == (TOPIC, TYPE, b"hash")
    assert one.participant.vendor_of(other.participant.prefix) == b"\x01\x7f"
    assert one.participant.vendor_of(bytes(12)) is None
    assert one.participant.guid == one.participant.prefix + PARTICIPANT


def test_endpoints_of_another_topic_or_of_the_same_kind_do_not_match() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one, Qos())
    writer_of(world, other, Qos())
    reader_of(world, other, topic="rt/other")
    world.run(1.0)
    writer_of(world, one, Qos())
    world.run(1.0)
    assert not writer.readers
    assert one.told == [*one.all(ParticipantFound)]


def test_a_mismatch_is_told_with_its_reasons_at_both_ends() -> None:
    world = World()
    one, other = world.pair()
    writer = one.participant.create_writer(TOPIC, "another_type", Qos(), world.now)
    late = Qos(durability=Durability.TRANSIENT_LOCAL)
    reader = reader_of(world, other, late)
    world.run(1.0)
    durability = "durability: the writer offers volatile, the reader requests transient_local"
    assert other.all(QosMismatch) == [
        QosMismatch(
            reader.guid, writer.guid, (f"type: {TYPE} here, another_type there", durability)
        )
    ]
    assert one.all(QosMismatch) == [
        QosMismatch(
            writer.guid, reader.guid, (f"type: another_type here, {TYPE} there", durability)
        )
    ]


def test_a_removed_endpoint_matches_no_longer() -> None:
    world = World(3, loss=0.3)
    one, other = world.pair()
    writer = writer_of(world, one, Qos())
    reader = reader_of(world, other)
    assert world.run_until(lambda: bool(writer.readers and reader.writers))
    one.participant.remove(writer, world.now)
    one.participant.remove(writer, world.now)
    world.flush()
    writer.write(payload("too late"), world.now)
    assert (writer.readers, writer.kept) == ({}, 0)
    assert world.run_until(lambda: not reader.writers)
    assert other.texts(reader) == []
    assert other.all(EndpointUnmatched) == [EndpointUnmatched(reader.guid, writer.guid)]
    other.participant.remove(reader, world.now)
    world.run(5.0)
    assert one.participant.remote_endpoints == []


def test_a_participant_that_leaves_is_gone_at_once() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one, Qos())
    reader = reader_of(world, other)
    reader_of(world, one, topic="rt/other")
    world.run(1.0)
    one.participant.close(world.now)
    one.participant.close(world.now)
    world.run(0.01)
    assert other.all(ParticipantLost) == [ParticipantLost(one.participant.prefix, has_left=True)]
    assert other.all(EndpointUnmatched) == [EndpointUnmatched(reader.guid, writer.guid)]
    assert one.participant.next_deadline() == float("inf")
    datagrams = one.participant.counters.datagrams
    world.run(5.0)
    assert one.participant.counters.datagrams == datagrams
    assert list(one.participant.datagrams_to_send()) == []


def test_a_participant_that_is_silent_for_its_lease_is_gone() -> None:
    world = World()
    one, other = world.join(lease=4.0), world.join()
    writer = writer_of(world, one, Qos())
    reader = reader_of(world, other)
    world.run(10.0)
    assert reader.writers == [writer.guid]
    world.kill(one)
    world.run(2.5)
    assert reader.writers == [writer.guid]
    world.run(2.0)
    assert other.all(ParticipantLost) == [ParticipantLost(one.participant.prefix, has_left=False)]
    assert reader.writers == []


def test_a_participant_whose_announcements_are_lost_stays_while_it_sends_anything() -> None:
    world = World()
    one, other = world.join(lease=4.0), world.join()
    writer = writer_of(world, one, Qos())
    reader = reader_of(world, other)
    world.run(1.0)
    world.is_lost = lambda datagram, _: SPDP_WRITER in datagram
    for number in range(10):
        writer.write(payload(str(number)), world.now)
        world.run(1.5)
    assert other.texts(reader) == [str(number) for number in range(10)]
    assert other.all(ParticipantLost) == []
    world.run(3.0)
    assert [lost.has_left for lost in other.all(ParticipantLost)] == [False]


@pytest.mark.parametrize("loss", [0, 0.05])
def test_a_participant_that_was_killed_and_started_anew_is_found_within_a_second(
    loss: float,
) -> None:
    for seed in range(20):
        world = World(seed, loss=loss)
        one, other = world.pair()
        reader = reader_of(world, other)
        writer_of(world, one, Qos())
        world.run(3.0)
        assert len(reader.confirmed_writers) == 1
        world.kill(one)
        world.run(3.0)
        anew = world.join()
        writer = writer_of(world, anew, Qos())
        world.run(1.0)
        assert writer.guid in reader.confirmed_writers


def test_a_participant_is_answered_until_it_knows_us(target: Target) -> None:
    """Fast DDS misses the first answer if it comes before its receive side is up."""
    target.later(2.0)
    for _ in range(4):
        target.sent.clear()
        target.receive(hello())
        target.receive(hello())
        target.later(0.1)
        answers = [each for _, each in target.answers(Data) if each.writer == SPDP_WRITER]
        assert len(answers) == 1
    writer = target.participant._builtin.publications.guid.entity
    target.receive(AckNack(PUBLICATIONS_READER, writer, NumberSet(1), 1, True))
    target.later(0.9)
    target.sent.clear()
    target.receive(hello())
    assert target.sent == []


def test_a_participant_of_another_domain_or_tag_is_not_there(target: Target) -> None:
    target.receive(hello(domain=5))
    content = participant_payload(ParticipantData(prefix=STRANGER))
    tag = struct.pack("<HHI", pids.DOMAIN_TAG, 8, 4) + b"tag\0"
    target.receive(announcement(content[:4] + tag + content[4:]))
    assert target.counters.of_other_domains == 2
    assert target.node.told == []
    target.receive(hello(domain=0))
    assert prefixes(target.node) == [STRANGER]


def test_a_participant_without_an_address_that_can_be_reached_is_not_there(target: Target) -> None:
    target.receive(hello(discovery_locators=(Locator(16, 7410, bytes(16)),)))
    assert target.node.told == []
    assert target.counters.over_limit == 1


def ended(guid: bytes) -> Parameters:
    """Return the parameters that say that a participant or an endpoint is gone."""
    return Parameters(((pids.KEY_HASH, guid), (pids.STATUS_INFO, DISPOSED)))


def test_fast_dds_leaves_without_a_payload(target: Target) -> None:
    target.receive(hello())
    for _ in range(2):
        target.receive(announcement(None, ended(STRANGER + PARTICIPANT)))
        assert target.node.all(ParticipantLost) == [ParticipantLost(STRANGER, has_left=True)]


def test_a_participant_without_discovery_of_endpoints_is_there_alone(target: Target) -> None:
    target.receive(hello(endpoints=0))
    assert prefixes(target.node) == [STRANGER]
    assert target.participant._builtin.publications.readers == {}


def test_a_big_endian_participant_is_found(target: Target) -> None:
    items = (
        (pids.PARTICIPANT_GUID, STRANGER + PARTICIPANT),
        (pids.METATRAFFIC_UNICAST_LOCATOR, struct.pack(">iI12x4B", 1, 7410, 10, 0, 0, 99)),
        (pids.LEASE, struct.pack(">iI", 11, 0)),
    )
    content = b"\x00\x02\x00\x00" + parameters_bytes(Parameters(items, BIG))
    target.receive(announcement(content), order=BIG)
    (found,) = target.node.all(ParticipantFound)
    assert (found.prefix, found.name, found.user_data) == (STRANGER, "", b"")
    target.later(10.0)
    assert target.node.all(ParticipantLost) == []
    target.later(2.0)
    assert len(target.node.all(ParticipantLost)) == 1


def test_an_info_src_changes_the_sender(target: Target) -> None:
    target.receive(SourceInfo(FAST_DDS, STRANGER), hello(), prefix=b"\x01\x10relay     ")
    (found,) = target.node.all(ParticipantFound)
    assert (found.prefix, found.vendor) == (STRANGER, FAST_DDS)


BROKEN = {
    "of another participant": participant_payload(ParticipantData(prefix=bytes(12))),
    "without a name": b"\0\3\0\0\1\0\0\0",
    "that is not a list": b"\0\1\0\0\1\0\0\0",
    "without an end": b"\0\3\0\0",
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_announcement_is_dropped(name: str, target: Target) -> None:
    target.receive(announcement(BROKEN[name]))
    assert target.node.told == []
    assert target.counters.invalid == 1


# Endpoints of a peer of our own making


def endpoint(number: int, *, prefix: bytes = STRANGER, **changed: Any) -> EndpointData:
    fields: dict[str, Any] = {
        "guid": Guid(prefix + number.to_bytes(3, "big") + b"\3"),
        "topic": TOPIC,
        "type_name": TYPE,
        "qos": Qos(),
    }
    return EndpointData(**(fields | changed))


FIRST = endpoint(1)


def changed(pid: int, value: bytes | None) -> bytes:
    """Return the announcement of an endpoint with another value of a parameter, or without it."""
    items = dict(read_list(endpoint_payload(FIRST)).items)
    del items[pid]
    added = () if value is None else ((pid, value),)
    return list_payload(Parameters((*items.items(), *added)))


WRONG = {
    "of another participant": endpoint_payload(endpoint(1, prefix=bytes(12))),
    "without a topic": changed(pids.TOPIC_NAME, None),
    "without a type": changed(pids.TYPE_NAME, None),
    "of an unknown reliability": changed(pids.RELIABILITY, struct.pack("<IiI", 99, 0, 0)),
    "with a short durability": changed(pids.DURABILITY, b""),
    "without a name": b"\0\3\0\0\1\0\0\0",
}


@pytest.mark.parametrize("name", WRONG)
def test_the_announcement_of_an_endpoint_is_dropped_and_those_after_it_are_read(
    name: str, target: Target
) -> None:
    participant = target.participant
    target.announce(WRONG[name])
    assert target.counters.invalid == 1
    assert participant.remote_endpoints == []
    target.announce(endpoint_payload(FIRST))
    assert participant.remote_endpoints == participant.remote_endpoints_on(TOPIC) == [FIRST]
    assert participant.remote_endpoints_on("another topic") == []


def test_an_endpoint_may_change_and_may_leave_by_its_key_alone(target: Target) -> None:
    reader = reader_of(target.world, target.node)
    for _ in range(2):
        target.announce(endpoint_payload(FIRST))
    assert len(target.node.all(EndpointMatched)) == 1
    target.announce(endpoint_payload(endpoint(1, topic="rt/other")))
    assert target.node.all(EndpointUnmatched) == [EndpointUnmatched(reader.guid, FIRST.guid)]
    for _ in range(2):
        target.announce(None, ended(FIRST.guid))
        assert target.participant.remote_endpoints == []
    assert target.counters.invalid == 0


def test_endpoints_of_topics_with_keys_are_no_endpoints_of_ros(target: Target) -> None:
    target.announce(endpoint_payload(endpoint(1, guid=Guid(STRANGER + b"\0\0\1\x09"))))
    assert target.participant.remote_endpoints == []
    assert target.counters.invalid == 0


def test_an_endpoint_is_sent_to_at_its_own_address(target: Target) -> None:
    reader_of(target.world, target.node)
    locators = (Locator(19, 9, bytes(16)), udp_locator((HOST, 7000)))
    target.announce(endpoint_payload(endpoint(1, locators=locators)))
    assert (HOST, 7000) in [address for address, _ in target.answers(AckNack)]


def requests(target: Target) -> list[AckNack]:
    """Return what was requested of the first endpoint."""
    asked = [nack for _, nack in target.answers(AckNack)]
    return [nack for nack in asked if nack.writer == FIRST.guid.entity]


def test_a_heartbeat_that_comes_before_its_writer_is_known_is_answered(target: Target) -> None:
    """Fast DDS sends it before its discovery has told of the writer, and the next one in 3 s."""
    reader_of(target.world, target.node)
    target.receive(hello())
    target.receive(WriterHeartbeat(UNKNOWN_ENTITY, FIRST.guid.entity, 4, 5, 1))
    target.announce(endpoint_payload(FIRST))
    assert [each.missing for each in requests(target)] == [NumberSet(4, (4, 5))]


@pytest.mark.parametrize("has_heartbeat", [True, False])
@pytest.mark.parametrize("in_fragments", [True, False])
def test_samples_that_come_before_their_writer_is_known_are_requested_when_it_is(
    *, has_heartbeat: bool, in_fragments: bool, target: Target
) -> None:
    """A client of Fast DDS sends its first request so, and says what it has sent only in 3 s."""
    reader = reader_of(target.world, target.node)
    target.receive(hello())
    ends = reader.guid.entity, FIRST.guid.entity
    if has_heartbeat:
        target.receive(WriterHeartbeat(*ends, 1, 0, 1))
    for number in (2, 1):
        sample: Data | DataFragment = Data(*ends, number, bytes(8))
        if in_fragments:
            sample = DataFragment(*ends, number, 1, 1, 8, 16, memoryview(bytes(8)))
        target.receive(sample)
    target.announce(endpoint_payload(FIRST))
    (nack,) = requests(target)
    # Without a heartbeat, the writer is asked for one: Fast DDS answers this at once.
    assert nack.missing == (NumberSet(1, (1, 2)) if has_heartbeat else NumberSet(0))
    assert not nack.is_final


DOCKER, HOME, GLOBAL, LINK_LOCAL = (
    udp_locator((host, 7412)) for host in ("172.17.0.1", "192.168.0.7", "fd00::7", "fe80::7")
)


@pytest.mark.parametrize(
    ("locators", "heard_from", "reached"),
    [
        # This machine, over the loopback interface.
        ([Locator(19, 1, bytes(16)), HOME], "127.0.0.1", "127.0.0.1"),
        # Of several interfaces, the one that is sent from.
        ([DOCKER, HOME], "192.168.0.7", "192.168.0.7"),
        ([DOCKER, HOME], "192.168.0.8", "172.17.0.1"),
        ([], "192.168.0.8", None),
        # By the version of IP by which it was heard.
        ([HOME, GLOBAL], "192.168.0.7", "192.168.0.7"),
        ([HOME, GLOBAL], "fd00::7", "fd00::7"),
        ([HOME, GLOBAL], "fd00::8", "fd00::7"),
        ([HOME, GLOBAL], "::1", "::1"),
        ([HOME], "fd00::7", None),
        ([GLOBAL], "192.168.0.7", None),
        # A link-local address, only at the interface that it came from.
        ([LINK_LOCAL], "fe80::7%eth0", "fe80::7%eth0"),
        ([LINK_LOCAL], "fd00::7", None),
        ([LINK_LOCAL, GLOBAL], "fe80::9%eth0", "fd00::7"),
    ],
)
def test_a_participant_is_reached_at_one_of_its_addresses(
    locators: list[Locator], heard_from: str, reached: str | None
) -> None:
    assert reachable(locators, heard_from) == (reached and (reached, 7412))


def test_a_participant_with_addresses_of_ipv6_only_is_found_and_answered(target: Target) -> None:
    source = ("fd00::99", 7410)
    reader_of(target.world, target.node)
    target.receive(hello(STRANGER, source, ("fe80::99", 7410)), host=source[0])
    (remote,) = target.participant.remote_participants
    assert {address for address, _ in target.answers(Data)} == {source}
    assert all(map(remote.is_at, ("fd00::99", "::1")))
    assert not any(map(remote.is_at, ("fd00::98", "fe80::99")))


# Liveliness

ALIVE = Qos(liveliness_lease=1.0)


def test_a_writer_that_promises_to_be_alive_is_followed() -> None:
    world = World(2, loss=0.1)
    one, other = world.pair()
    writer = writer_of(world, one, ALIVE)
    reader = reader_of(world, other, ALIVE)
    assert world.run_until(lambda: bool(reader.writers))
    world.run(10.0)
    assert other.all(LivelinessChanged) == []
    world.kill(one)
    world.run(2.0)
    dead = LivelinessChanged(reader.guid, writer.guid, is_alive=False)
    assert other.all(LivelinessChanged) == [dead]
    world.nodes[one.host] = one
    world.run(3.0)
    assert other.all(LivelinessChanged)[1:] == [
        LivelinessChanged(reader.guid, writer.guid, is_alive=True)
    ]
    one.participant.remove(writer, world.now)
    world.run(5.0)
    assert len(other.all(LivelinessChanged)) == 2
    assert one.participant._shared.timers.next() > world.now + 0.5


def test_of_removed_readers_and_writers_nothing_is_told() -> None:
    world = World()
    one, other = world.pair()
    qos = Qos(liveliness=Liveliness.BY_TOPIC, liveliness_lease=1.0)
    removed_writer, writer = writer_of(world, one, qos), writer_of(world, one, qos)
    removed_reader, reader = reader_of(world, other, qos), reader_of(world, other, qos)
    assert world.run_until(lambda: len(reader.writers) == 2)
    one.participant.remove(removed_writer, world.now)
    other.participant.remove(removed_reader, world.now)
    world.run(0.1)
    world.kill(one)
    world.run(3.0)
    dead = LivelinessChanged(reader.guid, writer.guid, is_alive=False)
    assert other.all(LivelinessChanged) == [dead]


def test_an_assertion_in_the_name_of_another_participant_is_ignored() -> None:
    world = World()
    one, other, third = world.join(), world.join(), world.join()
    writer_of(world, one, ALIVE)
    reader = reader_of(world, other, ALIVE)
    assert world.run_until(lambda: bool(reader.writers))
    world.kill(one)
    content = b"\0\1\0\0" + one.participant.prefix + b"\0\0\0\1" + struct.pack("<I", 0)
    for _ in range(10):
        assertion = StoredSample(payload=content)
        third.participant._builtin.liveliness.write_sample(assertion, world.now)
        world.run(0.3)
    assert [event.is_alive for event in other.all(LivelinessChanged)] == [False]


def test_a_reader_with_a_longer_lease_misses_a_silent_writer_later() -> None:
    world = World(2)
    one, other = world.pair()
    writer_of(world, one, ALIVE)
    patient = reader_of(world, other, Qos(liveliness_lease=5 * ALIVE.liveliness_lease))
    assert world.run_until(lambda: bool(patient.writers))
    world.kill(one)
    world.run(3 * ALIVE.liveliness_lease)
    assert other.all(LivelinessChanged) == []
    world.run(3 * ALIVE.liveliness_lease)
    assert [event.is_alive for event in other.all(LivelinessChanged)] == [False]


@pytest.mark.parametrize("kind", [Liveliness.BY_PARTICIPANT, Liveliness.BY_TOPIC])
def test_a_sample_shows_that_its_writer_is_alive(kind: Liveliness) -> None:
    world = World()
    one, other = world.pair()
    qos = Qos(liveliness=kind, liveliness_lease=1.0)
    writer = writer_of(world, one, qos)
    second = writer_of(world, one, qos)
    writer_of(world, one, ALIVE)
    reader = reader_of(world, other)
    world.run(0.5)
    for _ in range(5):
        writer.write(payload("x"), world.now)
        world.run(0.5)
    lost = [event.writer for event in other.all(LivelinessChanged)]
    assert lost == ([] if kind == Liveliness.BY_PARTICIPANT else [second.guid])
    world.run(1.0)
    beat = WriterHeartbeat(reader.guid.entity, writer.guid.entity, 1, 5, 99, is_alive=True)
    prefix = one.participant.prefix
    other.participant.receive(packet(prefix, beat), (one.host, 7410), world.now)
    world.flush()
    assert LivelinessChanged(reader.guid, writer.guid, is_alive=True) in other.told


def test_only_participants_with_a_reader_of_a_promising_writer_are_told_that_it_is_alive() -> None:
    world = World()
    one, other, third = world.join(), world.join(), world.join()
    world.run(0.5)
    qos = Qos(liveliness_lease=0.3)
    writer = writer_of(world, one, qos)
    world.run(2.0)
    reader = reader_of(world, other, qos)
    reader_of(world, third, topic="rt/another")
    assert world.run_until(lambda: reader.writers == [writer.guid], 1)
    heard = world.heard(Data)

    def told(node: Node) -> int:
        samples = [each for _, to, each in heard if to[0] == node.host]
        return sum(each.writer == LIVELINESS_WRITER for each in samples)

    world.run(5.0)
    assert told(other) >= 40
    assert told(third) == 0
    assert other.all(LivelinessChanged) == []
    # One that comes to need it has it from then on.
    late = reader_of(world, third, qos)
    assert world.run_until(lambda: late.writers == [writer.guid], 1)
    world.run(5.0)
    assert told(third) >= 40
    assert third.all(LivelinessChanged) == []


def test_known_participants_are_not_announced_to_twice() -> None:
    world = World()
    one, other = world.pair()
    address = other.host, 7410
    settings = ParticipantSettings(
        discovery_addresses=(("10.0.0.9", 7410),),
        data_addresses=(("10.0.0.9", 7411),),
        announce_to=(address,),
    )
    third = Node(Participant(settings, world.now), "10.0.0.9")
    world.nodes[third.host] = third
    assert world.run_until(lambda: len(third.all(ParticipantFound)) == 1)
    world.run(10.0)
    heard = world.heard(Data)
    del world.nodes[one.host]
    world.run(30.0)
    announced = [to for _, to, each in heard if each.writer == SPDP_WRITER and to == address]
    assert 8 <= len(announced) <= 11


def test_many_participants_find_each_other_with_little_traffic() -> None:
    world, count = World(), 12
    nodes = list[Node]()
    for _ in range(count):
        node = world.join()
        nodes.append(node)
        for topic in range(5):
            reader_of(world, node, topic=f"rt/{topic}")
        world.run(0.01)
    others = count - 1
    assert world.run_until(
        lambda: all(node.participant.count_remote_endpoints() == 5 * others for node in nodes), 10
    )
    assert world.sent <= 20 * count * others
    world.run(20.0)
    sent = world.sent
    world.run(30.0)
    assert world.sent - sent <= 30 / 3 * count * (others + count) * 1.1
