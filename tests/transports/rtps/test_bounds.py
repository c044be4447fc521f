"""A hostile network: whatever arrives never raises, and memory stays within its limits."""

from __future__ import annotations

import tracemalloc
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fibaction_transports.rtps.discovery.remote_participant import (
    ParticipantData,
    participant_payload,
)
from fibaction_transports.rtps.endpoints.fragments import PartialSamples
from fibaction_transports.rtps.endpoints.reader import EarlyHeartbeats
from fibaction_transports.rtps.events import ParticipantFound, ParticipantLost, SamplesLost
from fibaction_transports.rtps.limits import MIB, RtpsLimits
from fibaction_transports.rtps.messages.encoder import packet_head, submessage_bytes
from fibaction_transports.rtps.messages.ids import SPDP_WRITER, UNKNOWN_ENTITY, Guid
from fibaction_transports.rtps.messages.layout import MAX_NUMBER
from fibaction_transports.rtps.messages.locators import udp_locator
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
    Submessage,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Durability, Qos, Reliability
from tests.transports.rtps.test_submessages import submessages
from tests.transports.rtps.world import TOPIC, TYPE, Node, World, payload, reader_of

SOURCE = ("10.0.0.2", 7410)
"""The address of the peer."""


def packet(prefix: bytes, *of: Submessage) -> bytes:
    return packet_head(prefix[:2], prefix) + b"".join(map(submessage_bytes, of))


class Victim:
    """A participant with a reader and a writer, and a peer that knows it, with one of each."""

    def __init__(self, limits: RtpsLimits | None = None) -> None:
        self.world = World()
        self.node = self.world.join(limits=limits)
        self.peer = self.world.join()
        qos = Qos(durability=Durability.TRANSIENT_LOCAL, depth=5)
        self.reader = reader_of(self.world, self.node)
        self.writer = self.node.participant.create_writer(TOPIC, TYPE, qos, self.world.now)
        self.peer_reader = reader_of(self.world, self.peer, qos)
        self.peer_writer = self.peer.participant.create_writer(TOPIC, TYPE, Qos(), self.world.now)
        self.writer.write(payload("x" * 1000), self.world.now)
        self.world.run(2.0)
        assert self.reader.writers
        assert self.writer.readers
        self.sent = 0

    @property
    def ends(self) -> tuple[bytes, bytes]:
        """The entities of the victim's reader and of the peer's writer."""
        return self.reader.guid.entity, self.peer_writer.guid.entity

    def receive(self, *of: Submessage) -> int:
        """Take submessages of the peer; return the number of bytes of the answer."""
        datagram = packet(self.peer.participant.prefix, *of)
        self.node.participant.receive(datagram, SOURCE, self.world.now)
        return self.answer()

    def answer(self) -> int:
        self.node.told += self.node.participant.events()
        return sum(len(datagram) for datagram, _ in self.node.participant.datagrams_to_send())

    def later(self, seconds: float) -> int:
        """Let time pass for the victim alone; return the number of bytes that it sends."""
        end, size = self.world.now + seconds, 0
        participant = self.node.participant
        while (deadline := participant.next_deadline()) <= end:
            self.world.now = max(self.world.now, deadline)
            participant.handle_deadline(self.world.now)
            size += self.answer()
        self.world.now = end
        return size

    @property
    def works(self) -> bool:
        """True if samples of the peer still arrive."""
        before = len(self.node.texts(self.reader))
        self.peer_writer.write(payload("still there"), self.world.now)
        self.world.run(5.0)
        return len(self.node.texts(self.reader)) == before + 1


# Whatever arrives

ENTITIES = st.sampled_from(
    [bytes.fromhex(each) for each in ("00000104", "00000203", "000003c2", "000003c7", "00000000")]
)


@given(st.data())
@settings(deadline=None)
def test_packets_of_a_peer_never_raise(data: st.DataObject) -> None:
    victim = Victim()
    for _ in range(data.draw(st.integers(1, 6))):
        sent = [_aimed(each, data) for each in data.draw(st.lists(submessages("<"), max_size=4))]
        datagram = bytearray(packet(victim.peer.participant.prefix, *sent))
        if data.draw(st.booleans()):
            place = data.draw(st.integers(20, len(datagram)))
            datagram[place : place + 1] = data.draw(st.binary(max_size=2))
        victim.node.participant.receive(bytes(datagram), SOURCE, victim.world.now)
        victim.answer()
        victim.later(0.01)
    victim.later(5.0)
    assert victim.node.participant.counters.datagrams > 0


