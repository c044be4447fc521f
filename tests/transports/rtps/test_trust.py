"""What is believed of a peer, and how much it can make a participant send, and to whom."""

from __future__ import annotations

from typing import Any

from fibaction_transports.rtps.discovery.endpoint_discovery import EndpointData, endpoint_payload
from fibaction_transports.rtps.endpoints.reader import EarlyHeartbeats
from fibaction_transports.rtps.endpoints.sample import DISPOSED, History, StoredSample
from fibaction_transports.rtps.endpoints.writer_proxy import MOST_REQUESTS
from fibaction_transports.rtps.events import (
    EndpointMatched,
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
    udp_locator,
)
from fibaction_transports.rtps.messages.parameters import STATUS_INFO, Parameters
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    FragmentNack,
    Gap,
    NumberSet,
    SourceInfo,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Durability, Qos, Reliability
from fibaction_transports.rtps.router import DISCOVERY_AT_ONCE
from tests.transports.rtps.target import (
    HOST,
    SOURCE,
    STRANGER,
    Target,
    Victim,
    announcement,
    hello,
)
from tests.transports.rtps.world import TOPIC, TYPE, World, payload, reader_of, writer_of

OTHER_HOST = "10.0.0.67"
THIRD = ("10.0.0.77", 7410)
"""The address of someone who has nothing to do with it."""


def names(count: int) -> list[bytes]:
    return [b"\1\x0f" + number.to_bytes(10, "big") for number in range(count)]


def prefixes(target: Target) -> list[bytes]:
    """Return the participants that were found, in order."""
    return [event.prefix for event in target.node.all(ParticipantFound)]


def leaving() -> Data:
    return Data(UNKNOWN_ENTITY, SPDP_WRITER, 2, None, Parameters(((STATUS_INFO, DISPOSED),)))


# The way back


def test_a_participant_that_shows_nothing_is_sent_three_times_what_came(target: Target) -> None:
    target.receive(hello())
    target.later(90.0)
    sent = target.bytes_to(HOST)
    assert 0 < sent <= 3 * target.received
    assert target.counters.withheld > 10
    target.receive(hello())
    target.later(9.0)
    assert sent < target.bytes_to(HOST) <= 3 * target.received


def test_a_participant_that_names_this_one_has_received_something(target: Target) -> None:
    target.receive(hello())
    target.receive(target.here)
    target.later(90.0)
    assert target.bytes_to(HOST) > 10 * target.received


def test_who_announces_the_address_of_another_host_cannot_direct_much_to_it(target: Target) -> None:
    target.receive(hello(STRANGER, THIRD))
    target.receive(target.here)
    target.later(90.0)
    assert 0 < target.bytes_to(THIRD[0]) <= 3 * target.received


def test_of_several_addresses_the_one_of_the_sender_is_used(target: Target) -> None:
    target.receive(hello(STRANGER, THIRD, SOURCE, data_locators=(udp_locator(THIRD),)))
    target.receive(target.here)
    best_effort = Qos(reliability=Reliability.BEST_EFFORT)
    writer = writer_of(target.world, target.node, best_effort)
    for number, locators in enumerate([(), (udp_locator(THIRD),)], 1):
        data = EndpointData(
            guid=Guid(STRANGER + bytes([0, 0, number, 4])),
            topic=TOPIC,
            type_name=TYPE,
            qos=best_effort,
            locators=locators,
        )
        content = endpoint_payload(data)
        ends = SUBSCRIPTIONS_READER, SUBSCRIPTIONS_WRITER
        target.receive(WriterHeartbeat(*ends, 1, 2, number), Data(*ends, number, content))
    assert len(writer.readers) == 2
    writer.write(payload("x"), target.world.now)
    target.take()
    target.later(9.0)
    assert target.bytes_to(THIRD[0]) == 0
    assert target.bytes_to(HOST) > 0


# The name of another participant


def test_a_participant_is_not_ended_from_another_host(target: Target) -> None:
    target.receive(hello())
    target.receive(leaving(), host=THIRD[0])
    assert target.node.all(ParticipantLost) == []
    assert target.counters.forged == 1
    target.receive(leaving())
    assert len(target.node.all(ParticipantLost)) == 1


def test_a_participant_may_send_from_each_address_that_it_announces_and_this_machine() -> None:
    for source in (THIRD[0], "127.0.0.1"):
        target = Target()
        target.receive(hello(data_locators=(udp_locator(THIRD),)))
        target.receive(leaving(), host=source)
        assert len(target.node.all(ParticipantLost)) == 1


