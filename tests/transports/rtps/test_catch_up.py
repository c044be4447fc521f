"""A reader that finds out whether it has all samples, and gets those that are missing."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.endpoints.catch_up import (
    ASK_AGAIN,
    LONGEST_QUESTION,
    REMEMBER,
    CatchUp,
)
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import CaughtUp
from fibaction_transports.rtps.messages.decoder import read_packet
from fibaction_transports.rtps.messages.locators import Address
from fibaction_transports.rtps.messages.submessages import AckNack
from fibaction_transports.rtps.qos import Qos, Reliability
from fibaction_transports.rtps.timers import Timers
from tests.transports.rtps.world import TOPIC, TYPE, Node, World, payload, reader_of

KEEP_ALL = Qos(depth=None)


def everything(datagram: bytes, address: Address) -> bool:
    return True


def nothing(datagram: bytes, address: Address) -> bool:
    return False


def connected(world: World) -> tuple[Node, DataWriter, DataReader]:
    """Return the node of a reader, and a writer and the reader that have found each other."""
    one, other = world.pair()
    writer = one.participant.create_writer(TOPIC, TYPE, KEEP_ALL, world.now)
    reader = reader_of(world, other, KEEP_ALL)
    world.run(1.0)
    writer.write(payload("first"), world.now)
    world.run(REMEMBER + 1)
    assert other.texts(reader) == ["first"]
    return other, writer, reader


def lose(world: World, writer: DataWriter, text: str) -> None:
    """Write a sample that is lost with its heartbeat."""
    world.is_lost = everything
    writer.write(payload(text), world.now)
    world.flush()
    world.is_lost = nothing


def caught_up(world: World, node: Node) -> float:
    """Return the seconds until the reader of a node has caught up."""
    begun, before = world.now, len(node.all(CaughtUp))
    assert world.run_until(lambda: len(node.all(CaughtUp)) > before, 5.0)
    return world.now - begun


def test_a_lost_last_sample_comes_before_the_reader_has_caught_up() -> None:
    world = World()
    node, writer, reader = connected(world)
    lose(world, writer, "last")
    assert reader.catch_up(world.now)
    assert reader.is_catching_up
    caught_up(world, node)
    assert node.texts(reader) == ["first", "last"]
    assert not reader.is_catching_up


def test_without_a_loss_a_question_is_not_put_again_at_once() -> None:
    world = World()
    node, _, reader = connected(world)
    assert reader.catch_up(world.now)
    assert caught_up(world, node) < 0.01
    assert not reader.catch_up(world.now)
    world.run(ASK_AGAIN)
    assert reader.catch_up(world.now)


def test_after_a_loss_each_question_is_put_for_a_while() -> None:
    world = World()
    node, writer, reader = connected(world)
    lose(world, writer, "lost")
    for _ in range(3):
        assert reader.catch_up(world.now)
        caught_up(world, node)
    world.run(REMEMBER)
    assert reader.catch_up(world.now)  # the last one is long ago
    caught_up(world, node)
    assert not reader.catch_up(world.now)


def test_a_sample_that_is_missing_is_waited_for() -> None:
    world = World()
    node, writer, reader = connected(world)
    assert reader.catch_up(world.now)
    caught_up(world, node)
    lose(world, writer, "lost")
    writer.write(payload("next"), world.now)
    world.run_until(lambda: not reader.is_complete(writer.guid), 1.0)
    assert reader.catch_up(world.now)
    caught_up(world, node)
    assert node.texts(reader) == ["first", "lost", "next"]


def test_samples_that_are_gone_are_not_waited_for() -> None:
    world = World()
    one, other = world.pair()
    writer = one.participant.create_writer(TOPIC, TYPE, Qos(depth=1), world.now)
    reader = reader_of(world, other, Qos(depth=1))
    world.run(1.0)
    for text in "abc":
        lose(world, writer, text)
    assert reader.catch_up(world.now)
    caught_up(world, other)
    assert other.texts(reader) == ["c"]


def test_a_question_without_an_answer_is_repeated_and_given_up() -> None:
    world = World()
    node, _, reader = connected(world)
    asked = list[float]()

    def note(datagram: bytes, _: object) -> bool:
        found = read_packet(datagram).submessages
        asked.extend(world.now for each in found if isinstance(each, AckNack) and not each.is_final)
        return True

    world.is_lost = note
    begun = world.now
    assert reader.catch_up(world.now)
    assert caught_up(world, node) == pytest.approx(LONGEST_QUESTION)
    assert [when - begun for when in asked] == pytest.approx([0.0, 0.02, 0.06, 0.14])


def test_a_writer_that_leaves_ends_the_question() -> None:
    world = World()
    one, other = world.pair()
    for _ in range(2):
        one.participant.create_writer(TOPIC, TYPE, KEEP_ALL, world.now)
    reader = reader_of(world, other, KEEP_ALL)
    world.run(1.0)
    assert reader.catch_up(world.now)
    first, second = reader.writers
    reader.unmatch(first)
    world.flush()
    assert reader.is_catching_up
    assert not other.all(CaughtUp)
    reader.unmatch(second)
    world.flush()
    assert len(other.all(CaughtUp)) == 1


def test_writers_that_cannot_be_asked_are_not() -> None:
    world = World()
    one, other = world.pair()
    best_effort = Qos(reliability=Reliability.BEST_EFFORT)
    reader = reader_of(world, other, best_effort)
    assert not reader.catch_up(world.now)
    one.participant.create_writer(TOPIC, TYPE, best_effort, world.now)
    world.run(1.0)
    assert reader.writers
    assert not reader.catch_up(world.now)


def test_a_heartbeat_from_before_the_question_is_not_the_answer() -> None:
    ends = list[bool]()
    question = CatchUp(Timers(), lambda now: None, lambda: ends.append(True))
    question.hear(7, 3, now=0.5)
    question.start(is_complete=True, now=1.0)
    question.hear(6, 3, now=1.01)  # overtaken
    question.hear(7, 3, now=1.02)  # repeated
    question.sampled_at = 1.03
    question.hear(8, 4, now=1.03)  # with a late sample
    question.settle(expected=5)
    assert question.is_open
    question.hear(9, 5, now=1.04)
    question.settle(expected=5)
    assert question.is_open
    question.settle(expected=6)
    assert ends == [True]
    assert not question.is_open