def _aimed(submessage: Submessage, data: st.DataObject) -> Submessage:
    """Return the submessage with entities that the victim or the peer has."""
    if not hasattr(submessage, "reader") or not hasattr(submessage, "writer"):
        return submessage
    fields = {name: getattr(submessage, name) for name in submessage.__struct_fields__}
    fields |= {"reader": data.draw(ENTITIES), "writer": data.draw(ENTITIES)}
    if "number" in fields and data.draw(st.booleans()):
        fields["number"] = data.draw(st.integers(1, 300))
    return type(submessage)(**fields)


@given(st.binary(max_size=300))
def test_any_datagram_is_dropped_and_counted(content: bytes) -> None:
    world = World()
    node = world.join()
    node.participant.receive(content, SOURCE, 0.0)
    node.participant.receive(packet_head(b"\1\x0f", bytes(12)) + content, SOURCE, 0.0)
    assert node.participant.counters.datagrams == 2
    assert node.participant.counters.invalid >= 1


def test_changed_copies_of_real_traffic_do_no_harm() -> None:
    world = World(6)
    node, peer = world.join(fragment_size=256), world.join(fragment_size=256)
    reader = reader_of(world, node)
    writer = peer.participant.create_writer(TOPIC, TYPE, Qos(depth=None), world.now)
    random = Random(1)

    def change(datagram: bytes, address: object) -> bool:
        changed = bytearray(datagram)
        for _ in range(random.randint(1, 3)):
            # Headers tell who sends what; a changed name would be another peer.
            changed[random.randrange(20, len(changed))] = random.randrange(256)
        if random.random() < 0.5:
            node.participant.receive(bytes(changed), SOURCE, world.now)
            peer.participant.receive(bytes(changed), SOURCE, world.now)
        return False

    world.is_lost = change
    for number in range(200):
        writer.write(payload(f"{number}" * random.choice([1, 400])), world.now)
        world.run(0.05)
    assert node.participant.counters.invalid > 10
    assert node.participant._shared.partials.held < 10 * MIB
    assert reader.guid


# Numbers


def test_a_sample_with_a_number_far_away_is_not_held() -> None:
    victim = Victim()
    for number in (300, 2**40, MAX_NUMBER - 1):
        victim.receive(Data(*victim.ends, number, payload("far")))
    assert victim.node.participant._shared.held.held == 0
    assert victim.works


def test_a_heartbeat_that_jumps_is_survived() -> None:
    victim = Victim()
    last = MAX_NUMBER - 1
    victim.receive(WriterHeartbeat(*victim.ends, last, last, 9))
    victim.receive(Data(*victim.ends, last, payload("last")))
    assert victim.node.texts(victim.reader) == ["last"]
    assert victim.node.all(SamplesLost)[0].count == last - 1
    victim.receive(WriterHeartbeat(*victim.ends, last, last, 10))
    assert victim.later(1.0) < 2000


def test_a_gap_of_all_numbers_is_survived() -> None:
    victim = Victim()
    last = MAX_NUMBER - 1
    victim.receive(Gap(*victim.ends, 1, NumberSet(last, (last, last + 200))))
    victim.receive(WriterHeartbeat(*victim.ends, 1, last, 9))
    assert victim.later(1.0) < 5000


def test_a_gap_far_away_is_not_held() -> None:
    victim = Victim()
    for start in range(10, 10_000, 7):
        victim.receive(Gap(*victim.ends, start, NumberSet(start + 3, (start + 5,))))
    (proxy,) = victim.reader.proxies.values()
    assert len(proxy._held) < 256
    assert victim.works
    assert victim.node.participant.counters.invalid == 0


def test_an_acknowledgement_of_what_was_not_sent_is_ignored() -> None:
    victim = Victim()
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    assert victim.receive(AckNack(reader, writer, NumberSet(MAX_NUMBER - 1, ()), 9)) == 0
    assert victim.receive(AckNack(reader, writer, NumberSet(1, (2, 3, 200)), 9, True)) == 0
    assert victim.receive(AckNack(b"\0\0\x77\4", writer, NumberSet(1, (1,)), 9)) == 0
    assert victim.receive(AckNack(reader, b"\0\0\x77\3", NumberSet(1, (1,)), 9)) == 0
    assert victim.receive(FragmentNack(reader, writer, 2, NumberSet(1, (1,)), 9)) == 0
    assert victim.receive(FragmentNack(b"\0\0\x77\4", writer, 1, NumberSet(1, (1,)), 9)) == 0
    assert victim.works


