"""Subscriptions: the credit of one client and the messages for it, without a connection."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

import anyio
import pytest

from fibaction._notify import Notifier
from fibaction.abc import Endpoint, FeedbackItem, GoalStream
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import GoalID, Outcome
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.errors import failed, failure_of, fitting, sendable
from fibaction.wire.framing import MAX_FRAME
from fibaction.wire.messages import (
    Ended,
    Failed,
    Feedback,
    Following,
    Rejected,
    StatusChanged,
    Why,
    decode_from_server,
    encode,
)
from fibaction.wire.subscriptions import (
    MOST_CREDIT,
    PIECE,
    GoalSubscription,
    RequestSubscription,
    Subscription,
)
from tests.fibonacci import FIBONACCI
from tests.wire.memory import Running, logged, settled

pytestmark = pytest.mark.anyio

ID = 7
STAMP = 1_700_000_000_000_000_000
GOAL_ID = GoalID(bytes(range(16)))
ANY = 10_000
"""More credit than any goal here uses up."""


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


# How much is wanted


def test_credit_adds_up_and_never_grows_out_of_a_number() -> None:
    subscription = Subscription(ID, 2)
    subscription.add(3)
    assert subscription.credit == 5
    for _ in range(3):
        subscription.add(MOST_CREDIT - 1)
        assert subscription.credit == MOST_CREDIT


def test_no_credit_at_all_means_that_only_the_end_is_wanted() -> None:
    assert (Subscription(ID, None).credit, Subscription(ID, None).closed) == (0, True)
    assert (Subscription(ID, 0).credit, Subscription(ID, 0).closed) == (0, False)
    subscription = Subscription(ID)
    assert not subscription.closed
    subscription.close()
    assert subscription.closed


async def test_who_waits_for_credit_goes_on_when_there_is_some() -> None:
    subscription = RequestSubscription(ID)
    async with Running(subscription.wait) as waiting:
        subscription.add(0)
        await settled()
        assert not waiting.is_done
        subscription.add(1)
        await waiting.answer()
    with anyio.fail_after(1):
        await subscription.wait()  # it is still there


async def test_who_waits_for_credit_goes_on_when_none_is_wanted_any_more() -> None:
    subscription = RequestSubscription(ID)
    async with Running(subscription.wait) as waiting:
        assert not waiting.is_done
        subscription.close()
        await waiting.answer()


def test_a_close_stops_what_is_being_done_be_it_before_or_after() -> None:
    stopped: list[str] = []
    early, late = RequestSubscription(ID), RequestSubscription(ID)
    early.stop_with(lambda: stopped.append("early"))
    assert stopped == []
    early.close()
    assert stopped == ["early"]
    late.close()
    late.stop_with(lambda: stopped.append("late"))
    assert stopped == ["early", "late"]


# A goal


class Stream(GoalStream):
    """A goal whose events are what a test says."""

    def __init__(self, *, latest: bool = False, place: int = 0) -> None:
        self.goal_id, self.stamp, self.latest, self.cursor = GOAL_ID, STAMP, latest, place
        self.news = Notifier()
        self.now = GoalStatus.ACCEPTED
        self.end: Outcome[bytes] | None = None
        self.error: Exception | None = None
        self.closed = 0
        self.limits: list[int] = []
        self._events: deque[GoalStatus | FeedbackItem] = deque()

    def put(self, *events: GoalStatus | tuple[int, bytes]) -> None:
        for event in events:
            self._events.append(event if isinstance(event, GoalStatus) else FeedbackItem(*event))
        self.news.notify()

    def finish(self, status: GoalStatus = GoalStatus.SUCCEEDED, reason: str = "") -> None:
        self.end, self.now = Outcome(status, b"result", reason), status
        self.news.notify()

    @property
    def status(self) -> GoalStatus:
        return self.now

    @property
    def dropped(self) -> int:
        raise AssertionError  # the numbers tell it

    def take(self, limit: int = 1) -> list[Any]:
        self.limits.append(limit)
        if self.error is not None:
            raise self.error
        if self.closed:
            return [] if self.end is None else [self.end]
        if self._events and isinstance(self._events[0], GoalStatus):
            return [self._events.popleft()]
        items: list[FeedbackItem] = []
        while len(items) < limit and self._events and isinstance(self._events[0], FeedbackItem):
            item = self._events.popleft()
            assert isinstance(item, FeedbackItem)
            items.append(item)
            self.cursor = item.number
        return [self.end] if not items and not self._events and self.end is not None else items

    def known_outcome(self) -> Outcome[bytes] | None:
        return self.end

    def hold(self, wanted: bool) -> None:
        raise AssertionError  # the credit says it

    def close(self) -> None:
        self.closed += 1
        self.news.notify()

    def fail(self, error: ActionError) -> None:
        raise NotImplementedError


ENDPOINT: Endpoint = ScriptedServer(FIBONACCI, [anyio.Event()])


class Bench:
    """A flow, and how often it said that there is something."""

    def __init__(
        self, credit: int | None = ANY, *, begun: bool = True, max_frame: int = MAX_FRAME
    ) -> None:
        self.said = 0
        self.stream = Stream()
        self.subscription = GoalSubscription(ID, credit, self._ready, max_frame)
        if begun:
            self.begin()
            self.take()
            self.said = 0

    def _ready(self, subscription: GoalSubscription) -> None:
        assert subscription is self.subscription
        self.said += 1

    def begin(self, *, own: bool = True) -> None:
        self.subscription.begin(ENDPOINT, self.stream, own=own)

    def take(self) -> list[Any]:
        return [decode_from_server(frame) for frame in self.subscription.take()]

    def feed(self, *numbers: int) -> None:
        self.stream.put(*((number, b"%d" % number) for number in numbers))


def feedback(*numbers: int) -> list[Feedback]:
    return [Feedback(ID, number, b"%d" % number) for number in numbers]


def test_before_it_begins_there_is_nothing_to_tell_and_nobody_is_told_so() -> None:
    bench = Bench(begun=False)
    bench.subscription.add(3)
    bench.subscription.close()
    bench.subscription.leave()
    assert bench.said == 0
    assert not bench.subscription.has_end_to_tell
    assert not bench.subscription.is_observed
    assert bench.subscription.credit == ANY + 3


@pytest.mark.parametrize("own", [True, False])
def test_it_begins_with_what_the_goal_is_at_that_time(own: bool) -> None:
    bench = Bench(begun=False)
    bench.stream = Stream(latest=True, place=5)
    bench.begin(own=own)
    assert bench.said == 1
    assert bench.subscription.is_observed != own
    bench.stream.put(GoalStatus.EXECUTING)
    bench.stream.now = GoalStatus.EXECUTING
    # The status that it has by now comes behind, as a change.
    assert bench.take() == [Following(ID, STAMP, GoalStatus.ACCEPTED, True, 5)]
    assert bench.take() == [StatusChanged(ID, GoalStatus.EXECUTING)]
    assert (bench.subscription.own, bench.subscription.endpoint, bench.subscription.stream) == (
        own,
        ENDPOINT,
        bench.stream,
    )


def test_it_says_so_whenever_there_is_something_new() -> None:
    bench = Bench()
    steps = [
        lambda: bench.feed(1),
        lambda: bench.stream.put(GoalStatus.CANCELING),
        lambda: bench.subscription.add(1),
        bench.subscription.close,
        bench.stream.finish,
    ]
    for step in steps:
        before = bench.said
        step()
        assert bench.said > before
        bench.take()  # it says so once, until somebody has looked


def test_after_it_was_left_it_says_nothing_and_the_stream_is_free() -> None:
    bench = Bench()
    bench.subscription.leave()
    assert bench.stream.news.on_next is None
    assert bench.subscription.told
    bench.feed(1)
    bench.subscription.add(1)
    bench.subscription.close()
    assert bench.said == 0


def test_feedback_is_told_as_far_as_there_is_credit() -> None:
    bench = Bench(credit=2)
    assert bench.take() == []
    bench.feed(1, 2, 3)
    assert bench.take() == feedback(1, 2)
    assert bench.subscription.credit == 0
    assert bench.take() == []
    bench.subscription.add(5)
    assert bench.take() == feedback(3)
    assert bench.subscription.credit == 4


def test_no_more_than_a_piece_is_told_at_once_however_much_is_wanted() -> None:
    bench = Bench()
    bench.feed(*range(1, 2 * PIECE + 2))
    assert [len(bench.take()) for _ in range(4)] == [PIECE, PIECE, 1, 0]
    assert bench.stream.limits == [PIECE] * 4


def test_a_status_is_told_without_credit() -> None:
    bench = Bench(credit=0)
    bench.stream.put(GoalStatus.CANCELING)
    assert bench.take() == [StatusChanged(ID, GoalStatus.CANCELING)]
    assert bench.subscription.credit == 0


def test_the_end_waits_for_credit_while_feedback_is_left() -> None:
    bench = Bench(credit=1)
    bench.feed(1, 2)
    bench.stream.finish()
    assert bench.take() == feedback(1)
    assert bench.take() == []
    assert bench.subscription.has_end_to_tell
    bench.subscription.add(1)
    assert bench.take() == feedback(2)
    assert bench.take() == [Ended(ID, GoalStatus.SUCCEEDED, b"result", "", 2)]
    assert bench.subscription.told
    assert not bench.subscription.has_end_to_tell


def test_a_client_that_wants_no_more_is_told_nothing_until_the_end() -> None:
    bench = Bench()
    bench.feed(1)
    bench.subscription.close()
    assert bench.stream.closed == 1
    assert bench.take() == []
    assert not bench.subscription.told
    bench.stream.finish(GoalStatus.ABORTED, "no arm")
    assert bench.take() == [Ended(ID, GoalStatus.ABORTED, b"result", "no arm", 0)]


@pytest.mark.parametrize("closes_by", ["credit", "close"])
def test_a_client_that_wanted_no_more_before_it_began_is_told_the_end(closes_by: str) -> None:
    bench = Bench(None if closes_by == "credit" else ANY, begun=False)
    if closes_by == "close":
        bench.subscription.close()
    bench.begin()
    assert bench.stream.closed == 1
    bench.feed(1)
    bench.stream.finish()
    assert [type(message) for _ in range(2) for message in bench.take()] == [Following, Ended]


def test_a_reason_that_is_no_unicode_is_told_as_far_as_it_is() -> None:
    bench = Bench()
    bench.stream.finish(GoalStatus.ABORTED, "no file \udcff")
    (ended,) = bench.take()
    assert ended.reason == "no file ?"


# What is larger than the client takes


def test_feedback_over_the_limit_is_left_out_and_costs_no_credit() -> None:
    bench = Bench(credit=10, max_frame=50)
    bench.stream.put((1, b"1"), (2, bytes(50)), (3, b"3"))
    with logged() as lines:
        assert bench.take() == feedback(1, 3)
    assert bench.subscription.credit == 8
    assert [(line.levelno, line.getMessage()) for line in lines] == [
        (
            logging.WARNING,
            "feedback of a goal is left out: its client takes messages of 50 bytes at most",
        )
    ]
    bench.stream.finish()
    assert bench.take() == [Ended(ID, GoalStatus.SUCCEEDED, b"result", "", 3)]


def test_behind_feedback_that_was_all_left_out_there_may_be_more() -> None:
    bench = Bench(credit=1, max_frame=50)
    bench.stream.put((1, bytes(50)), (2, b"2"))
    bench.said = 0
    assert bench.take() == []  # which alone would mean that there is nothing
    assert bench.said == 1
    assert bench.take() == feedback(2)


def test_feedback_of_the_very_limit_is_told() -> None:
    size = len(encode(Feedback(ID, 1, bytes(40))))
    bench = Bench(max_frame=size)
    bench.stream.put((1, bytes(40)), (2, bytes(41)))
    assert bench.take() == [Feedback(ID, 1, bytes(40))]


def test_a_result_over_the_limit_is_a_failure_of_that_goal() -> None:
    bench = Bench(max_frame=50)
    bench.stream.finish(GoalStatus.ABORTED, "x" * 100)
    size = len(encode(Ended(ID, GoalStatus.ABORTED, b"result", "x" * 100, 0)))
    text = f"the answer has {size} bytes, and 50 are the limit"
    with logged() as lines:
        assert bench.take() == [Failed(ID, Why.LIMIT, text)]
    assert [line.getMessage() for line in lines] == [f"an answer is not sent: {text}"]
    assert bench.subscription.told


def test_a_goal_whose_result_is_over_the_limit_is_kept_for_nobody() -> None:
    bench = Bench(max_frame=50)
    bench.stream.finish(GoalStatus.ABORTED, "x" * 100)
    (failed,) = bench.take()
    assert isinstance(failed, Failed)
    assert not bench.subscription.own


def test_what_fits_is_sent_as_it_is() -> None:
    frame = bytes(50)
    assert fitting(ID, frame, 50) is frame
    assert decode_from_server(fitting(ID, frame, 49)) == Failed(
        ID, Why.LIMIT, "the answer has 50 bytes, and 49 are the limit"
    )


# What goes wrong


@pytest.mark.parametrize(
    ("error", "why", "text"),
    [
        (ConnectionLost("the robot is away"), Why.CONNECTION_LOST, "the robot is away"),
        (ServerNotFound("nobody"), Why.SERVER_NOT_FOUND, "nobody"),
    ],
)
def test_an_error_of_the_way_behind_is_told_and_the_goal_kept_for_nobody(
    error: ActionError, why: int, text: str
) -> None:
    bench = Bench()
    bench.stream.error = error
    with logged() as lines:
        assert bench.take() == [Failed(ID, why, text)]
    assert lines == []
    assert (bench.subscription.told, bench.subscription.own) == (True, False)
    assert bench.stream.news.on_next is None


def test_a_stream_that_raises_what_it_may_not_is_logged_and_told_in_general() -> None:
    bench = Bench()
    bench.stream.error = ValueError("a secret of the server's")
    with logged() as lines:
        assert bench.take() == [Failed(ID, Why.SERVER_FAILED, "the server failed: ValueError")]
    (line,) = lines
    assert (line.levelno, line.getMessage()) == (logging.ERROR, "the stream of a goal failed")
    assert line.exc_info is not None
    assert (bench.subscription.told, bench.subscription.own) == (True, False)


@pytest.mark.parametrize(
    ("error", "answer"),
    [
        (GoalRejected("no \udcff arm"), Rejected(ID, "no ? arm")),
        (UnknownGoal(GOAL_ID), Failed(ID, Why.UNKNOWN_GOAL, str(UnknownGoal(GOAL_ID)))),
        (AuthenticationFailed("no"), Failed(ID, Why.FORBIDDEN, "no")),
        (ServerNotFound("nobody \udcff"), Failed(ID, Why.SERVER_NOT_FOUND, "nobody ?")),
        (ConnectionLost("away"), Failed(ID, Why.CONNECTION_LOST, "away")),
        (ProtocolError("nonsense"), Failed(ID, Why.PROTOCOL, "nonsense")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_each_refusal_has_its_answer(error: ActionError, answer: Rejected | Failed) -> None:
    assert decode_from_server(failed(ID, error, MAX_FRAME)) == answer


@pytest.mark.parametrize("error", [GoalRejected("größer" * 100), ServerNotFound("größer" * 100)])
@pytest.mark.parametrize("limit", [30, 31, 32, 33, 100, 500])
def test_a_refusal_is_cut_to_what_the_client_takes_between_two_letters(
    error: ActionError, limit: int
) -> None:
    frame = failed(ID, error, limit)
    assert limit - 6 <= len(frame) <= limit
    answer = decode_from_server(frame)
    assert isinstance(answer, Rejected | Failed)
    text = answer.reason if isinstance(answer, Rejected) else answer.text
    assert text
    assert ("größer" * 100).startswith(text)


def test_a_refusal_of_which_nothing_fits_says_nothing() -> None:
    assert decode_from_server(failed(ID, GoalRejected("no arm"), 1)) == Rejected(ID, "")


def test_a_refusal_of_the_very_limit_is_whole() -> None:
    whole = encode(Rejected(ID, "no arm"))
    assert failed(ID, GoalRejected("no arm"), len(whole)) == whole
    assert failed(ID, GoalRejected("no arm"), len(whole) - 1) == encode(Rejected(ID, "no ar"))


def test_an_error_that_is_nobodys_business_is_told_by_its_kind_only() -> None:
    told = failure_of(KeyError("secret"))
    assert isinstance(told, ServerFailed)
    assert str(told) == "the server failed: KeyError"


def test_text_that_can_be_sent_is_sent_as_it_is() -> None:
    assert sendable("größer als 🤖") == "größer als 🤖"
