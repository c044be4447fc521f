"""Samples over a network that loses, delays, repeats and reorders: in order, once, and all."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fibaction.words.errors import LimitReached
from fibaction_transports.rtps.endpoints.sample import StoredSample, padded
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import SamplesLost
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.codec import packet_head, read_packet, submessage_bytes
from fibaction_transports.rtps.messages.ids import UNKNOWN_ENTITY, Guid
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    Gap,
    NumberSet,
    Timestamp,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Durability, Qos, Reliability
from tests.transports.rtps.world import (
    KEEP_ALL,
    Link,
    World,
    payload,
    reader_of,
    writer_of,
    writers_in,
)

LATE = Qos(durability=Durability.TRANSIENT_LOCAL, depth=3)
BEST_EFFORT = Qos(reliability=Reliability.BEST_EFFORT)


def write(world: World, writer: DataWriter, *texts: str) -> None:
    for text in texts:
        writer.write(payload(text), world.now)


def numbers(*of: int) -> list[str]:
    return [str(number) for number in range(*of)]


@given(
    seed=st.integers(0, 10**6),
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    delay=st.sampled_from([0.0001, 0.01, 0.2]),
    repeats=st.sampled_from([0.0, 0.3]),
    size=st.sampled_from([1, 500]),
)
@settings(deadline=None)
def test_every_sample_of_a_reliable_writer_arrives_in_order_and_once(
    seed: int, loss: float, delay: float, repeats: float, size: int
) -> None:
    world = World(seed, loss=loss, delay=delay, repeats=repeats)
    one, other = world.join(fragment_size=256), world.join(fragment_size=256)
    writer, reader = writer_of(world, one), reader_of(world, other)
    assert world.run_until(lambda: bool(writer.readers and reader.writers), 300)
    texts = [f"{number}" * size for number in range(30)]
    for text in texts:
        write(world, writer, text)
        world.run(0.01)

    assert world.run_until(lambda: len(other.texts(reader)) == len(texts), 300)
    assert world.run_until(lambda: writer.kept == 0, 300)
    assert writer.acknowledged(world.now) == writer.last
    assert other.texts(reader) == texts
    assert other.participant.counters.invalid == 0


def test_no_fragment_is_sent_twice_if_none_is_lost() -> None:
    link = Link()
    fragments = link.world.heard(DataFragment)
    link.write("x" * 1_000_000)
    assert link.world.run_until(lambda: bool(link.texts))
    assert [each.first for _, _, each in fragments] == list(range(1, 17))


def test_a_late_reader_gets_the_samples_that_are_kept_for_it() -> None:
    world = World(5, loss=0.2)
    one, other = world.pair()
    writer = writer_of(world, one, LATE)
    write(world, writer, *numbers(10))
    world.run(1.0)
    reader = reader_of(world, other, LATE)
    assert world.run_until(lambda: len(other.texts(reader)) == 3)
    write(world, writer, "10")
    assert world.run_until(lambda: len(other.texts(reader)) == 4)
    assert other.texts(reader) == numbers(7, 11)
    assert writer.kept == 3


def test_a_late_reader_gets_no_sample_whose_lifespan_is_over() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one, Qos(durability=LATE.durability, depth=3, lifespan=10.0))
    write(world, writer, *"abcde")  # the history forgets the first two of them before
    for number in numbers(6):
        write(world, writer, number)
        world.run(4.0)
    reader = reader_of(world, other, LATE)
    assert world.run_until(lambda: len(other.texts(reader)) == 2)
    assert writer.kept == 2
    write(world, writer, "6")
    assert world.run_until(lambda: len(other.texts(reader)) == 3)
    assert other.texts(reader) == numbers(4, 7)
    assert other.all(SamplesLost) == []
    world.run(20.0)
    write(world, writer, "7")
    assert writer.kept == 1


def test_a_reader_that_comes_late_gets_the_first_sample_that_is_for_it() -> None:
    """As the first reply of a service, whose heartbeat is lost."""
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one)
    write(world, writer, *numbers(10))
    reader = reader_of(world, other)
    assert world.run_until(lambda: bool(writer.readers))
    world.is_lost = lambda datagram, _: world.now < 1.5
    write(world, writer, "10")
    world.run(2.0)
    write(world, writer, "11")
    world.run(2.0)
    assert other.texts(reader) == ["10", "11"]


def test_of_samples_that_follow_each_other_fast_few_have_a_heartbeat() -> None:
    link = Link()
    heartbeats = link.world.heard(WriterHeartbeat)
    for number in numbers(200):
        link.write(number)
        link.world.run(0.0005)
    assert len(heartbeats) <= 20
    link.world.run(1.0)
    assert link.texts == numbers(200)
    assert link.writer.kept == 0  # the last ones are acknowledged, too


def test_a_writer_tells_whether_all_but_the_newest_samples_have_arrived() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one)
    write(world, writer, "0")
    assert writer.has_arrived(0)  # nobody reads
    reader_of(world, other)
    world.run(1.0)
    write(world, writer, "1", "2")
    assert writer.has_arrived(2)
    assert not writer.has_arrived(1)
    world.run(1.0)
    assert writer.has_arrived(0)
    reader_of(world, other, Qos(reliability=Reliability.BEST_EFFORT))
    world.run(1.0)
    assert not writer.has_arrived(100)  # that reader does not tell


def test_samples_have_a_heartbeat_each_while_a_reader_lacks_older_ones() -> None:
    link = Link()
    link.lose("lost")
    link.write("comes")
    link.world.run(0.0062)  # the request is under way, and its answer is not
    heartbeats = link.world.heard(WriterHeartbeat)
    for number in numbers(5):
        link.write(number)
        link.world.flush()
    assert [each.last for _, _, each in heartbeats] == [3, 4, 5, 6, 7]


def test_a_lost_sample_comes_soon_after_the_next_one_though_that_has_no_heartbeat() -> None:
    link = Link()
    link.write("0")
    link.world.run(0.001)
    link.lose("1")
    link.write("2")
    link.world.run(0.008)
    assert link.texts == numbers(3)


def test_samples_beyond_the_depth_are_lost_to_a_slow_reader_which_is_told() -> None:
    link = Link(Qos(depth=2))
    link.write("0")
    link.world.run(1.0)
    link.lose(*numbers(1, 10))
    link.world.run(5.0)
    assert link.texts == ["0", "8", "9"]
    lost = [(event.writer, event.count) for event in link.other.all(SamplesLost)]
    assert lost == [(link.writer.guid, 7)]


def test_best_effort_samples_arrive_in_order_and_are_not_sent_again() -> None:
    world = World(7, loss=0.3, delay=0.005, repeats=0.2)
    one, other = world.join(fragment_size=256), world.join()
    writer, reader = writer_of(world, one, BEST_EFFORT), reader_of(world, other, BEST_EFFORT)
    assert world.run_until(lambda: bool(writer.readers and reader.writers))
    for number in range(200):
        write(world, writer, str(number), f"{number}" * 200)
        world.run(0.002)
    world.run(1.0)
    got = [text[:3] for text in other.texts(reader)]
    assert 50 < len(got) < 400
    places = [sample.number for sample in other.samples(reader)]
    assert places == sorted(set(places))
    assert writer.kept == 0
    assert writer.acknowledged(world.now) == writer.last


def test_kept_samples_are_sent_to_a_late_reader_that_is_best_effort() -> None:
    world = World()
    one, other = world.pair()
    late = Qos(reliability=Reliability.BEST_EFFORT, durability=Durability.TRANSIENT_LOCAL)
    writer = writer_of(world, one, LATE)
    write(world, writer, "0")
    reader = reader_of(world, other, late)
    world.run(1.0)
    assert set(other.texts(reader)) <= {"0"}
    assert list(writer.readers) == [reader.guid]


def test_a_sample_for_one_reader_leaves_no_hole_for_the_others() -> None:
    world = World(2, loss=0.2)
    server, one, other = world.join(), world.join(), world.join()
    writer = writer_of(world, server)
    first, second = reader_of(world, one), reader_of(world, other)
    assert world.run_until(lambda: len(writer.readers) == 2)
    world.run(1.0)
    for number in range(20):
        target = (first, second)[number % 2].guid
        writer.write(payload(str(number)), world.now, only_to=target)
    assert world.run_until(lambda: writer.acknowledged(world.now) == 20)
    assert one.texts(first) == numbers(0, 20, 2)
    assert other.texts(second) == numbers(1, 20, 2)
    assert one.all(SamplesLost) == other.all(SamplesLost) == []
    assert writer.kept == 0


def test_a_sample_for_another_reader_is_nothing_to_one_that_is_best_effort() -> None:
    world = World()
    server, one, other = world.join(), world.join(), world.join()
    writer = writer_of(world, server)
    modest, target = reader_of(world, one, BEST_EFFORT), reader_of(world, other)
    world.run(1.0)
    writer.write(payload("0"), world.now, only_to=target.guid)
    write(world, writer, "for all")
    world.run(1.0)
    assert one.texts(modest) == ["for all"]
    assert other.texts(target) == ["0", "for all"]


def test_a_full_history_rejects_samples_until_readers_have_acknowledged() -> None:
    world = World()
    one, other = world.join(limits=RtpsLimits(history=1000, history_samples=3)), world.join()
    writer, reader = writer_of(world, one), reader_of(world, other)
    world.run(1.0)
    write(world, writer, "0", "1", "2")
    with pytest.raises(LimitReached, match=r"history of 3 samples and 24 bytes is full"):
        write(world, writer, "3")
    world.run(1.0)
    write(world, writer, "3")
    with pytest.raises(LimitReached):
        write(world, writer, "x" * 1000)
    world.run(1.0)
    assert other.texts(reader) == numbers(4)


def test_a_reader_that_is_silent_for_long_keeps_nothing_back() -> None:
    link = Link()
    link.world.kill(link.other)
    link.write("0")
    link.world.run(9.0)
    assert link.writer.acknowledged(link.world.now) == 0
    link.world.run(2.0)
    link.write("1")
    assert list(link.writer.readers) == [link.reader.guid]
    assert link.writer.kept == 0


def asking(*texts: str) -> Link:
    """Return a link whose reader asks for these samples, which are lost each time."""
    link = Link()
    entity = link.writer.guid.entity
    link.world.is_lost = lambda datagram, _: entity in writers_in(datagram, Data)
    link.write(*texts)
    return link


def test_a_reader_that_asks_for_a_minute_gets_what_it_lacks() -> None:
    link = asking("0", "1")
    link.world.run(55.0)
    assert link.texts == []
    link.world.is_lost = lambda *_: False
    link.world.run(5.0)
    assert link.texts == ["0", "1"]
    assert link.writer.kept == 0


@pytest.mark.parametrize(
    ("texts", "kept_for", "gone_after"),
    [
        pytest.param(["0"], 55.0, 62.0, id="few"),
        pytest.param(["many"] * 257, 9.0, 12.0, id="many"),
        pytest.param(["x" * 60_000] * 18, 9.0, 12.0, id="large"),
    ],
)
def test_samples_are_not_kept_for_longer_for_a_reader_that_asks(
    texts: list[str], kept_for: float, gone_after: float
) -> None:
    link = asking(*texts)
    link.world.run(kept_for)
    assert link.writer.kept == len(texts)
    link.world.run(gone_after - kept_for)
    assert link.writer.kept == 0


def test_a_sample_is_kept_for_a_reader_that_was_found_long_ago_and_has_not_answered() -> None:
    world = World()
    one, other = world.pair()
    writer, reader = writer_of(world, one), reader_of(world, other)
    world.is_lost = lambda datagram, _: writer.guid.entity in writers_in(datagram)
    world.run(15.0)
    assert list(writer.readers) == [reader.guid]
    write(world, writer, "0")
    assert writer.kept == 1
    world.is_lost = lambda *_: False
    world.run(5.0)
    assert other.texts(reader) == ["0"]
    world.is_lost = lambda *_: True
    write(world, writer, "1")
    world.run(12.0)
    assert writer.kept == 0


def test_a_sample_has_the_time_and_the_parameters_of_its_writer() -> None:
    link, stamp = Link(), 1_700_000_000.123456789
    writer, now = link.writer, link.world.now
    writer.write(payload("a"), now, time=stamp, inline_qos=[(0x83, b"x" * 24)])
    writer.write(payload("b"), now)
    writer.write(payload("c" * 100_000), now, time=stamp, inline_qos=[(0x83, b"y" * 24)])
    link.world.run(1.0)
    samples = link.other.samples(link.reader)
    assert [sample.time for sample in samples] == [pytest.approx(stamp, abs=1e-6), None, stamp]
    values = [s.inline_qos and s.inline_qos.all(0x83) for s in samples]
    assert values == [[b"x" * 24], None, [b"y" * 24]]


def test_a_reader_asks_when_it_is_told_to() -> None:
    link = Link()
    unreliable = reader_of(link.world, link.other, BEST_EFFORT)
    link.world.run(1.0)
    link.reader.ask(link.world.now)
    unreliable.ask(link.world.now)
    (packet,) = link.other.sent()
    (nack,) = [each for each in packet if isinstance(each, AckNack)]
    assert (nack.reader, nack.is_final) == (link.reader.guid.entity, False)
    assert nack.missing.base == 1


def test_several_samples_and_their_heartbeat_travel_in_one_datagram() -> None:
    link = Link()
    link.write(*numbers(100), *("x" * 60_000 for _ in range(3)))
    datagrams = [datagram for datagram, _ in link.one.participant.datagrams_to_send()]
    assert len(datagrams) == 4  # the first one has as many samples as one may have
    assert max(map(len, datagrams)) < 65_507
    packets = [read_packet(datagram).submessages for datagram in datagrams]
    (heartbeat,) = [each for one in packets for each in one if isinstance(each, WriterHeartbeat)]
    assert heartbeat.last == 103  # one for all
    assert not any(isinstance(each, Timestamp) for each in packets[0])
    for datagram in datagrams:
        link.other.participant.receive(datagram, (link.one.host, 7410), link.world.now)
    link.world.flush()
    assert len(link.texts) == 103


def test_a_reader_that_a_sample_is_not_for_gets_what_it_lacked_before() -> None:
    world = World()
    one, other, third = world.join(), world.join(), world.join()
    writer = writer_of(world, one, LATE)
    readers = reader_of(world, other, LATE), reader_of(world, third, LATE)
    world.run(1.0)
    world.is_lost = lambda _, to: to[0] == other.host
    write(world, writer, "a")
    sample = StoredSample(payload=padded(payload("b")))
    writer.write_sample(sample, world.now, only_at={third.participant.prefix})
    world.flush()
    world.is_lost = lambda datagram, address: False
    world.run(2.0)
    assert other.texts(readers[0])[0] == "a"
    assert third.texts(readers[1]) == ["a", "b"]
    assert world.run_until(lambda: writer.acknowledged(world.now) == 2)


def test_a_sample_for_two_readers_of_one_participant_is_sent_once() -> None:
    link = Link()
    readers = [link.reader, reader_of(link.world, link.other, BEST_EFFORT)]
    link.world.run(1.0)
    samples = link.world.heard(Data)
    link.write("x" * 10_000)
    link.world.run(0.01)
    ((_, address, sample),) = samples
    assert sample.reader == UNKNOWN_ENTITY
    assert address == (link.other.host, 7411)
    assert [len(link.other.texts(each)) for each in readers] == [1, 1]


def test_a_sample_that_is_repeated_before_it_is_sent_is_sent_once() -> None:
    link = Link()
    link.write("a")
    reader = link.reader.guid
    nack = AckNack(reader.entity, link.writer.guid.entity, NumberSet(1, (1,)), 1000)
    link.writer.receive_acknack(reader, nack, link.world.now + 1.0)
    (packet,) = link.one.sent()
    (sample,) = [each for each in packet if isinstance(each, Data)]
    assert sample.reader == reader.entity
    assert link.one.participant.outbox.count == 0


@pytest.mark.parametrize(
    ("content", "inline_qos", "message"),
    [
        (b"abc", [], "no encapsulation header of 4 bytes"),
        (payload("a"), [(1, b"x"), (2, bytes(1024))], "inline QoS of 1025 bytes exceed 1024 bytes"),
    ],
)
def test_a_sample_that_cannot_be_sent_is_rejected(
    content: bytes, inline_qos: list[tuple[int, bytes]], message: str
) -> None:
    world = World()
    writer = writer_of(world, world.join())
    with pytest.raises(ValueError, match=message):
        writer.write(content, world.now, inline_qos=inline_qos)


def test_a_depth_that_keeps_nothing_is_rejected() -> None:
    world = World()
    with pytest.raises(ValueError, match="depth 0 keeps no sample: use 1 or more"):
        writer_of(world, world.join(), Qos(depth=0))


def test_samples_are_kept_until_the_last_reader_has_them() -> None:
    world = World()
    one, near, far = world.join(), world.join(), world.join()
    writer = writer_of(world, one)
    readers = [reader_of(world, near), reader_of(world, far)]
    world.run(1.0)
    world.is_lost = lambda _, address: address[0] == far.host
    write(world, writer, *numbers(5))
    world.run(1.0)
    assert near.texts(readers[0]) == numbers(5)
    assert writer.kept == 5
    world.is_lost = lambda *_: False
    world.run(3.0)
    assert far.texts(readers[1]) == numbers(5)
    assert writer.kept == 0


def test_samples_before_a_reader_came_are_not_announced_and_not_sent_to_it() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one, LATE)
    write(world, writer, *numbers(3))
    reader = reader_of(world, other)
    world.run(1.0)
    world.is_lost = lambda *_: True
    write(world, writer, "3")
    (packet,) = one.sent()
    heartbeat = packet[-1]
    assert isinstance(heartbeat, WriterHeartbeat)
    assert (heartbeat.first, heartbeat.last) == (4, 4)
    world.run(0.01)
    nack = AckNack(reader.guid.entity, writer.guid.entity, NumberSet(1, (1, 2, 3)), 9)
    writer.receive_acknack(reader.guid, nack, world.now)
    (packet,) = one.sent()
    assert [type(each) for each in packet] == [Destination, Gap, WriterHeartbeat]


def test_a_gap_may_be_longer_than_the_window() -> None:
    world = World()
    one, other, third = world.join(), world.join(), world.join()
    writer = writer_of(world, one)
    reader, target = reader_of(world, other), reader_of(world, third)
    world.run(1.0)
    world.is_lost = lambda _, address: address[0] == other.host
    for number in range(1000):
        writer.write(payload(str(number)), world.now, only_to=target.guid)
    world.run(1.0)
    world.is_lost = lambda *_: False
    write(world, writer, "for all")
    assert world.run_until(lambda: other.texts(reader) == ["for all"])
    assert other.all(SamplesLost) == []
    gap = Gap(reader.guid.entity, writer.guid.entity, 1002, NumberSet(3000))
    reader.proxies[writer.guid].receive_gap(gap, world.now)
    data = Data(reader.guid.entity, writer.guid.entity, 3000, payload("after"))
    reader.proxies[writer.guid].receive_data(data, None, world.now)
    world.flush()
    assert other.texts(reader) == ["for all", "after"]


class NewReader:
    """A reader of a writer that has just found it, and whose answers are lost at first."""

    def __init__(self, qos: Qos = KEEP_ALL) -> None:
        self.world = World()
        self.one, self.other = self.world.pair()
        self.is_mute = True
        self.sent: list[Data | WriterHeartbeat] = []
        self.world.is_lost = self._is_lost
        self.writer = writer_of(self.world, self.one, qos)
        self.reader = reader_of(self.world, self.other)
        self.world.run_until(lambda: bool(self.writer.readers))

    def _is_lost(self, datagram: bytes, address: object) -> bool:
        for submessage in read_packet(datagram).submessages:
            match submessage:
                case AckNack(writer=self.writer.guid.entity):
                    return self.is_mute
                case (
                    Data(writer=self.writer.guid.entity)
                    | WriterHeartbeat(writer=self.writer.guid.entity)
                ):
                    self.sent.append(submessage)
        return False

    @property
    def samples(self) -> list[int]:
        """The numbers of the samples that were sent."""
        return [each.number for each in self.sent if isinstance(each, Data)]

    def ask(self) -> None:
        """Let the writer hear a question for a heartbeat, as of a reader that has heard none."""
        question = AckNack(self.reader.guid.entity, self.writer.guid.entity, NumberSet(1), 1)
        content = packet_head(b"\x01\x10", self.reader.guid.prefix) + submessage_bytes(question)
        self.one.participant.receive(content, (self.other.host, 7410), self.world.now)
        self.world.run(0.001)


def test_a_new_reader_gets_samples_only_when_it_has_answered_a_heartbeat_of_none() -> None:
    new = NewReader()
    write(new.world, new.writer, "a", "b")
    new.world.run(3.0)
    assert new.samples == []
    heartbeats = [each for each in new.sent if isinstance(each, WriterHeartbeat)]
    assert {(each.first, each.last) for each in heartbeats} == {(1, 0)}
    assert len(heartbeats) >= 5
    new.is_mute = False
    new.world.run(1.1)
    assert new.other.texts(new.reader) == ["a", "b"]
    assert new.samples == [1, 2]


def test_questions_for_a_heartbeat_are_an_answer_only_if_there_are_several() -> None:
    new = NewReader()
    write(new.world, new.writer, "a")
    for _ in range(2):
        new.ask()
        assert new.samples == []
    new.ask()
    assert new.samples == [1]


def test_a_new_reader_is_told_of_samples_that_are_gone_before_it_has_answered() -> None:
    new = NewReader(Qos(depth=2))
    write(new.world, new.writer, *numbers(5))
    new.world.run(0.1)
    new.is_mute = False
    new.world.run(1.1)
    assert new.other.texts(new.reader) == ["3", "4"]
    assert [event.count for event in new.other.all(SamplesLost)] == [3]
    assert new.writer.kept == 0


def test_a_writer_is_confirmed_when_its_heartbeat_shows_that_it_has_found_the_reader() -> None:
    world = World()
    one, other = world.pair()
    writer = writer_of(world, one)
    entity = writer.guid.entity
    world.is_lost = lambda datagram, _: entity in writers_in(datagram, WriterHeartbeat)
    reader, modest = reader_of(world, other), reader_of(world, other, BEST_EFFORT)
    world.run(1.0)
    assert reader.writers == modest.writers == [writer.guid]
    assert reader.confirmed_writers == set()
    assert modest.confirmed_writers == {writer.guid}
    world.is_lost = lambda *_: False
    assert world.run_until(lambda: reader.confirmed_writers == {writer.guid}, 3.0)


def test_a_fragment_size_that_does_not_fit_is_rejected() -> None:
    with pytest.raises(ValueError, match="fragment size 65000 is not between 256 and 63,000"):
        World().join(fragment_size=65_000)


def test_the_ends_of_one_participant_exchange_samples_and_a_paused_reader_is_waited_for() -> None:
    world = World()
    node = world.join()
    writer, reader = writer_of(world, node), reader_of(world, node)
    node.participant.match_own(writer, world.now)
    write(world, writer, "a")
    other = StoredSample(payload=padded(payload("for another")), only_to=Guid(bytes(16)))
    reader.take_own(writer.guid, 2, other, world.now)
    world.run(0.1)
    assert node.texts(reader) == ["a"]
    assert writer.waiting(world.now) == 0
    reader.pause(world.now, is_paused=True)
    assert writer.waiting(world.now) == writer.last == 1


def test_a_reader_goes_on_before_its_writer_has_told_of_samples() -> None:
    link = Link(BEST_EFFORT, BEST_EFFORT)
    for is_paused in (True, False):
        link.reader.pause(link.world.now, is_paused=is_paused)
    link.write("a")
    link.world.run(0.1)
    assert link.texts == ["a"]