def test_many_requests_at_once_are_answered_once() -> None:
    victim = Victim()
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    wanted = [AckNack(reader, writer, NumberSet(1, (1,)), count) for count in range(500)]
    assert victim.receive(*wanted) < 3000
    fragments = [
        FragmentNack(reader, writer, 1, NumberSet(1, (1, 2, 3)), count) for count in range(500)
    ]
    assert victim.receive(*fragments) < 3000
    victim.later(0.1)
    assert victim.receive(*fragments) < 3000


def test_a_request_for_fragments_of_a_sample_that_is_gone_is_answered_by_a_gap() -> None:
    victim = Victim()
    reader, writer = victim.peer_reader.guid.entity, victim.writer.guid.entity
    for number in range(6):
        victim.writer.write(payload(str(number)), victim.world.now)
    victim.answer()
    assert 0 < victim.receive(FragmentNack(reader, writer, 1, NumberSet(1, (1,)), 9)) < 200


def test_what_is_for_a_reader_that_is_not_matched_is_ignored() -> None:
    victim = Victim()
    other = reader_of(victim.world, victim.node, topic="rt/other").guid.entity
    writer = victim.peer_writer.guid.entity
    victim.answer()
    data = Data(other, writer, 1, payload("x"))
    whole = DataFragment(other, writer, 1, 1, 1, 8, 8, payload("abcd"))
    beat, gap = WriterHeartbeat(other, writer, 1, 1, 1), Gap(other, writer, 1, NumberSet(2))
    unknown = Data(b"\0\0\x77\4", writer, 1, payload("x"))
    assert victim.receive(data, whole, beat, gap, unknown) == 0
    assert victim.works


def test_a_best_effort_reader_needs_no_heartbeats_and_gaps() -> None:
    victim = Victim()
    qos = Qos(reliability=Reliability.BEST_EFFORT)
    reader = reader_of(victim.world, victim.node, qos)
    victim.answer()
    ends = reader.guid.entity, victim.peer_writer.guid.entity
    assert victim.receive(WriterHeartbeat(*ends, 1, 1, 1), Gap(*ends, 1, NumberSet(9))) == 0
    victim.receive(Data(*ends, 5, payload("five")), Data(*ends, 5, payload("five again")))
    assert victim.node.texts(reader) == ["five"]


def test_an_acknowledgement_that_waits_is_not_sent_if_something_is_missing_meanwhile() -> None:
    victim = Victim()
    victim.receive(Data(*victim.ends, 1, payload("one")))
    assert victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 1)) == 0
    victim.receive(Data(*victim.ends, 3, payload("three")))
    assert victim.later(0.004) == 0
    assert victim.later(0.1) > 0


def test_held_samples_far_after_the_first_heartbeat_are_requested_again() -> None:
    victim = Victim()
    (proxy,) = victim.reader.proxies.values()
    proxy._next = None
    victim.receive(Data(*victim.ends, 1000, payload("far")))
    victim.receive(Gap(*victim.ends, 1, NumberSet(2000)))
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1000, 9))
    assert victim.node.participant._shared.held.held == 0
    assert victim.node.texts(victim.reader) == []


# Fragments


def fragment(victim: Victim, number: int, whole: int, size: int, first: int = 1) -> DataFragment:
    content = bytes(min(size, whole - (first - 1) * size))
    return DataFragment(*victim.ends, number, first, 1, size, whole, content)


