"""A hostile network: whatever arrives never raises, and memory stays within its limits."""

from __future__ import annotations

import tracemalloc
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fibaction_transports.rtps.endpoints.reader import EarlyHeartbeats
from fibaction_transports.rtps.events import ParticipantFound, ParticipantLost, SamplesLost
from fibaction_transports.rtps.limits import MIB, RtpsLimits
from fibaction_transports.rtps.messages.codec import packet_head
from fibaction_transports.rtps.messages.ids import UNKNOWN_ENTITY, Guid
from fibaction_transports.rtps.messages.layout import MAX_NUMBER
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
from fibaction_transports.rtps.qos import Qos, Reliability
from tests.transports.rtps.target import SOURCE, Target, Victim, hello, packet
from tests.transports.rtps.test_submessages import submessages
from tests.transports.rtps.world import TYPE, World, payload, reader_of, writer_of

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
        victim.participant.receive(bytes(datagram), (victim.peer.host, 7410), victim.world.now)
        victim.later(0.01)
    victim.later(5.0)
    assert victim.counters.datagrams > 0


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
    writer, random = writer_of(world, peer), Random(1)

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


def test_a_sample_with_a_number_far_away_is_not_held(victim: Victim) -> None:
    for number in (300, 2**40, MAX_NUMBER - 1):
        victim.hear(Data(*victim.ends, number, payload("far")))
    assert victim.participant._shared.held.held == 0
    assert victim.works


def test_a_heartbeat_that_jumps_is_survived(victim: Victim) -> None:
    last = MAX_NUMBER - 1
    victim.hear(WriterHeartbeat(*victim.ends, last, last, 9))
    victim.hear(Data(*victim.ends, last, payload("last")))
    assert victim.texts == ["last"]
    assert victim.node.all(SamplesLost)[0].count == last - 1
    victim.hear(WriterHeartbeat(*victim.ends, last, last, 10))
    assert victim.later(1.0) < 2000


def test_a_gap_of_all_numbers_is_survived(victim: Victim) -> None:
    last = MAX_NUMBER - 1
    victim.hear(Gap(*victim.ends, 1, NumberSet(last, (last, last + 200))))
    victim.hear(WriterHeartbeat(*victim.ends, 1, last, 9))
    assert victim.later(1.0) < 5000


def test_a_gap_far_away_is_not_held(victim: Victim) -> None:
    for start in range(10, 10_000, 7):
        victim.hear(Gap(*victim.ends, start, NumberSet(start + 3, (start + 5,))))
    (proxy,) = victim.reader.proxies.values()
    assert len(proxy._held) < 256
    assert victim.works
    assert victim.counters.invalid == 0


def test_an_acknowledgement_of_what_was_not_sent_is_ignored(victim: Victim) -> None:
    assert victim.hear(AckNack(*victim.asking, NumberSet(MAX_NUMBER - 1, ()), 9)) == 0
    assert victim.hear(AckNack(*victim.asking, NumberSet(1, (2, 3, 200)), 9, True)) == 0
    assert victim.hear(FragmentNack(*victim.asking, 2, NumberSet(1, (1,)), 9)) == 0
    reader, writer = victim.asking
    for ends in ((b"\0\0\x77\4", writer), (reader, b"\0\0\x77\3")):
        assert victim.hear(AckNack(*ends, NumberSet(1, (1,)), 9)) == 0
        assert victim.hear(FragmentNack(*ends, 1, NumberSet(1, (1,)), 9)) == 0
    assert victim.works


def test_many_requests_at_once_are_answered_once(victim: Victim) -> None:
    wanted = [AckNack(*victim.asking, NumberSet(1, (1,)), count) for count in range(500)]
    assert victim.hear(*wanted) < 3000
    fragments = [
        FragmentNack(*victim.asking, 1, NumberSet(1, (1, 2, 3)), count) for count in range(500)
    ]
    assert victim.hear(*fragments) < 3000
    victim.later(0.1)
    assert victim.hear(*fragments) < 3000


def test_what_is_for_a_reader_that_is_not_matched_is_ignored(victim: Victim) -> None:
    other = reader_of(victim.world, victim.node, topic="rt/other").guid.entity
    writer = victim.peer_writer.guid.entity
    victim.take()
    data = Data(other, writer, 1, payload("x"))
    whole = DataFragment(other, writer, 1, 1, 1, 8, 8, payload("abcd"))
    beat, gap = WriterHeartbeat(other, writer, 1, 1, 1), Gap(other, writer, 1, NumberSet(2))
    unknown = Data(b"\0\0\x77\4", writer, 1, payload("x"))
    assert victim.hear(data, whole, beat, gap, unknown) == 0
    assert victim.works


