"""A reader that finds out whether it has all samples, and gets those that are missing."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.endpoints.catch_up import (
    ASK_AGAIN,
    LONGEST_QUESTION,
    REMEMBER,
    CatchUp,
)
from fibaction_transports.rtps.events import CaughtUp
from fibaction_transports.rtps.messages.submessages import AckNack
from fibaction_transports.rtps.qos import Qos, Reliability
from fibaction_transports.rtps.timers import Timers
from tests.transports.rtps.world import KEEP_ALL, Link, World, reader_of, writer_of


def caught_up(link: Link) -> float:
    """Return the seconds until the reader has caught up."""
    begun, before = link.world.now, len(link.other.all(CaughtUp))
    assert link.world.run_until(lambda: len(link.other.all(CaughtUp)) > before, 5.0)
    return link.world.now - begun


@pytest.fixture
def link() -> Link:
    """A link whose reader has received a sample long ago, and lost none."""
    link = Link(requested=KEEP_ALL)
    link.write("first")
    link.world.run(REMEMBER + 1)
    assert link.texts == ["first"]
    return link


def test_a_lost_last_sample_comes_before_the_reader_has_caught_up(link: Link) -> None:
    link.lose("last")
    assert link.reader.catch_up(link.world.now)
    assert link.reader.is_catching_up
    caught_up(link)
    assert link.texts == ["first", "last"]
    assert not link.reader.is_catching_up


def test_without_a_loss_a_question_is_not_put_again_at_once(link: Link) -> None:
    assert link.reader.catch_up(link.world.now)
    assert caught_up(link) < 0.01
    assert not link.reader.catch_up(link.world.now)
    link.world.run(ASK_AGAIN)
    assert link.reader.catch_up(link.world.now)


def test_after_a_loss_each_question_is_put_for_a_while(link: Link) -> None:
    link.lose("lost")
    for _ in range(3):
        assert link.reader.catch_up(link.world.now)
        caught_up(link)
    link.world.run(REMEMBER)
    assert link.reader.catch_up(link.world.now)  # the last one is long ago
    caught_up(link)
    assert not link.reader.catch_up(link.world.now)


def test_a_sample_that_is_missing_is_waited_for(link: Link) -> None:
    assert link.reader.catch_up(link.world.now)
    caught_up(link)
    link.lose("lost")
    link.write("next")
    link.world.run_until(lambda: not link.reader.is_complete(link.writer.guid), 1.0)
    assert link.reader.catch_up(link.world.now)
    caught_up(link)
    assert link.texts == ["first", "lost", "next"]


def test_samples_that_are_gone_are_not_waited_for() -> None:
    link = Link(Qos(depth=1))
    link.lose(*"abc")
    assert link.reader.catch_up(link.world.now)
    caught_up(link)
    assert link.texts == ["c"]


def test_a_question_without_an_answer_is_repeated_and_given_up(link: Link) -> None:
    asked = link.world.heard(AckNack)
    note = link.world.is_lost
    link.world.is_lost = lambda *of: note(*of) or True
    begun = link.world.now
    assert link.reader.catch_up(begun)
    assert caught_up(link) == pytest.approx(LONGEST_QUESTION)
    times = [when - begun for when, _, nack in asked if not nack.is_final]
    assert times == pytest.approx([0.0, 0.02, 0.06, 0.14])


def test_a_writer_that_leaves_ends_the_question() -> None:
    world = World()
    one, other = world.pair()
    for _ in range(2):
        writer_of(world, one)
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
    writer_of(world, one, best_effort)
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