def test_samples_in_the_name_of_another_host_are_dropped(victim: Victim) -> None:
    victim.receive(
        SourceInfo(b"\1\x7f", victim.peer.participant.prefix),
        WriterHeartbeat(*victim.ends, 2**40, 2**40, 99),
        Data(*victim.ends, 1, payload("forged")),
    )
    assert victim.counters.forged == 2
    assert victim.texts == []
    assert victim.works


# Newcomers


def test_participants_that_have_shown_nothing_make_room_for_others() -> None:
    target = Target(RtpsLimits(participants=3))
    at = {f"10.0.1.{number}": name for number, name in enumerate(names(5))}
    first, second, *others, last, latest = at

    def greet(host: str) -> None:
        target.receive(hello(at[host], (host, 7410)), prefix=at[host], host=host)

    for host in (first, second, *others):
        greet(host)
    target.receive(target.here, prefix=at[first], host=first)
    greet(last)
    (lost,) = target.node.all(ParticipantLost)
    assert lost.prefix == at[second]
    for host in (*others, last):
        target.receive(target.here, prefix=at[host], host=host)
    greet(latest)
    assert len(target.node.all(ParticipantLost)) == 1
    assert len(target.node.all(ParticipantFound)) == 4


def test_a_host_has_only_so_many_participants() -> None:
    target = Target(RtpsLimits(participants_of_host=2))
    first, second, third, elsewhere = names(4)
    for name in (first, second):
        target.receive(hello(name), prefix=name)
        target.receive(target.here, prefix=name)
    target.receive(hello(third), prefix=third)
    target.receive(hello(elsewhere), prefix=elsewhere, host=OTHER_HOST)
    assert prefixes(target) == [first, second, elsewhere]
    target.receive(leaving(), prefix=first)
    target.receive(hello(third), prefix=third)
    assert prefixes(target)[-1] == third


def test_a_storm_of_newcomers_is_taken_slowly(target: Target) -> None:
    *many, other = names(1001)
    for name in many:
        target.receive(hello(name), prefix=name)
    assert len(prefixes(target)) <= 130
    target.receive(hello(other, (OTHER_HOST, 7410)), prefix=other, host=OTHER_HOST)
    assert prefixes(target)[-1] == other


def test_hosts_with_newcomers_are_forgotten_when_they_may_begin_again() -> None:
    rates = HostRates(2, 1.0, hosts=2)
    assert rates.take("a", 0.0)
    assert rates.take("b", 0.5)
    assert not rates.take("c", 0.5)
    assert rates.take("a", 0.5)
    assert not rates.take("a", 0.6)
    assert rates.take("c", 1.5)
    assert not rates.take("d", 1.5)


def test_samples_of_discovery_in_one_datagram_are_bounded(target: Target) -> None:
    vendor = STRANGER[:2]
    pairs = [(SourceInfo(vendor, name), hello(name)) for name in names(DISCOVERY_AT_ONCE + 9)]
    target.receive(*(each for pair in pairs for each in pair))
    assert len(prefixes(target)) == DISCOVERY_AT_ONCE
    assert target.counters.over_limit == 9


def test_an_announcement_that_repeats_at_once_is_not_read(target: Target) -> None:
    target.receive(hello())
    broken = announcement(b"\0\3\0\0")
    target.later(0.001)
    target.receive(broken)
    assert target.counters.invalid == 0
    target.later(0.1)
    target.receive(broken)
    assert target.counters.invalid == 1


def test_endpoints_of_one_participant_are_matched_up_to_a_limit() -> None:
    world = World()
    node, peer = world.join(limits=RtpsLimits(matches_of_one=3)), world.join()
    other = world.join()
    reader, writer = reader_of(world, node), writer_of(world, node)
    for _ in range(5):
        writer_of(world, peer)
        reader_of(world, peer)
    writer_of(world, other)
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
    victim.writer = writer_of(victim.world, victim.node, qos)
    victim.world.run(1.0)
    victim.write(*["x" * size] * count)
    return victim


def test_requests_for_large_samples_again_and_again_are_answered_as_far_as_the_budget_goes() -> (
    None
):
    victim = large_writer(1_000_000, 10)
    everything = NumberSet(1, tuple(range(1, 11)))
    sent = 0
    for count in range(1000):
        victim.later(0.01)
        sent += victim.hear(AckNack(*victim.asking, everything, count))
        sent += victim.hear(FragmentNack(*victim.asking, 3, NumberSet(1, (1, 2, 16)), count))
    written, time = 2 * 10_001_000, 10 * REPAIRS_PER_SECOND
    assert 20_000_000 < sent < 1.1 * (written + time + REPAIRS_AT_ONCE + 1_000_000)
    assert victim.works