@pytest.mark.parametrize(("size", "is_invalid"), [(2**32 - 1, True), (2**31, False)])
def test_a_sample_of_gigabytes_that_is_announced_takes_no_memory(
    size: int, is_invalid: bool
) -> None:
    victim = Victim()
    tracemalloc.start()
    for number in range(1, 200):
        victim.receive(fragment(victim, number, size, 65_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2 * MIB
    counters = victim.node.participant.counters
    assert (counters.invalid, counters.over_limit) == ((199, 0) if is_invalid else (0, 199))
    assert victim.works


def test_many_incomplete_samples_take_bounded_memory_and_the_oldest_are_given_up() -> None:
    limits = RtpsLimits(sample=100_000, incomplete=1_000_000)
    victim = Victim(limits)
    partials = victim.node.participant._shared.partials
    for number in range(1, 250):
        victim.receive(fragment(victim, number, 99_999, 60_000))
        assert partials.held <= limits.incomplete
    assert partials.held > 800_000
    victim.receive(fragment(victim, 250, 100_001, 60_000))
    assert victim.node.participant.counters.over_limit == 1
    assert victim.later(20.0) < 100_000
    victim.peer.participant.close(victim.world.now)
    victim.world.run(1.0)
    assert partials.held == 0


def test_the_first_of_the_largest_samples_takes_twice_its_size_at_most() -> None:
    victim = Victim()
    largest = RtpsLimits().sample
    tracemalloc.start()
    victim.receive(fragment(victim, 1, largest, 65_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert victim.node.participant.counters.over_limit == 0
    assert largest < peak < 2 * largest + MIB


def test_a_sample_that_exceeds_the_memory_for_incomplete_ones_is_not_started() -> None:
    partials = PartialSamples(RtpsLimits(incomplete=1000))
    home: dict[int, object] = {}
    whole = DataFragment(b"", b"", 1, 1, 1, 1000, 2000, bytes(1000))
    assert partials.start(whole, b"", home) is None  # type: ignore[arg-type]  # stays empty
    assert home == {}


def test_fragments_that_contradict_each_other_are_dropped() -> None:
    victim = Victim()
    victim.receive(fragment(victim, 1, 200, 100))
    victim.receive(fragment(victim, 1, 300, 100, first=2))
    victim.receive(fragment(victim, 1, 200, 50, first=2))
    victim.receive(fragment(victim, 1, 200, 100, first=1))
    assert victim.node.texts(victim.reader) == []
    assert victim.node.participant.counters.over_limit == 2
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.receive(fragment(victim, 1, 200, 100, first=2))
    assert len(victim.node.texts(victim.reader)) == 1


def test_fragments_of_a_sample_that_a_gap_covers_are_given_up() -> None:
    victim = Victim()
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.receive(fragment(victim, 3, 200, 100))
    victim.receive(Gap(*victim.ends, 2, NumberSet(4)))
    assert victim.node.participant._shared.partials.held == 0
    victim.receive(Data(*victim.ends, 1, payload("one")))
    victim.receive(Data(*victim.ends, 4, payload("four")))
    assert victim.node.texts(victim.reader) == ["one", "four"]


def test_fragments_of_a_sample_that_its_writer_has_no_longer_are_given_up() -> None:
    victim = Victim()
    victim.receive(WriterHeartbeat(*victim.ends, 1, 3, 9))
    victim.receive(fragment(victim, 3, 200, 100))
    victim.receive(WriterHeartbeat(*victim.ends, 10, 10, 10))
    assert victim.node.participant._shared.partials.held == 0
    assert victim.node.all(SamplesLost)[0].count == 9


# Held samples


def test_samples_that_wait_for_earlier_ones_take_bounded_memory() -> None:
    limits = RtpsLimits(held=50_000, sample=60_000)
    victim = Victim(limits)
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 9))
    for number in range(2, 250):
        victim.receive(Data(*victim.ends, number, payload("x" * 1000)))
    account = victim.node.participant._shared.held
    assert 45_000 < account.held <= 50_000
    assert victim.node.participant.counters.over_limit > 100
    victim.receive(Data(*victim.ends, 251, payload("x" * 61_000)))
    victim.receive(Data(*victim.ends, 1, payload("first")))
    assert account.held == 0
    assert len(victim.node.texts(victim.reader)) == 50


def test_held_samples_are_freed_when_their_writer_is_gone() -> None:
    victim = Victim()
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.receive(Data(*victim.ends, 5, payload("x")))
    victim.receive(Gap(*victim.ends, 3, NumberSet(4)))
    assert victim.node.participant._shared.held.held > 0
    victim.peer.participant.close(victim.world.now)
    victim.world.run(1.0)
    assert victim.node.participant._shared.held.held == 0


def test_samples_before_the_first_heartbeat_are_held_and_bounded() -> None:
    victim = Victim()
    (proxy,) = victim.reader.proxies.values()
    proxy._next = None
    for number in range(1000, 2000):
        victim.receive(Data(*victim.ends, number, payload(str(number))))
    assert len(proxy._held) == 256
    victim.receive(WriterHeartbeat(*victim.ends, 1100, 1999, 9))
    assert victim.node.texts(victim.reader) == [str(number) for number in range(1000, 1256)]


# Participants and endpoints


def hello(prefix: bytes, lease: float = 1e9) -> bytes:
    locators = (udp_locator(SOURCE),)
    data = ParticipantData(prefix=prefix, lease=lease, discovery_locators=locators)
    return packet(prefix, Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, participant_payload(data)))


def test_participants_are_bounded_and_their_leases_too() -> None:
    world = World()
    node = world.join(limits=RtpsLimits(participants=20))
    for number in range(100):
        prefix = b"\1\x0f" + number.to_bytes(10, "big")
        node.participant.receive(hello(prefix), SOURCE, world.now)
        world.flush()
    assert len(node.all(ParticipantFound)) == 100
    assert len(node.all(ParticipantLost)) == 80
    assert node.participant.counters.over_limit == 80
    world.run(301.0)
    assert len(node.all(ParticipantLost)) == 100


def test_endpoints_are_bounded() -> None:
    world = World()
    limits = RtpsLimits(endpoints=30, endpoints_of_one=20)
    node, *peers = world.join(limits=limits), world.join(), world.join()
    for number in range(50):
        for peer in peers:
            peer.participant.create_writer(f"rt/{number}", TYPE, Qos(), world.now)
    world.run(5.0)
    found = node.participant.remote_endpoints
    assert len(found) == 30
    assert node.participant.counters.over_limit == 70
    of_one = [data for data in found if data.guid.prefix == found[0].guid.prefix]
    assert len(of_one) in (10, 20)
    assert len(node.participant._remote) == 30
    assert node.participant._remote.get(Guid(bytes(16))) is None
    assert node.participant._remote.get(found[0].guid) == found[0]


def test_heartbeats_of_unknown_writers_are_bounded() -> None:
    victim = Victim(RtpsLimits(early_heartbeats=10))
    for number in range(100):
        entity = number.to_bytes(3, "big") + b"\3"
        victim.receive(WriterHeartbeat(UNKNOWN_ENTITY, entity, 1, 1, 1))
    assert len(victim.node.participant._router._early) == 10
    stranger = packet(b"\1\x0fa stranger", WriterHeartbeat(UNKNOWN_ENTITY, b"\0\0\1\3", 1, 1, 1))
    victim.node.participant.receive(stranger, SOURCE, victim.world.now)
    assert len(victim.node.participant._router._early) == 10


def test_the_newest_early_heartbeat_counts() -> None:
    early = EarlyHeartbeats(RtpsLimits(early_heartbeats=2))
    beats = [WriterHeartbeat(b"", b"", 1, 1, count) for count in range(4)]
    one, two, three = (Guid(bytes([number] * 16)) for number in range(3))
    early.keep(one, beats[0])
    early.keep(two, beats[1])
    early.keep(one, beats[2])
    early.keep(three, beats[3])
    assert early.take(two) is None
    assert early.take(one) == beats[2]
    assert early.take(one) is None


def test_what_waits_to_be_sent_is_bounded() -> None:
    victim = Victim(RtpsLimits(outbox=10))
    for number in range(100):
        victim.writer.write(payload(str(number)), victim.world.now)
    assert victim.node.participant.counters.unsent > 100
    victim.world.run(5.0)
    assert victim.works


def test_the_times_of_sent_samples_are_forgotten_with_them() -> None:
    """A reader that acknowledges nothing does not make its writer remember more and more."""
    victim = Victim()
    victim.world.kill(victim.peer)
    for number in range(1000):
        victim.writer.write(payload(str(number)), victim.world.now)
        victim.answer()
    (proxy,) = victim.writer.readers.values()
    assert len(proxy._sent) <= 2 * victim.writer.kept + 2
    assert victim.writer.kept == 5


def test_packets_of_another_destination_or_of_oneself_are_ignored() -> None:
    victim = Victim()
    node: Node = victim.node
    own = packet(node.participant.prefix, Data(*victim.ends, 1, payload("x")))
    node.participant.receive(own, SOURCE, victim.world.now)
    victim.receive(Destination(b"someone else"), Data(*victim.ends, 1, payload("x")))
    assert node.texts(victim.reader) == []


@pytest.mark.parametrize("is_key", [True, False])
def test_a_sample_without_data_is_not_handed_over(is_key: bool) -> None:
    victim = Victim()
    victim.receive(WriterHeartbeat(*victim.ends, 1, 1, 9))
    content = payload("key") if is_key else None
    victim.receive(Data(*victim.ends, 1, content, None, is_key))
    victim.receive(Data(*victim.ends, 2, payload("two")))
    assert victim.node.texts(victim.reader) == ["two"]