def test_a_best_effort_reader_needs_no_heartbeats_and_gaps(victim: Victim) -> None:
    qos = Qos(reliability=Reliability.BEST_EFFORT)
    reader = reader_of(victim.world, victim.node, qos)
    victim.take()
    ends = reader.guid.entity, victim.peer_writer.guid.entity
    assert victim.hear(WriterHeartbeat(*ends, 1, 1, 1), Gap(*ends, 1, NumberSet(9))) == 0
    victim.hear(Data(*ends, 5, payload("five")), Data(*ends, 5, payload("five again")))
    assert victim.node.texts(reader) == ["five"]


def test_an_acknowledgement_that_waits_is_not_sent_if_something_is_missing_meanwhile(
    victim: Victim,
) -> None:
    victim.hear(Data(*victim.ends, 1, payload("one")))
    assert victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 1)) == 0
    victim.hear(Data(*victim.ends, 3, payload("three")))
    assert victim.later(0.004) == 0
    assert victim.later(0.1) > 0


def test_held_samples_far_after_the_first_heartbeat_are_requested_again(victim: Victim) -> None:
    (proxy,) = victim.reader.proxies.values()
    proxy._next = None
    victim.hear(Data(*victim.ends, 1000, payload("far")))
    victim.hear(Gap(*victim.ends, 1, NumberSet(2000)))
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1000, 9))
    assert victim.participant._shared.held.held == 0
    assert victim.texts == []


# Fragments


def fragment(victim: Victim, number: int, whole: int, size: int, first: int = 1) -> DataFragment:
    content = bytes(min(size, whole - (first - 1) * size))
    return DataFragment(*victim.ends, number, first, 1, size, whole, content)


@pytest.mark.parametrize(("size", "is_invalid"), [(2**32 - 1, True), (2**31, False)])
def test_a_sample_of_gigabytes_that_is_announced_takes_no_memory(
    victim: Victim, size: int, is_invalid: bool
) -> None:
    tracemalloc.start()
    for number in range(1, 200):
        victim.hear(fragment(victim, number, size, 65_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2 * MIB
    counters = victim.counters
    assert (counters.invalid, counters.over_limit) == ((199, 0) if is_invalid else (0, 199))
    assert victim.works


def test_many_incomplete_samples_take_bounded_memory_and_the_oldest_are_given_up() -> None:
    limits = RtpsLimits(sample=100_000, incomplete=1_000_000)
    victim = Victim(limits)
    partials = victim.participant._shared.partials
    for number in range(1, 250):
        victim.hear(fragment(victim, number, 99_999, 60_000))
        assert partials.held <= limits.incomplete
    assert partials.held > 800_000
    victim.hear(fragment(victim, 250, 100_001, 60_000))
    assert victim.counters.over_limit == 1
    assert victim.later(20.0) < 100_000
    victim.peer.participant.close(victim.world.now)
    victim.world.run(1.0)
    assert partials.held == 0


def test_the_first_of_the_largest_samples_takes_twice_its_size_at_most(victim: Victim) -> None:
    largest = RtpsLimits().sample
    tracemalloc.start()
    victim.hear(fragment(victim, 1, largest, 65_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert victim.counters.over_limit == 0
    assert largest < peak < 2 * largest + MIB


def test_a_sample_that_exceeds_the_memory_for_incomplete_ones_is_not_started() -> None:
    victim = Victim(RtpsLimits(incomplete=1000))
    victim.hear(fragment(victim, 1, 2000, 1000))
    assert victim.counters.over_limit == 1
    assert victim.participant._shared.partials.held == 0


def test_fragments_that_contradict_each_other_are_dropped(victim: Victim) -> None:
    victim.hear(fragment(victim, 1, 200, 100))
    victim.hear(fragment(victim, 1, 300, 100, first=2))
    victim.hear(fragment(victim, 1, 200, 50, first=2))
    victim.hear(fragment(victim, 1, 200, 100, first=1))
    assert victim.texts == []
    assert victim.counters.over_limit == 2
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.hear(fragment(victim, 1, 200, 100, first=2))
    assert len(victim.texts) == 1


def test_of_many_fragments_the_one_that_is_missing_is_requested(victim: Victim) -> None:
    for first in {*range(1, 301)} - {299}:
        victim.hear(fragment(victim, 1, 30_000, 100, first))
    victim.sent.clear()
    victim.later(0.1)
    requested = {nack.missing for _, nack in victim.answers(FragmentNack)}
    assert requested == {NumberSet(299, (299,))}


def test_fragments_of_a_sample_that_a_gap_covers_are_given_up(victim: Victim) -> None:
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.hear(fragment(victim, 3, 200, 100))
    victim.hear(Gap(*victim.ends, 2, NumberSet(4)))
    assert victim.participant._shared.partials.held == 0
    victim.hear(Data(*victim.ends, 1, payload("one")))
    victim.hear(Data(*victim.ends, 4, payload("four")))
    assert victim.texts == ["one", "four"]


def test_fragments_of_a_sample_that_its_writer_has_no_longer_are_given_up(victim: Victim) -> None:
    victim.hear(WriterHeartbeat(*victim.ends, 1, 3, 9))
    victim.hear(fragment(victim, 3, 200, 100))
    victim.hear(WriterHeartbeat(*victim.ends, 10, 10, 10))
    assert victim.participant._shared.partials.held == 0
    assert victim.node.all(SamplesLost)[0].count == 9


# Held samples


def test_samples_that_wait_for_earlier_ones_take_bounded_memory() -> None:
    limits = RtpsLimits(held=50_000, sample=60_000)
    victim = Victim(limits)
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 9))
    for number in range(2, 250):
        victim.hear(Data(*victim.ends, number, payload("x" * 1000)))
    account = victim.participant._shared.held
    assert 45_000 < account.held <= 50_000
    assert victim.counters.over_limit > 100
    victim.hear(Data(*victim.ends, 251, payload("x" * 61_000)))
    victim.hear(Data(*victim.ends, 1, payload("first")))
    assert account.held == 0
    assert len(victim.texts) == 50


@pytest.mark.parametrize("end", ["the writer is gone", "the reader is removed"])
def test_held_samples_and_fragments_are_freed_with_either_end(victim: Victim, end: str) -> None:
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 9))
    victim.hear(Data(*victim.ends, 5, payload("x")))
    victim.hear(Gap(*victim.ends, 3, NumberSet(4)), fragment(victim, 6, 200, 100))
    held, partials = victim.participant._shared.held, victim.participant._shared.partials
    assert held.held > 0
    assert partials.held > 0
    if end == "the reader is removed":
        victim.participant.remove(victim.reader, victim.world.now)
    else:
        victim.peer.participant.close(victim.world.now)
    victim.world.run(1.0)
    assert (held.held, partials.held) == (0, 0)


