"""The pace at which a reader requests again what has not come."""

from __future__ import annotations

import itertools

import pytest

from fibaction_transports.rtps.endpoints.catch_up import (
    LONGEST_REPEAT,
    MARGIN,
    SHORTEST_REPEAT,
    AnswerTime,
    RequestPace,
)
from fibaction_transports.rtps.messages.submessages import WriterHeartbeat
from tests.transports.rtps.target import packet
from tests.transports.rtps.world import Link


def requests(pace: RequestPace, last: int, *times: float) -> list[float]:
    """Return the times of those heartbeats at which something is requested."""
    found = list[float]()
    for now in times:
        if pace.may_request(last, now):
            pace.note_request(last, now)
            found.append(now)
    return found


def test_a_request_without_an_answer_is_repeated_after_longer_and_longer_pauses() -> None:
    times = [number / 1000 for number in range(900)]
    asked = requests(RequestPace(AnswerTime()), 5, *times)
    pauses = [after - before for before, after in itertools.pairwise(asked)]
    assert pauses == pytest.approx([0.01, 0.02, 0.04, 0.08, 0.16, 0.32], abs=0.002)


def test_what_was_not_requested_before_is_requested_at_once() -> None:
    pace = RequestPace(AnswerTime())
    assert requests(pace, 5, 1.0, 1.001) == [1.0]
    assert pace.just_requested(0.002, 1.001)
    assert not pace.just_requested(0.002, 1.003)
    assert requests(pace, 6, 1.001) == [1.001]


def test_the_pause_is_that_of_the_latest_answer_for_other_writers_too() -> None:
    latest = AnswerTime()
    pace = RequestPace(latest)
    assert requests(pace, 5, 1.0) == [1.0]
    assert latest.pause == SHORTEST_REPEAT
    pace.note_sample(1.2)
    assert latest.pause == pytest.approx(0.2 * MARGIN)
    pace.note_sample(1.4)  # of the same answer
    assert latest.pause == pytest.approx(0.2 * MARGIN)
    assert requests(pace, 5, 1.25, 1.29, 1.31) == [1.31]
    assert requests(RequestPace(latest), 5, 2.0, 2.2, 2.4) == [2.0, 2.4]


@pytest.mark.parametrize(("seconds", "pause"), [(0.001, SHORTEST_REPEAT), (9.0, LONGEST_REPEAT)])
def test_the_pause_of_an_answer_is_within_bounds(seconds: float, pause: float) -> None:
    latest = AnswerTime()
    pace = RequestPace(latest)
    pace.note_request(5, 1.0)
    pace.note_sample(1.0 + seconds)
    assert latest.pause == pause


def test_heartbeats_that_overtake_the_answer_do_not_multiply_it() -> None:
    link = Link()
    world = link.world
    link.lose(*"abcdefghijklmnopqrst")
    world.is_lost = lambda _, to: to[0] == link.one.host  # the requests are only counted
    sent = world.sent
    for count in range(40):
        ends = link.reader.guid.entity, link.writer.guid.entity
        beat = packet(link.one.participant.prefix, WriterHeartbeat(*ends, 1, 20, 1000 + count))
        link.other.participant.receive(beat, (link.one.host, 7410), world.now + 0.003 * count)
        world.flush()
    assert 2 <= world.sent - sent <= 5
