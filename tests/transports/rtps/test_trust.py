"""What is believed of a peer, and how much it can make a participant send, and to whom."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.discovery.remote_endpoints import EndpointData, endpoint_payload
from fibaction_transports.rtps.discovery.remote_participant import (
    ParticipantData,
    participant_payload,
)
from fibaction_transports.rtps.endpoints.history import History, StoredSample
from fibaction_transports.rtps.endpoints.reader import EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import DISPOSED, Sample
from fibaction_transports.rtps.endpoints.writer_proxy import MOST_REQUESTS
from fibaction_transports.rtps.events import (
    EndpointMatched,
    LivelinessChanged,
    ParticipantFound,
    ParticipantLost,
)
from fibaction_transports.rtps.limits import (
    MOST_REPAIRS,
    REPAIRS_AT_ONCE,
    REPAIRS_PER_SECOND,
    HostRates,
    PeerBudget,
    RtpsLimits,
)
from fibaction_transports.rtps.messages.ids import (
    PUBLICATIONS_READER,
    PUBLICATIONS_WRITER,
    SPDP_WRITER,
    SUBSCRIPTIONS_READER,
    SUBSCRIPTIONS_WRITER,
    UNKNOWN_ENTITY,
    Guid,
)
from fibaction_transports.rtps.messages.locators import Address, udp_locator
from fibaction_transports.rtps.messages.parameters import STATUS_INFO, Parameters
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
    SourceInfo,
    Submessage,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Durability, Liveliness, Qos, Reliability
from fibaction_transports.rtps.router import DISCOVERY_AT_ONCE
from tests.transports.rtps.test_bounds import Victim, packet
from tests.transports.rtps.world import TOPIC, TYPE, Node, World, payload, reader_of

STRANGER = b"\1\x0fa stranger"
HOST = "10.0.0.66"
THIRD = ("10.0.0.77", 7410)
"""The address of someone who has nothing to do with it."""


def announcement(prefix: bytes, *addresses: Address, data: tuple[Address, ...] = ()) -> Data:
    told = ParticipantData(
        prefix=prefix,
        lease=100.0,
        discovery_locators=tuple(map(udp_locator, addresses)),
        data_locators=tuple(map(udp_locator, data)),
    )
    return Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, participant_payload(told))


class Peers:
    """A participant, and what it sends to whom."""

    def __init__(self, limits: RtpsLimits | None = None) -> None:
        self.world = World()
        self.node: Node = self.world.join(limits=limits)
        self.sent: list[tuple[int, Address]] = []
        self.take()
        self.sent.clear()

    def receive(self, host: str, *of: Submessage, prefix: bytes = STRANGER) -> int:
        """Take submessages from a host; return the size of their datagram."""
        datagram = packet(prefix, *of)
        self.node.participant.receive(datagram, (host, 7410), self.world.now)
        self.take()
        return len(datagram)

    def take(self) -> None:
        self.node.told += self.node.participant.events()
        for datagram, address in self.node.participant.datagrams_to_send():
            self.sent.append((len(datagram), address))

    def later(self, seconds: float) -> None:
        end = self.world.now + seconds
        while (deadline := self.node.participant.next_deadline()) <= end:
            self.world.now = max(self.world.now, deadline)
            self.node.participant.handle_deadline(self.world.now)
            self.take()
        self.world.now = end

    def bytes_to(self, host: str) -> int:
        return sum(size for size, address in self.sent if address[0] == host)

    @property
    def here(self) -> Destination:
        """The proof of a sender that it has received something."""
        return Destination(self.node.participant.prefix)


# The way back


def test_a_participant_that_shows_nothing_is_sent_three_times_what_came() -> None:
    peers = Peers()
    received = peers.receive(HOST, announcement(STRANGER, (HOST, 7410)))
    peers.later(90.0)
    assert 0 < peers.bytes_to(HOST) <= 3 * received
    assert peers.node.participant.counters.withheld > 10
    sent = peers.bytes_to(HOST)
    received = peers.receive(HOST, announcement(STRANGER, (HOST, 7410)))
    peers.later(9.0)
    assert sent < peers.bytes_to(HOST) <= sent + 3 * received


def test_a_participant_that_names_this_one_has_received_something() -> None:
    peers = Peers()
    received = peers.receive(HOST, announcement(STRANGER, (HOST, 7410)))
    peers.receive(HOST, peers.here)
    peers.later(90.0)
    assert peers.bytes_to(HOST) > 10 * received


def test_who_announces_the_address_of_another_host_cannot_direct_much_to_it() -> None:
    peers = Peers()
    received = peers.receive(HOST, announcement(STRANGER, THIRD))
    received += peers.receive(HOST, peers.here)
    peers.later(90.0)
    assert 0 < peers.bytes_to(THIRD[0]) <= 3 * received


def test_of_several_addresses_the_one_of_the_sender_is_used() -> None:
    peers = Peers()
    peers.receive(HOST, announcement(STRANGER, THIRD, (HOST, 7410), data=(THIRD,)))
    peers.receive(HOST, peers.here)
    writer = peers.node.participant.create_writer(
        TOPIC, TYPE, Qos(reliability=Reliability.BEST_EFFORT), peers.world.now
    )
    for number, locators in enumerate([(), (udp_locator(THIRD),)], 1):
        data = EndpointData(
            guid=Guid(STRANGER + bytes([0, 0, number, 4])),
            topic=TOPIC,
            type_name=TYPE,
            qos=Qos(reliability=Reliability.BEST_EFFORT),
            locators=locators,
        )
        content = endpoint_payload(data)
        ends = SUBSCRIPTIONS_READER, SUBSCRIPTIONS_WRITER
        peers.receive(HOST, WriterHeartbeat(*ends, 1, 2, number), Data(*ends, number, content))
    assert len(writer.readers) == 2
    writer.write(payload("x"), peers.world.now)
    peers.take()
    peers.later(9.0)
    assert peers.bytes_to(THIRD[0]) == 0
    assert peers.bytes_to(HOST) > 0


# The name of another participant


def test_a_participant_is_not_ended_from_another_host() -> None:
    peers = Peers()
    peers.receive(HOST, announcement(STRANGER, (HOST, 7410)))
    leave = Data(UNKNOWN_ENTITY, SPDP_WRITER, 2, None, _leaving())
    peers.receive(THIRD[0], leave)
    assert peers.node.all(ParticipantLost) == []
    assert peers.node.participant.counters.forged == 1
    peers.receive(HOST, leave)
    assert len(peers.node.all(ParticipantLost)) == 1


def test_a_participant_may_send_from_each_address_that_it_announces_and_this_machine() -> None:
    for source in (THIRD[0], "127.0.0.1"):
        peers = Peers()
        peers.receive(HOST, announcement(STRANGER, (HOST, 7410), data=(THIRD,)))
        peers.receive(source, Data(UNKNOWN_ENTITY, SPDP_WRITER, 2, None, _leaving()))
        assert len(peers.node.all(ParticipantLost)) == 1


def test_samples_in_the_name_of_another_host_are_dropped() -> None:
    victim = Victim()
    forged = packet(
        b"\1\x0fan attacker"[:12],
        SourceInfo(b"\1\x7f", victim.peer.participant.prefix),
        WriterHeartbeat(*victim.ends, 2**40, 2**40, 99),
        Data(*victim.ends, 1, payload("forged")),
    )
    victim.node.participant.receive(forged, (HOST, 7410), victim.world.now)
    victim.answer()
    assert victim.node.participant.counters.forged == 2
    assert victim.node.texts(victim.reader) == []
    assert victim.works


def _leaving() -> Parameters:
    return Parameters(((STATUS_INFO, DISPOSED),))


# Newcomers


def test_participants_that_have_shown_nothing_make_room_for_others() -> None:
    peers = Peers(RtpsLimits(participants=3))
    names = [b"\1\x0f" + bytes([number] * 10) for number in range(6)]
    for number, name in enumerate(names[:3]):
        host = f"10.0.1.{number}"
        peers.receive(host, announcement(name, (host, 7410)), prefix=name)
    peers.receive("10.0.1.0", peers.here, prefix=names[0])
    peers.receive("10.0.1.3", announcement(names[3], ("10.0.1.3", 1)), prefix=names[3])
    (lost,) = peers.node.all(ParticipantLost)
    assert lost.prefix == names[1]
    for number in (2, 3):
        peers.receive(f"10.0.1.{number}", peers.here, prefix=names[number])
    peers.receive("10.0.1.4", announcement(names[4], ("10.0.1.4", 1)), prefix=names[4])
    assert len(peers.node.all(ParticipantLost)) == 1
    assert len(peers.node.all(ParticipantFound)) == 4


def test_a_host_has_only_so_many_participants() -> None:
    peers = Peers(RtpsLimits(participants_of_host=2))
    names = [b"\1\x0f" + bytes([number] * 10) for number in range(5)]
    for name in names[:2]:
        peers.receive(HOST, announcement(name, (HOST, 7410)), prefix=name)
        peers.receive(HOST, peers.here, prefix=name)
    peers.receive(HOST, announcement(names[2], (HOST, 7410)), prefix=names[2])
    peers.receive("10.0.0.67", announcement(names[3], (HOST, 7410)), prefix=names[3])
    found = [event.prefix for event in peers.node.all(ParticipantFound)]
    assert found == [names[0], names[1], names[3]]
    leave = Data(UNKNOWN_ENTITY, SPDP_WRITER, 2, None, _leaving())
    peers.receive(HOST, leave, prefix=names[0])
    peers.receive(HOST, announcement(names[2], (HOST, 7410)), prefix=names[2])
    assert peers.node.all(ParticipantFound)[-1].prefix == names[2]


def test_a_storm_of_newcomers_is_taken_slowly() -> None:
    peers = Peers()
    for number in range(1000):
        name = b"\1\x0f" + number.to_bytes(10, "big")
        peers.receive(HOST, announcement(name, (HOST, 7410)), prefix=name)
    assert len(peers.node.all(ParticipantFound)) <= 130
    other = b"\1\x0fof another"
    peers.receive("10.0.0.67", announcement(other, ("10.0.0.67", 7410)), prefix=other)
    assert peers.node.all(ParticipantFound)[-1].prefix == other


def test_hosts_with_newcomers_are_forgotten_when_they_may_begin_again() -> None:
    rates = HostRates(2, 1.0, hosts=2)
    assert rates.take("a", 0.0)
    assert rates.take("b", 0.5)
    assert not rates.take("c", 0.5)
    assert rates.take("a", 0.5)
    assert not rates.take("a", 0.6)
    assert rates.take("c", 1.5)
    assert not rates.take("d", 1.5)


def test_samples_of_discovery_in_one_datagram_are_bounded() -> None:
    peers = Peers()
    names = [b"\1\x0f" + number.to_bytes(10, "big") for number in range(DISCOVERY_AT_ONCE + 9)]
    forged = [
        each
        for name in names
        for each in (SourceInfo(b"\1\x0f", name), announcement(name, (HOST, 7410)))
    ]
    peers.receive(HOST, *forged)
    assert len(peers.node.all(ParticipantFound)) == DISCOVERY_AT_ONCE
    assert peers.node.participant.counters.over_limit == 9


def test_an_announcement_that_repeats_at_once_is_not_read() -> None:
    peers = Peers()
    peers.receive(HOST, announcement(STRANGER, (HOST, 7410)))
    broken = Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, b"\0\3\0\0")
    peers.later(0.001)
    peers.receive(HOST, broken)
    assert peers.node.participant.counters.invalid == 0
    peers.later(0.1)
    peers.receive(HOST, broken)
    assert peers.node.participant.counters.invalid == 1


def test_endpoints_of_one_participant_are_matched_up_to_a_limit() -> None:
    world = World()
    node, peer = world.join(limits=RtpsLimits(matches_of_one=3)), world.join()
    other = world.join()
    reader = reader_of(world, node)
    writer = node.participant.create_writer(TOPIC, TYPE, Qos(), world.now)
    for _ in range(5):
        peer.participant.create_writer(TOPIC, TYPE, Qos(), world.now)
        reader_of(world, peer)
    other.participant.create_writer(TOPIC, TYPE, Qos(), world.now)
    world.run(2.0)
    assert len(reader.writers) == 4
    assert len(writer.readers) == 3
    assert len(node.all(EndpointMatched)) == 7
    assert node.participant.counters.over_limit == 4


def test_early_heartbeats_of_one_participant_are_bounded_and_forgotten_with_it() -> None:
    early = EarlyHeartbeats(RtpsLimits(early_heartbeats_of_one=3))
    beat = WriterHeartbeat(b"", b"", 1, 1, 1)
    for number in range(9):
        early.keep(Guid(STRANGER + bytes([0, 0, number, 3])), beat)
    early.keep(Guid(b"\1\x0f" + bytes(14)), beat)
    assert len(early) == 4
    early.forget_participant(STRANGER)
    assert len(early) == 1


# Repairs


def large_writer(size: int, count: int) -> Victim:
    victim = Victim()
    qos = Qos(durability=Durability.TRANSIENT_LOCAL, depth=count)
    writer = victim.node.participant.create_writer(TOPIC, TYPE, qos, victim.world.now)
    victim.world.run(1.0)
    for _ in range(count):
        writer.write(payload("x" * size), victim.world.now)
    victim.answer()
    victim.writer = writer
    return victim


def test_requests_for_large_samples_again_and_again_are_answered_as_far_as_the_budget_goes() -> (
    None
):
    victim = large_writer(1_000_000, 10)
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    everything = NumberSet(1, tuple(range(1, 11)))
    sent = 0
    for count in range(1000):
        victim.later(0.01)
        sent += victim.receive(AckNack(reader, writer, everything, count))
        sent += victim.receive(FragmentNack(reader, writer, 3, NumberSet(1, (1, 2, 16)), count))
    written, time = 2 * 10_001_000, 10 * REPAIRS_PER_SECOND
    assert 20_000_000 < sent < 1.1 * (written + time + REPAIRS_AT_ONCE + 1_000_000)
    assert victim.works


def test_gaps_are_answered_as_far_as_the_budget_goes() -> None:
    victim = large_writer(4, 600)
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    for _ in range(600):
        victim.writer.write(payload("x"), victim.world.now, only_to=Guid(bytes(16)))
    victim.answer()
    (proxy,) = (each for each in victim.writer.readers.values())
    proxy._budget = PeerBudget(victim.world.now)
    odd = NumberSet(700, tuple(range(700, 956, 2)))
    sent = sum(victim.receive(AckNack(reader, writer, odd, count)) for count in range(2000))
    assert sent < 2 * REPAIRS_AT_ONCE


def test_a_gap_is_repeated_no_sooner_than_a_sample() -> None:
    victim = large_writer(4, 3)
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    for _ in range(6):
        victim.writer.write(payload("x"), victim.world.now)
    victim.answer()
    nacks = [AckNack(reader, writer, NumberSet(1, (1, 2, 3)), count) for count in range(100)]
    assert 0 < victim.receive(*nacks) < 200
    victim.later(0.01)
    assert 0 < victim.receive(*nacks) < 200


def test_a_budget_grows_with_what_is_written_and_with_the_time() -> None:
    budget = PeerBudget(0.0)
    assert budget.may_repair(REPAIRS_AT_ONCE + 1, 0.0)
    assert not budget.may_repair(1, 0.0)
    assert budget.may_repair(1, 1.0)
    assert budget.may_repair(REPAIRS_PER_SECOND, 1.0)
    assert not budget.may_repair(1, 1.0)
    budget.write(MOST_REPAIRS)
    assert budget.may_repair(MOST_REPAIRS, 1.0)
    assert not budget.may_repair(1, 1.0)


def test_many_questions_of_a_reader_at_once_have_one_answer() -> None:
    victim = Victim()
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    questions = [AckNack(reader, writer, NumberSet(0), count) for count in range(500)]
    assert 0 < victim.receive(*questions) < 200
    assert victim.receive(*questions) == 0
    victim.later(0.01)
    assert 0 < victim.receive(*questions) < 200


def test_many_heartbeats_at_once_have_one_answer() -> None:
    victim = Victim()
    beats = [WriterHeartbeat(*victim.ends, 1, 200, count) for count in range(500)]
    assert 0 < victim.receive(*beats) < 300
    assert victim.later(0.02) < 300
    victim.later(0.5)
    assert 0 < victim.receive(*beats) < 300


def test_what_does_not_come_is_requested_only_so_often() -> None:
    victim = Victim()
    victim.receive(WriterHeartbeat(*victim.ends, 1, 200, 1))
    victim.receive(DataFragment(*victim.ends, 3, 1, 1, 100, 200, bytes(100)))
    sent, partials = 0, victim.node.participant._shared.partials
    for _ in range(12):  # its peer shows that it is there
        sent += victim.later(10.0)
        announced = victim.peer.participant._participants._payload
        victim.receive(Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, announced))
    (proxy,) = victim.reader.proxies.values()
    assert proxy._requests == MOST_REQUESTS
    assert partials.held == 0
    assert victim.works


def test_a_participant_gives_up_its_own_incomplete_samples_first() -> None:
    limits = RtpsLimits(sample=100_000, incomplete=1_000_000)
    victim = Victim(limits)
    honest = victim.world.join()
    writer = honest.participant.create_writer(TOPIC, TYPE, Qos(), victim.world.now)
    victim.world.run(1.0)
    ends = victim.reader.guid.entity, writer.guid.entity
    first = DataFragment(*ends, 1, 1, 1, 100, 200, payload("a" * 96))
    second = DataFragment(*ends, 1, 2, 1, 100, 200, bytes(100))
    beat = WriterHeartbeat(*ends, 1, 1, 9)
    source = (honest.host, 7410)
    participant = victim.node.participant
    participant.receive(packet(honest.participant.prefix, beat, first), source, victim.world.now)
    for number in range(1, 250):
        victim.receive(DataFragment(*victim.ends, number, 1, 1, 60_000, 99_999, bytes(60_000)))
    assert participant._shared.partials.held > 800_000
    participant.receive(packet(honest.participant.prefix, second), source, victim.world.now)
    victim.answer()
    assert len(victim.node.texts(victim.reader)) == 1


def test_incomplete_samples_are_freed_with_their_writer() -> None:
    victim = Victim()
    victim.receive(DataFragment(*victim.ends, 1, 1, 1, 100, 200, bytes(100)))
    assert victim.node.participant._shared.partials.held > 0
    victim.node.participant.close(victim.world.now)
    assert victim.node.participant._shared.partials.held == 0


def test_a_request_for_a_fragment_of_a_gap_costs_the_budget() -> None:
    victim = large_writer(4, 3)
    for _ in range(6):
        victim.writer.write(payload("x"), victim.world.now)
    victim.answer()
    (proxy,) = victim.writer.readers.values()
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    nack = FragmentNack(reader, writer, 1, NumberSet(1, (1,)), 9)
    assert victim.receive(nack) > 0
    proxy._budget.may_repair(MOST_REPAIRS, victim.world.now)
    assert victim.receive(nack) == 0


def test_a_disposed_sample_that_another_one_has_replaced_is_forgotten_once() -> None:
    history = History(1, RtpsLimits())
    history.add(StoredSample(payload=b"key ", key=b"a", is_disposed=True))
    history.add(StoredSample(payload=b"next", key=b"a"))
    history.add(StoredSample(payload=b"key ", key=b"b", is_disposed=True))
    assert (history.first, len(history)) == (2, 2)
    history.forget_acknowledged(3, is_volatile=False)
    assert (history.first, len(history)) == (2, 1)
    history.forget_acknowledged(3, is_volatile=True)
    assert (history.first, history.last, len(history)) == (4, 3, 0)


def test_writers_of_a_participant_are_followed_each_for_itself() -> None:
    world = World()
    node, peer = world.join(), world.join()
    readers = [reader_of(world, node), reader_of(world, node)]
    qos = Qos(liveliness=Liveliness.BY_TOPIC, liveliness_lease=1.0)
    writers = [peer.participant.create_writer(TOPIC, TYPE, qos, world.now) for _ in range(2)]
    world.run(0.5)
    followed = node.participant._router._liveliness
    one, other = writers
    followed.forget(readers[0].guid, one.guid)
    world.run(2.0)
    lost = [(event.reader, event.writer) for event in node.all(LivelinessChanged)]
    assert sorted(lost) == sorted(
        [(readers[1].guid, one.guid), (readers[0].guid, other.guid), (readers[1].guid, other.guid)]
    )
    peer.participant.remove(other, world.now)
    world.run(1.0)
    followed.receive(Sample(Guid(bytes(16)), 1, bytes(40)), world.now)
    assert len(node.all(LivelinessChanged)) == 3


@pytest.mark.parametrize("of", [AckNack, Gap])
def test_what_strangers_send_is_left_out(of: type) -> None:
    peers = Peers()
    ends = PUBLICATIONS_READER, PUBLICATIONS_WRITER
    beat = WriterHeartbeat(*ends, 1, 9, 1)
    sent = AckNack(*ends, NumberSet(0), 1) if of is AckNack else Gap(*ends, 1, NumberSet(9))
    peers.receive(HOST, beat, sent)
    assert peers.sent == []
