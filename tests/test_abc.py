from __future__ import annotations

import inspect
from typing import Any

import anyio
import pytest

from fibaction import abc
from fibaction.abc import (
    Connection,
    Endpoint,
    FeedbackItem,
    GoalStream,
    StatusStream,
    Transport,
)
from fibaction.action import ActionInfo
from fibaction.exceptions import ConnectionLost, UnknownGoal
from fibaction.goals import UNKNOWN_OUTCOME, CancelAnswer, GoalID, Outcome
from fibaction.states import GoalStatus

KNOWN = GoalID(bytes(range(16)))
OTHER = GoalID(bytes(range(1, 17)))


class OneEnd(GoalStream):
    """A stream of a goal whose events are known, and whose end is too, or an error."""

    def __init__(
        self, end: Outcome[bytes] | Exception, *events: FeedbackItem | GoalStatus | None
    ) -> None:
        self.closed = 0
        self._end = end
        self._events = iter(events)

    @property
    def status(self) -> GoalStatus:
        return GoalStatus.SUCCEEDED

    @property
    def dropped(self) -> int:
        return 0

    async def next_event(self, *, feedback: bool = True) -> FeedbackItem | GoalStatus | None:
        assert feedback
        return next(self._events)

    async def outcome(self) -> Outcome[bytes]:
        if isinstance(self._end, Exception):
            raise self._end
        return self._end

    def hold(self, wanted: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.closed += 1


class OneGoal(Endpoint):
    """An endpoint that knows one goal, and can only be asked to follow it."""

    def __init__(self, stream: OneEnd) -> None:
        self.stream = stream

    @property
    def info(self) -> ActionInfo:
        return ActionInfo("one")

    async def send_goal(self, goal_id: GoalID, goal: bytes, *, feedback: bool = True) -> GoalStream:
        raise NotImplementedError

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False
    ) -> GoalStream:
        assert not own, "asking for a result slows nothing down"
        if goal_id != KNOWN:
            raise UnknownGoal(goal_id)
        return self.stream

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        raise NotImplementedError

    async def status(self) -> StatusStream:
        raise NotImplementedError

    async def wait_for_server(self) -> None:
        raise NotImplementedError


@pytest.mark.asyncio
async def test_a_result_is_the_outcome_of_the_followed_goal_and_the_stream_is_closed() -> None:
    outcome = Outcome(GoalStatus.SUCCEEDED, b"done")
    stream = OneEnd(outcome)
    with anyio.fail_after(5):
        assert await OneGoal(stream).get_result(KNOWN) is outcome
    assert stream.closed == 1


@pytest.mark.asyncio
async def test_the_result_of_an_unknown_goal_is_unknown() -> None:
    stream = OneEnd(Outcome(GoalStatus.SUCCEEDED))
    with anyio.fail_after(5):
        assert await OneGoal(stream).get_result(OTHER) is UNKNOWN_OUTCOME
    assert stream.closed == 0


@pytest.mark.asyncio
async def test_a_stream_is_closed_also_when_the_connection_ends_first() -> None:
    stream = OneEnd(ConnectionLost("gone"))
    with anyio.fail_after(5):
        with pytest.raises(ConnectionLost):
            await OneGoal(stream).get_result(KNOWN)
    assert stream.closed == 1


@pytest.mark.asyncio
async def test_whoever_reads_feedback_only_is_not_told_of_statuses() -> None:
    one, other = FeedbackItem(1, b"1"), FeedbackItem(2, b"2")
    stream = OneEnd(
        UNKNOWN_OUTCOME,
        *(GoalStatus.ACCEPTED, GoalStatus.EXECUTING, one, other, GoalStatus.CANCELING, None),
    )
    with anyio.fail_after(5):
        assert [await stream.receive() for _ in range(3)] == [one, other, None]


def test_a_stream_need_not_give_feedback_in_larger_pieces() -> None:
    assert OneEnd(UNKNOWN_OUTCOME, FeedbackItem(1, b"1")).ready(10) == []


def test_a_stream_is_closed_at_the_end_of_its_block_and_lets_errors_pass() -> None:
    stream = OneEnd(UNKNOWN_OUTCOME)
    with pytest.raises(LookupError), stream as entered:
        assert entered is stream
        assert stream.closed == 0
        raise LookupError
    assert stream.closed == 1


def test_feedback_has_a_number_and_a_payload() -> None:
    assert FeedbackItem(1, b"x") == (1, b"x")
    assert FeedbackItem(number=1, payload=b"x").payload == b"x"


@pytest.mark.parametrize(
    ("interface", "to_write"),
    [
        (GoalStream, {"status", "dropped", "next_event", "outcome", "hold", "close"}),
        (StatusStream, {"dropped", "receive", "close"}),
        (
            Endpoint,
            {"info", "send_goal", "feedback", "cancel_goals", "status", "wait_for_server"},
        ),
        (Connection, {"endpoint", "actions"}),
        (Transport, {"from_url", "serve", "connect"}),
    ],
)
def test_the_author_of_a_transport_writes_these_methods_and_no_others(
    interface: type[Any], to_write: set[str]
) -> None:
    assert interface.__abstractmethods__ == to_write
    with pytest.raises(TypeError, match="abstract"):
        interface()


def test_everything_that_the_author_of_a_transport_reads_has_a_docstring() -> None:
    interfaces = [
        value
        for name, value in vars(abc).items()
        if inspect.isclass(value) and value.__module__ == abc.__name__ and name[0] != "_"
    ]
    assert len(interfaces) == 6
    for interface in interfaces:
        assert inspect.getdoc(interface)
        for name, member in vars(interface).items():
            if name[0] != "_" and (callable(member) or isinstance(member, property)):
                assert inspect.getdoc(member), f"{interface.__name__}.{name}"
