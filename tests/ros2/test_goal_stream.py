"""The stream with which a client follows one goal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, cast

import pytest

from fibaction import ConnectionLost, GoalID, GoalInfo, GoalStatus, Outcome
from fibaction.border.abc import FeedbackItem, GoalUpdate
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.ends import Undecoded

pytestmark = pytest.mark.anyio

LOST = ConnectionLost("it is gone")


def new_stream(depth: int = 3, *, reads: bool = True) -> RosGoalStream:
    made = RosGoalStream(GoalID.random(), Undecoded(), depth, reads=reads)
    made.begin(GoalInfo(made.goal_id, 5, GoalStatus.ACCEPTED))
    return made


def facts_of(items: Sequence[GoalUpdate]) -> list[tuple[int, bytes]]:
    return [(item.number, item.payload) for item in items if isinstance(item, FeedbackItem)]


async def test_unread_feedback_is_bounded_and_dropped_feedback_is_counted() -> None:
    stream = new_stream(3)
    for number in range(5):
        stream.add_feedback(bytes([number]))
    arrived_by = time.time_ns()
    items = stream.take(2)
    assert facts_of(items) == [(3, b"\2"), (4, b"\3")]
    assert all(cast("FeedbackItem", item).at <= arrived_by for item in items)
    assert stream.dropped == 2
    assert facts_of(stream.take(2)) == [(5, b"\4")]
    assert stream.take(2) == ()
    stream.end(Outcome(GoalStatus.SUCCEEDED, b""))
    assert stream.take() == (stream.known_outcome(),)
    assert (await stream.outcome()).status is stream.status is GoalStatus.SUCCEEDED
    stream.fail(LOST)  # too late
    assert stream.take() == (stream.known_outcome(),)
    assert stream.dropped == 2


@pytest.mark.parametrize("end", [RosGoalStream.end, RosGoalStream.set_outcome])
async def test_a_result_that_comes_before_the_acceptance_is_the_end_all_the_same(end: Any) -> None:
    stream = RosGoalStream(GoalID.random(), Undecoded(), 3, reads=True)
    end(stream, Outcome(GoalStatus.SUCCEEDED, b""))
    stream.begin(GoalInfo(stream.goal_id, 5, GoalStatus.ACCEPTED))
    assert stream.status is GoalStatus.SUCCEEDED
    assert stream.stamp == 5


async def test_statuses_come_before_feedback_and_only_forward() -> None:
    stream = new_stream()
    stream.add_feedback(b"x")
    for status in (GoalStatus.EXECUTING, GoalStatus.ACCEPTED, GoalStatus.SUCCEEDED):
        stream.set_status(status)
    assert await anext(aiter(stream)) is GoalStatus.EXECUTING
    assert facts_of([await anext(aiter(stream))]) == [(1, b"x")]
    assert stream.status is GoalStatus.SUCCEEDED
    stream.hold(True)  # has no effect


async def test_feedback_that_has_arrived_is_read_before_the_error_is_raised() -> None:
    stream = new_stream()
    stream.add_feedback(b"x")
    stream.fail(LOST)
    stream.add_feedback(b"y")
    stream.end(Outcome(GoalStatus.SUCCEEDED))
    assert facts_of(stream.take()) == [(1, b"x")]
    for wait in (stream.receive, stream.outcome):
        with pytest.raises(ConnectionLost, match="it is gone"):
            await wait()


@pytest.mark.parametrize("reads", [True, False])
def test_a_stream_that_is_closed_or_does_not_read_keeps_nothing(reads: bool) -> None:
    stream = new_stream(reads=reads)
    stream.add_feedback(b"x")
    stream.set_status(GoalStatus.EXECUTING)
    stream.close()
    stream.add_feedback(b"y")
    assert stream.take() == ()
    assert stream.status is GoalStatus.EXECUTING
    stream.end(Outcome(GoalStatus.SUCCEEDED))
    assert stream.take() == (Outcome(GoalStatus.SUCCEEDED),)
    assert stream.cursor == stream.dropped == 0