def test_samples_before_the_first_heartbeat_are_held_and_bounded(victim: Victim) -> None:
    (proxy,) = victim.reader.proxies.values()
    proxy._next = None
    for number in range(1000, 2000):
        victim.hear(Data(*victim.ends, number, payload(str(number))))
    assert len(proxy._held) == 256
    victim.hear(WriterHeartbeat(*victim.ends, 1100, 1999, 9))
    assert victim.texts == [str(number) for number in range(1000, 1256)]


# Participants and endpoints


def test_participants_are_bounded_and_their_leases_too() -> None:
    target = Target(RtpsLimits(participants=20))
    for number in range(100):
        prefix = b"\1\x0f" + number.to_bytes(10, "big")
        target.receive(hello(prefix, lease=1e9), prefix=prefix)
    assert len(target.node.all(ParticipantFound)) == 100
    assert len(target.node.all(ParticipantLost)) == 80
    assert target.counters.over_limit == 80
    target.later(301.0)
    assert len(target.node.all(ParticipantLost)) == 100


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
        victim.hear(WriterHeartbeat(UNKNOWN_ENTITY, entity, 1, 1, 1))
    assert len(victim.participant._router._early) == 10
    victim.receive(WriterHeartbeat(UNKNOWN_ENTITY, b"\0\0\1\3", 1, 1, 1))  # of a stranger
    assert len(victim.participant._router._early) == 10


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
    assert victim.counters.unsent > 100
    victim.world.run(5.0)
    assert victim.works


def test_the_times_of_sent_samples_are_forgotten_with_them(victim: Victim) -> None:
    """A reader that acknowledges nothing does not make its writer remember more and more."""
    victim.world.kill(victim.peer)
    for number in range(1000):
        victim.write(str(number))
    (proxy,) = victim.writer.readers.values()
    assert len(proxy._sent) <= 2 * victim.writer.kept + 2
    assert victim.writer.kept == 5


def test_packets_of_another_destination_or_of_oneself_are_ignored(victim: Victim) -> None:
    sample = Data(*victim.ends, 1, payload("x"))
    victim.receive(sample, prefix=victim.participant.prefix)
    victim.hear(Destination(b"someone else"), sample)
    assert victim.texts == []


@pytest.mark.parametrize("is_key", [True, False])
def test_a_sample_without_data_is_not_handed_over(victim: Victim, is_key: bool) -> None:
    victim.hear(WriterHeartbeat(*victim.ends, 1, 1, 9))
    content = payload("key") if is_key else None
    victim.hear(Data(*victim.ends, 1, content, None, is_key))
    victim.hear(Data(*victim.ends, 2, payload("two")))
    assert victim.texts == ["two"]