def test_gaps_are_answered_as_far_as_the_budget_goes() -> None:
    victim = large_writer(4, 600)
    for _ in range(600):
        victim.writer.write(payload("x"), victim.world.now, only_to=Guid(bytes(16)))
    victim.take()
    (proxy,) = (each for each in victim.writer.readers.values())
    proxy._budget = PeerBudget(victim.world.now)
    odd = NumberSet(700, tuple(range(700, 956, 2)))
    sent = sum(victim.hear(AckNack(*victim.asking, odd, count)) for count in range(2000))
    assert sent < 2 * REPAIRS_AT_ONCE


def test_a_gap_is_repeated_no_sooner_than_a_sample() -> None:
    victim = large_writer(4, 3)
    victim.write(*"123456")
    nacks = [AckNack(*victim.asking, NumberSet(1, (1, 2, 3)), count) for count in range(100)]
    assert 0 < victim.hear(*nacks) < 200
    victim.later(0.01)
    assert 0 < victim.hear(*nacks) < 200


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


def test_many_questions_of_a_reader_at_once_have_one_answer(victim: Victim) -> None:
    questions = [AckNack(*victim.asking, NumberSet(0), count) for count in range(500)]
    assert 0 < victim.hear(*questions) < 200
    assert victim.hear(*questions) == 0
    victim.later(0.01)
    assert 0 < victim.hear(*questions) < 200


def test_many_heartbeats_at_once_have_one_answer(victim: Victim) -> None:
    beats = [WriterHeartbeat(*victim.ends, 1, 200, count) for count in range(500)]
    assert 0 < victim.hear(*beats) < 300
    assert victim.later(0.02) < 300
    victim.later(0.5)
    assert 0 < victim.hear(*beats) < 300


def test_what_does_not_come_is_requested_only_so_often(victim: Victim) -> None:
    victim.hear(WriterHeartbeat(*victim.ends, 1, 200, 1))
    victim.hear(DataFragment(*victim.ends, 3, 1, 1, 100, 200, bytes(100)))
    for _ in range(12):
        victim.later(10.0)
        # Its peer shows that it is there.
        victim.hear(announcement(victim.peer.participant._participants._payload))
    (proxy,) = victim.reader.proxies.values()
    assert proxy._requests == MOST_REQUESTS
    assert victim.participant._shared.partials.held == 0
    assert victim.works


def test_a_participant_gives_up_its_own_incomplete_samples_first() -> None:
    limits = RtpsLimits(sample=100_000, incomplete=1_000_000)
    victim = Victim(limits)
    honest = victim.world.join()
    writer = writer_of(victim.world, honest)
    victim.world.run(1.0)
    ends = victim.reader.guid.entity, writer.guid.entity
    first = DataFragment(*ends, 1, 1, 1, 100, 200, payload("a" * 96))
    second = DataFragment(*ends, 1, 2, 1, 100, 200, bytes(100))
    of_honest: Any = {"prefix": honest.participant.prefix, "host": honest.host}
    victim.receive(WriterHeartbeat(*ends, 1, 1, 9), first, **of_honest)
    for number in range(1, 250):
        victim.hear(DataFragment(*victim.ends, number, 1, 1, 60_000, 99_999, bytes(60_000)))
    assert victim.participant._shared.partials.held > 800_000
    victim.receive(second, **of_honest)
    assert len(victim.texts) == 1


def test_a_request_for_a_fragment_of_a_gap_costs_the_budget() -> None:
    victim = large_writer(4, 3)
    victim.write(*"123456")
    (proxy,) = victim.writer.readers.values()
    nack = FragmentNack(*victim.asking, 1, NumberSet(1, (1,)), 9)
    assert 0 < victim.hear(nack) < 200
    proxy._budget.may_repair(MOST_REPAIRS, victim.world.now)
    assert victim.hear(nack) == 0


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


def test_what_strangers_send_is_left_out(target: Target) -> None:
    ends = PUBLICATIONS_READER, PUBLICATIONS_WRITER
    for sent in (AckNack(*ends, NumberSet(0), 1), Gap(*ends, 1, NumberSet(9))):
        target.receive(WriterHeartbeat(*ends, 1, 9, 1), sent)
    assert target.sent == []
