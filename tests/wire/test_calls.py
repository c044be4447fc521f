from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
from functools import partial
from typing import Any, TypeVar, cast

import anyio
import pytest
from hypothesis import given, strategies

from fibaction.abc import FeedbackItem, GoalUpdate
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import UNKNOWN_OUTCOME, GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus
from fibaction.wire.calls import Call, PendingRequest
from fibaction.wire.errors import error_of
from fibaction.wire.messages import (
    Actions,
    AwaitServer,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    FromClient,
    GoalChanged,
    Ping,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Why,
)
from fibaction.wire.remote_goal import RemoteGoal
from fibaction.wire.remote_statuses import RemoteStatuses

pytestmark = pytest.mark.anyio

T = TypeVar("T")

ID = 7
STAMP = 1_700_000_000_000_000_000
GOAL_ID = GoalID(bytes(range(16)))
LOST = ConnectionLost("the line is cut")
ENDED = Ended(ID, GoalStatus.SUCCEEDED, b"result", "", 0)


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


def at_once(coroutine: Coroutine[Any, Any, T]) -> T:
    """What it gives, without ever waiting."""
    try:
        coroutine.send(None)
    except StopIteration as stop:
        result: T = stop.value
        return result
    coroutine.close()
    raise AssertionError("it waits")


async def while_waiting(
    waiting: Callable[[], Coroutine[Any, Any, T]], *then: Callable[[], object]
) -> T | ActionError:
    """Start something, do this and that as long as it waits, and give what comes of it at last."""
    results: list[T | ActionError] = []

    async def wait() -> None:
        try:
            results.append(await waiting())
        except ActionError as exc:
            results.append(exc)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            for step in then:
                await anyio.wait_all_tasks_blocked()
                assert not results
                step()
    (result,) = results
    return result


def credits_in(posted: Iterable[FromClient]) -> list[int]:
    """How much each `Credit` gives; there is nothing else."""
    counts = []
    for message in posted:
        assert isinstance(message, Credit)
        assert message.id == ID
        counts.append(message.count)
    return counts


# Any call


def some_calls() -> list[tuple[Call, Callable[[], Coroutine[Any, Any, Any]]]]:
    """A call of each kind that waits for something, and what it waits for."""
    question = PendingRequest(ID, AwaitServer(ID, "fibonacci"))
    unanswered, accepted, silent = (Bench(accepted=yes).goal for yes in (False, True, True))
    begun, begins = StatusBench().statuses, StatusBench(begun=False).statuses
    return [
        (question, question.answered),
        (unanswered, unanswered.answered),
        (accepted, accepted.receive),
        (silent, silent.outcome),
        (begun, begun.receive),
        (begins, begins.answered),
    ]


@pytest.mark.parametrize("number", range(6))
async def test_whoever_waits_is_told_of_a_failure(number: int) -> None:
    call, waiting = some_calls()[number]
    error = await while_waiting(waiting, lambda: call.fail(LOST))
    assert isinstance(error, ConnectionLost)
    assert str(error) == str(LOST)


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize(
    "error",
    [
        LOST,
        ServerNotFound("nobody"),
        AuthenticationFailed("no"),
        ProtocolError("nonsense"),
        GoalRejected("too large", goal_id=GOAL_ID),
        UnknownGoal(GOAL_ID),
    ],
    ids=lambda error: type(error).__name__,
)
def test_each_who_asks_gets_an_error_of_his_own(number: int, error: ActionError) -> None:
    call, waiting = some_calls()[number]
    call.fail(error)
    raised: list[ActionError] = []
    for _ in range(2):
        with pytest.raises(ActionError) as caught:
            at_once(waiting())
        raised.append(caught.value)
    for one in raised:
        assert type(one) is type(error)
        assert str(one) == str(error)
        assert getattr(one, "goal_id", None) == getattr(error, "goal_id", None)
        assert getattr(one, "reason", None) == getattr(error, "reason", None)
    assert len({id(error), *map(id, raised)}) == 3


def test_a_call_that_has_not_failed_raises_nothing() -> None:
    for call, _ in some_calls():
        call.raise_error()
        assert call.id == ID


def test_what_is_given_up_is_closed_and_who_only_looked_on_wants_no_end_either() -> None:
    for call, _ in some_calls():
        assert call.giving_up() == Close(ID)
    for own, message in ((True, Close(ID)), (False, Received(ID))):
        goal = Bench(opening=Follow(ID, "fibonacci", GOAL_ID, None, own, 4), accepted=False).goal
        assert goal.giving_up() == message


# What a refusal says


@pytest.mark.parametrize(
    ("why", "kind"),
    [
        (Why.UNKNOWN_GOAL, ServerFailed),  # about no goal
        (Why.SERVER_NOT_FOUND, ServerNotFound),
        (Why.CONNECTION_LOST, ConnectionLost),
        (Why.FORBIDDEN, AuthenticationFailed),
        (Why.LIMIT, LimitReached),
        (Why.PROTOCOL, ProtocolError),
        (0, ConnectionLost),
        (99, ConnectionLost),
    ],
)
def test_a_failed_request_is_the_error_that_its_number_says(
    why: int, kind: type[ActionError]
) -> None:
    error = error_of(Failed(ID, why, "for a reason"))
    assert type(error) is kind
    assert str(error) == "for a reason"


@pytest.mark.parametrize(
    ("why", "kind"),
    [
        (Why.SERVER_NOT_FOUND, ServerNotFound),
        (Why.CONNECTION_LOST, ConnectionLost),
        (Why.FORBIDDEN, AuthenticationFailed),
        (Why.PROTOCOL, ProtocolError),
    ],
)
def test_what_is_wrong_is_the_same_for_a_goal(why: int, kind: type[ActionError]) -> None:
    error = error_of(Failed(ID, why, "for a reason"), GOAL_ID)
    assert type(error) is kind
    assert str(error) == "for a reason"


def test_a_goal_that_is_unknown_is_named() -> None:
    error = error_of(Failed(ID, Why.UNKNOWN_GOAL, "whatever"), GOAL_ID)
    assert isinstance(error, UnknownGoal)
    assert error.goal_id == GOAL_ID


def test_a_goal_that_is_rejected_is_named_with_the_reason() -> None:
    error = error_of(Rejected(ID, "too large"), GOAL_ID)
    assert isinstance(error, GoalRejected)
    assert (error.reason, error.goal_id) == ("too large", GOAL_ID)


# A question


def a_question() -> PendingRequest:
    return PendingRequest(ID, AwaitServer(ID, "fibonacci"))


def test_a_question_is_asked_alike_on_each_connection() -> None:
    question = a_question()
    assert question.opening() is question.opening()
    assert question.opening() == AwaitServer(ID, "fibonacci")


async def test_a_question_waits_for_its_answer_which_is_the_last_of_it() -> None:
    question = a_question()
    await while_waiting(question.answered, lambda: question.on_message(Actions(ID, [])))
    assert question.answer(Actions) == Actions(ID, [])
    assert a_question().on_message(Actions(ID, []))


async def test_a_question_that_fails_has_had_its_answer() -> None:
    question = a_question()
    error = await while_waiting(
        question.answered,
        lambda: question.on_message(Failed(ID, Why.SERVER_NOT_FOUND, "nobody")),
    )
    assert isinstance(error, ServerNotFound)
    assert a_question().on_message(Failed(ID, Why.SERVER_NOT_FOUND, "nobody"))


@pytest.mark.parametrize(
    "answer", [Done(ID), Rejected(ID, "no"), Following(ID, 1, GoalStatus.ACCEPTED, False, 0)]
)
def test_an_answer_to_another_question_is_the_peers_error(answer: Any) -> None:
    question = a_question()
    assert question.on_message(answer)
    name = type(answer).__name__
    with pytest.raises(ProtocolError, match=rf"^a {name} does not answer what was asked$"):
        question.answer(Actions)


# A goal


async def next_update(goal: RemoteGoal) -> GoalUpdate:
    return await anext(aiter(goal))


class Bench:
    """A goal at the other end, and what it posts."""

    def __init__(
        self,
        window: int = 4,
        *,
        accepted: bool = True,
        latest: bool = False,
        place: int = 0,
        opening: SendGoal | Follow | None = None,
    ) -> None:
        self.posted: list[FromClient] = []
        if opening is None:
            opening = SendGoal(ID, "fibonacci", GOAL_ID, b"goal", window or None)
        self.goal = RemoteGoal(GOAL_ID, opening, window, self.posted.append)
        if accepted:
            self.follow(latest=latest, place=place)

    def follow(
        self, status: GoalStatus = GoalStatus.ACCEPTED, *, latest: bool = False, place: int = 0
    ) -> None:
        assert not self.goal.on_message(Following(ID, STAMP, status, latest, place))

    def feed(self, *numbers: int) -> None:
        for number in numbers:
            assert not self.goal.on_message(Feedback(ID, number, b"%d" % number))

    def end(self, place: int = 0, status: GoalStatus = GoalStatus.SUCCEEDED) -> None:
        assert self.goal.on_message(Ended(ID, status, b"result", "as it was", place))

    def next(self) -> FeedbackItem | GoalStatus | None:
        update = at_once(next_update(self.goal))
        return None if isinstance(update, Outcome) else update

    def read(self, count: int) -> list[int]:
        """The numbers of so much feedback, which is there, perhaps behind a status."""
        numbers = []
        for _ in range(count):
            event = self.next()
            if isinstance(event, GoalStatus):
                event = self.next()
            assert isinstance(event, FeedbackItem)
            assert event.payload == b"%d" % event.number
            numbers.append(event.number)
        return numbers

    def check_that_all_is_read(self) -> None:
        """Only a failure comes after what was there."""
        self.goal.fail(LOST)
        with pytest.raises(ConnectionLost):
            self.next()

    def reopened(self) -> Follow:
        """What is sent on another connection."""
        opening = self.goal.opening()
        assert isinstance(opening, Follow)
        return opening


def test_a_goal_is_sent_as_it_was_given_until_it_is_accepted() -> None:
    bench = Bench(accepted=False)
    sent = SendGoal(ID, "fibonacci", GOAL_ID, b"goal", 4)
    assert bench.goal.opening() == sent
    assert bench.goal.opening() == sent
    bench.follow()
    assert isinstance(bench.goal.opening(), Follow)


async def test_a_goal_is_accepted_when_the_server_knows_it() -> None:
    bench = Bench(accepted=False)
    goal = bench.goal
    assert (goal.goal_id, goal.status, goal.stamp, goal.cursor) == (
        GOAL_ID,
        GoalStatus.UNKNOWN,
        0,
        0,
    )
    assert isinstance(goal.goal_id, GoalID)
    await while_waiting(
        goal.answered, lambda: bench.follow(GoalStatus.EXECUTING, latest=True, place=3)
    )
    assert (goal.status, goal.stamp, goal.latest) == (GoalStatus.EXECUTING, STAMP, True)
    assert isinstance(goal.status, GoalStatus)
    assert (goal.cursor, goal.dropped) == (3, 0)


@pytest.mark.parametrize(
    ("refusal", "kind"),
    [
        (Rejected(ID, "too large"), GoalRejected),
        (Failed(ID, Why.UNKNOWN_GOAL, ""), UnknownGoal),
        (Failed(ID, Why.LIMIT, "too many"), LimitReached),
        (Failed(ID, Why.SERVER_NOT_FOUND, "nobody"), ServerNotFound),
    ],
)
async def test_a_goal_that_is_refused_was_not_accepted(
    refusal: Rejected | Failed, kind: type[ActionError]
) -> None:
    bench = Bench(accepted=False)
    error = await while_waiting(bench.goal.answered, lambda: bench.goal.on_message(refusal))
    assert type(error) is kind
    assert Bench(accepted=False).goal.on_message(refusal)


async def test_feedback_and_statuses_are_waited_for_and_come_in_order() -> None:
    bench = Bench()
    next_event = partial(next_update, bench.goal)
    assert await while_waiting(next_event, lambda: bench.feed(1)) == FeedbackItem(1, b"1")
    status = await while_waiting(
        next_event, lambda: bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING))
    )
    assert status is GoalStatus.EXECUTING
    assert bench.goal.status is GoalStatus.EXECUTING
    bench.feed(2, 3)
    assert bench.read(2) == [2, 3]
    assert bench.goal.cursor == 3
    assert await while_waiting(next_event, lambda: bench.end(3)) == bench.goal.known_outcome()


def test_where_no_feedback_is_taken_only_statuses_are_given_and_feedback_is_left() -> None:
    bench = Bench()
    bench.feed(1)
    assert not bench.goal.take(0)
    bench.feed(2)
    bench.goal.on_message(StatusChanged(ID, GoalStatus.CANCELING))
    assert bench.goal.take(0) == (GoalStatus.CANCELING,)
    bench.end(2)
    assert not bench.goal.take(0)  # there is more, for who wants it
    assert (bench.goal.cursor, bench.goal.dropped) == (0, 0)
    assert bench.read(2) == [1, 2]
    assert bench.goal.take(0) == (bench.goal.known_outcome(),)
    assert bench.next() is None


def test_as_much_feedback_is_taken_as_is_asked_for_and_there_is() -> None:
    bench = Bench()
    assert not bench.goal.take(5)
    bench.feed(1, 2, 3)
    assert bench.goal.take(2) == [FeedbackItem(1, b"1"), FeedbackItem(2, b"2")]
    assert bench.goal.cursor == 2
    assert bench.goal.take(5) == [FeedbackItem(3, b"3")]
    assert credits_in(bench.posted) == [2]


def test_what_has_come_before_the_end_is_kept_also_if_nobody_is_to_wait_for_it() -> None:
    bench = Bench(4)
    bench.feed(1, 2, 3, 4)
    bench.end()
    before = list(bench.posted)
    bench.goal.hold(False)
    items = bench.goal.take(9)
    assert isinstance(items, list)
    assert [item.number for item in items] == [1, 2, 3, 4]
    assert bench.goal.dropped == 0
    assert bench.posted == before


def test_the_end_is_known_without_waiting_as_soon_as_it_has_come() -> None:
    bench = Bench()
    assert bench.goal.known_outcome() is None
    bench.end()
    bench.goal.fail(LOST)  # whatever becomes of the connection after that
    assert bench.goal.known_outcome() == Outcome(GoalStatus.SUCCEEDED, b"result", "as it was")


def test_another_goal_of_the_same_id_is_not_taken_for_the_one_that_was_followed() -> None:
    bench = Bench()
    bench.feed(1, 2)
    assert bench.goal.on_message(Following(ID, STAMP + 1, GoalStatus.EXECUTING, False, 0))
    assert bench.goal.known_outcome() == UNKNOWN_OUTCOME
    assert Close(ID) in bench.posted
    items = [FeedbackItem(1, b"1"), FeedbackItem(2, b"2")]
    assert bench.goal.take(5) == items  # what has come, has come


def test_a_failure_before_the_end_is_known_without_waiting() -> None:
    bench = Bench()
    bench.goal.fail(LOST)
    with pytest.raises(ConnectionLost):
        bench.goal.known_outcome()


def test_everything_that_comes_is_heard_of() -> None:
    bench = Bench(accepted=False)
    heard: list[str] = []
    steps: dict[str, Callable[[], object]] = {
        "accepted": bench.follow,
        "feedback": lambda: bench.feed(1),
        "status": lambda: bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING)),
        "end": bench.end,
    }
    for name, step in steps.items():
        bench.goal.news.on_next = lambda name=name: heard.append(name)
        step()
    assert heard == list(steps)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("window", [0, 4])
def test_the_end_is_answered_with_received_whether_or_not_feedback_is_wanted(
    closed: bool, window: int
) -> None:
    bench = Bench(window)
    if closed:
        bench.goal.close()
    before = list(bench.posted)
    bench.end()
    assert bench.posted == [*before, Received(ID)]


@pytest.mark.parametrize(
    "message", [Failed(ID, Why.UNKNOWN_GOAL, ""), Failed(ID, Why.LIMIT, "the answer is too large")]
)
def test_what_is_no_end_is_not_answered(message: Failed) -> None:
    bench = Bench()
    assert bench.goal.on_message(message)
    assert bench.posted == []


def test_a_result_over_the_limit_is_an_error_of_this_goal_after_its_feedback() -> None:
    bench = Bench()
    bench.feed(1)
    bench.goal.on_message(
        Failed(ID, Why.LIMIT, "the answer has 2000 bytes, and 1000 are the limit")
    )
    assert bench.read(1) == [1]
    for _ in range(2):
        with pytest.raises(LimitReached, match="2000 bytes") as caught:
            at_once(bench.goal.outcome())
        assert type(caught.value) is LimitReached


def test_the_stream_of_feedback_leaves_statuses_out() -> None:
    bench = Bench()
    bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING))
    bench.feed(1)
    assert at_once(bench.goal.receive()) == FeedbackItem(1, b"1")


async def test_the_outcome_is_waited_for_and_stays() -> None:
    bench = Bench()
    outcome = await while_waiting(bench.goal.outcome, lambda: bench.end(status=GoalStatus.ABORTED))
    assert outcome == Outcome(GoalStatus.ABORTED, b"result", "as it was")
    assert bench.goal.status is GoalStatus.ABORTED
    assert at_once(bench.goal.outcome()) is outcome


def test_all_feedback_comes_before_the_end() -> None:
    bench = Bench()
    bench.feed(1, 2)
    bench.end(2)
    assert bench.read(2) == [1, 2]
    assert bench.next() is None
    assert bench.next() is None


def test_what_has_come_can_be_read_before_a_failure_is_heard_of() -> None:
    bench = Bench()
    bench.feed(1)
    bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING))
    bench.goal.fail(LOST)
    assert bench.next() is GoalStatus.EXECUTING
    assert bench.read(1) == [1]
    with pytest.raises(ConnectionLost):
        bench.next()


@pytest.mark.parametrize("message", [Done(ID), Finished(ID), Ping()], ids=type)
def test_what_is_about_no_goal_is_the_peers_error(message: object) -> None:
    with pytest.raises(ProtocolError, match=f"a {type(message).__name__} does not answer"):
        Bench().goal.on_message(message)


def test_a_goal_that_the_server_has_forgotten_has_ended_as_unknown() -> None:
    bench = Bench()
    bench.feed(1, 2)
    assert bench.goal.on_message(Failed(ID, Why.UNKNOWN_GOAL, "never heard of it"))
    assert at_once(bench.goal.outcome()) is UNKNOWN_OUTCOME
    assert bench.goal.status is GoalStatus.UNKNOWN
    assert bench.read(2) == [1, 2]
    assert bench.next() is None
    assert bench.goal.dropped == 0


def test_a_goal_that_was_accepted_can_still_fail_for_other_reasons() -> None:
    bench = Bench()
    assert bench.goal.on_message(Failed(ID, Why.SERVER_NOT_FOUND, "nobody"))
    with pytest.raises(ServerNotFound):
        at_once(bench.goal.outcome())


def test_an_end_before_the_acceptance_is_the_peers_error() -> None:
    bench = Bench(accepted=False)
    with pytest.raises(ProtocolError):
        bench.goal.on_message(ENDED)


@pytest.mark.parametrize("status", [one for one in GoalStatus if one.is_active])
def test_an_end_that_is_none_is_the_peers_error(status: GoalStatus) -> None:
    bench = Bench()
    with pytest.raises(ProtocolError, match=f"^a goal has ended as {status.name}$"):
        bench.goal.on_message(Ended(ID, status, None, "", 0))
    assert bench.goal.known_outcome() is None


# Feedback and credit


@pytest.mark.parametrize("number", [0, 1, 2])
def test_feedback_out_of_order_is_the_peers_error(number: int) -> None:
    bench = Bench()
    bench.feed(1, 2)
    with pytest.raises(ProtocolError, match=rf"^feedback {number} came after 2$"):
        bench.feed(number)


def test_feedback_from_before_the_place_is_the_peers_error() -> None:
    bench = Bench(place=5)
    with pytest.raises(ProtocolError, match="feedback 5 came after 5"):
        bench.feed(5)


@pytest.mark.parametrize("window", [1, 2, 5])
def test_feedback_beyond_the_credit_is_the_peers_error(window: int) -> None:
    bench = Bench(window)
    bench.feed(*range(1, window + 1))
    with pytest.raises(ProtocolError, match=r"^there were more messages than credit for them$"):
        bench.feed(window + 1, window + 2)  # one too many may be from a connection before


@pytest.mark.parametrize(
    ("window", "batch"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (8, 4), (64, 32)]
)
def test_credit_is_given_in_batches_of_half_a_window(window: int, batch: int) -> None:
    bench = Bench(window)
    bench.feed(*range(1, window + 1))
    for count in range(1, window + 1):
        bench.read(1)
        assert credits_in(bench.posted) == [batch] * (count // batch)


def test_no_credit_is_given_after_the_end() -> None:
    bench = Bench()
    bench.feed(1, 2, 3, 4)
    bench.end(4)
    assert bench.read(4) == [1, 2, 3, 4]
    assert bench.posted == [Received(ID)]


@pytest.mark.parametrize(
    ("own", "ended", "said"),
    [
        (False, False, [Received(ID)]),
        (False, True, []),
        (True, False, []),
        (True, True, []),
    ],
)
def test_only_who_looks_on_and_goes_before_the_end_says_so(
    own: bool, ended: bool, said: list[FromClient]
) -> None:
    bench = Bench(opening=Follow(ID, "fibonacci", GOAL_ID, None, own, 4))
    assert bench.goal.is_own == own
    if ended:
        bench.end()
    bench.posted.clear()
    del bench.goal
    assert bench.posted == said


@pytest.mark.parametrize("is_refused", [False, True])
def test_who_was_not_let_look_on_says_nothing_when_it_goes(is_refused: bool) -> None:
    bench = Bench(opening=Follow(ID, "fibonacci", GOAL_ID, None, False, 4), accepted=False)
    if is_refused:
        bench.goal.on_message(Failed(ID, Why.UNKNOWN_GOAL, "unknown"))
    del bench.goal
    assert bench.posted == []


def test_who_has_lost_what_it_looks_on_says_nothing_when_it_goes() -> None:
    bench = Bench(opening=Follow(ID, "fibonacci", GOAL_ID, None, False, 4))
    bench.goal.fail(LOST)
    del bench.goal
    assert bench.posted == []


class Peer:
    """A server that keeps to the credit it has."""

    def __init__(self, bench: Bench, window: int) -> None:
        self._bench = bench
        self.credit = window
        self.last = 0
        self._heard = 0

    def listen(self) -> None:
        new = self._bench.posted[self._heard :]
        self._heard += len(new)
        self.credit += sum(credits_in(new))

    def say(self) -> None:
        self.listen()
        if self.credit:
            self.credit -= 1
            self.last += 1
            self._bench.feed(self.last)

    def reconnect(self) -> None:
        self.listen()
        opening = self._bench.reopened()
        assert opening == Follow(ID, "fibonacci", GOAL_ID, self.last, True, opening.credit)
        assert opening.credit is not None
        self.credit = opening.credit
        self._bench.follow(GoalStatus.EXECUTING, place=self.last)


@given(
    strategies.integers(1, 9),
    strategies.lists(strategies.sampled_from(["say", "read", "read all", "reconnect"])),
)
def test_a_peer_that_keeps_to_its_credit_is_never_wrong_and_never_stuck(
    window: int, steps: list[str]
) -> None:
    bench = Bench(window)
    peer = Peer(bench, window)
    seen: list[int] = []
    for step in steps:
        unread = peer.last - len(seen)
        if step == "say":
            peer.say()
        elif step == "read" and unread:
            seen += bench.read(1)
        elif step == "read all":
            seen += bench.read(unread)
        elif step == "reconnect" and unread < window:
            peer.reconnect()
        peer.listen()
        unread = peer.last - len(seen)
        assert peer.credit + unread <= window
        assert peer.credit or unread
    assert seen == list(range(1, len(seen) + 1))
    assert bench.goal.dropped == 0


# A slow reader


def test_the_latest_keeps_only_the_newest() -> None:
    bench = Bench(latest=True)
    bench.feed(1, 2, 3)
    assert credits_in(bench.posted) == [2]
    assert bench.read(1) == [3]
    assert bench.goal.dropped == 2
    bench.check_that_all_is_read()


@pytest.mark.parametrize("window", [2, 3, 4, 64])
def test_a_reader_of_the_latest_never_keeps_the_server_waiting(window: int) -> None:
    bench = Bench(window, latest=True)
    peer = Peer(bench, window)
    for number in range(1, 200):
        peer.say()
        assert peer.last == number
    assert bench.read(1) == [199]
    assert bench.goal.dropped == 198


def test_who_does_not_hold_loses_the_oldest_and_grants_the_room() -> None:
    bench = Bench(window=6)
    bench.feed(1, 2, 3, 4, 5, 6)
    assert bench.posted == []
    bench.goal.hold(False)
    assert credits_in(bench.posted) == [3]
    bench.feed(7)
    assert bench.read(3) == [5, 6, 7]
    assert bench.goal.dropped == 4
    bench.check_that_all_is_read()


def test_who_holds_loses_nothing() -> None:
    bench = Bench(window=6)
    bench.goal.hold(False)
    bench.goal.hold(True)
    bench.feed(1, 2, 3, 4, 5, 6)
    assert bench.read(6) == [1, 2, 3, 4, 5, 6]
    assert bench.goal.dropped == 0


@pytest.mark.parametrize("window", [2, 3, 4, 64])
def test_who_does_not_hold_never_keeps_the_server_waiting(window: int) -> None:
    bench = Bench(window)
    peer = Peer(bench, window)
    bench.goal.hold(False)
    for number in range(1, 200):
        peer.say()
        assert peer.last == number
    kept = window // 2
    assert bench.read(kept) == list(range(200 - kept, 200))
    assert bench.goal.dropped == 199 - kept


def test_who_does_not_hold_still_gets_the_newest_with_the_smallest_window() -> None:
    bench = Bench(window=1)
    bench.goal.hold(False)
    bench.feed(1)
    bench.end(1)
    assert bench.read(1) == [1]


def test_what_the_server_left_out_counts_as_dropped() -> None:
    bench = Bench(place=10)
    bench.feed(13)
    assert bench.goal.dropped == 0  # it is still to be read
    assert bench.read(1) == [13]
    assert bench.goal.dropped == 2
    bench.feed(14)
    assert bench.read(1) == [14]
    assert bench.goal.dropped == 2
    bench.end(20)
    assert bench.goal.dropped == 2
    assert bench.next() is None
    assert (bench.goal.cursor, bench.goal.dropped) == (20, 8)


def test_an_end_that_counts_less_than_has_come_changes_nothing() -> None:
    bench = Bench()
    bench.feed(1, 2)
    bench.end(0)
    assert bench.read(2) == [1, 2]
    assert bench.next() is None
    assert (bench.goal.cursor, bench.goal.dropped) == (2, 0)


# Closing


def test_closing_says_so_once_and_ends_the_stream_but_not_the_goal() -> None:
    bench = Bench()
    bench.feed(1)
    bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING))
    bench.goal.close()
    bench.goal.close()
    assert bench.posted == [Close(ID)]
    assert not bench.goal.take()
    bench.feed(2)
    bench.goal.on_message(StatusChanged(ID, GoalStatus.CANCELING))
    assert not bench.goal.take()
    assert bench.goal.status is GoalStatus.CANCELING
    bench.end(2)
    assert at_once(bench.goal.outcome()).status is GoalStatus.SUCCEEDED


def test_closing_keeps_an_outcome_and_need_not_be_said_after_it() -> None:
    bench = Bench()
    bench.feed(1)
    bench.end(1)
    bench.goal.close()
    assert bench.posted == [Received(ID)]
    assert bench.next() is None
    assert at_once(bench.goal.outcome()).result == b"result"


def test_what_was_not_read_is_let_go_of_on_closing_and_gives_no_credit() -> None:
    bench = Bench(window=4)
    bench.feed(1, 2, 3, 4)
    bench.goal.close()
    bench.goal.hold(False)
    assert bench.posted == [Close(ID)]


async def test_closing_wakes_who_reads() -> None:
    bench = Bench()
    assert await while_waiting(bench.goal.receive, bench.goal.close) is None


def test_the_end_of_a_block_closes() -> None:
    bench = Bench()
    with bench.goal:
        pass
    assert bench.posted == [Close(ID)]


def test_a_stream_without_feedback_gives_only_the_outcome_and_need_not_be_closed() -> None:
    bench = Bench(window=0)
    bench.goal.on_message(StatusChanged(ID, GoalStatus.EXECUTING))
    assert not bench.goal.take()
    assert bench.goal.status is GoalStatus.EXECUTING
    bench.goal.hold(False)
    bench.goal.close()
    bench.end(9)
    assert at_once(bench.goal.outcome()).status is GoalStatus.SUCCEEDED
    assert bench.posted == [Received(ID)]


# Another connection


def followed(own: bool, after: int | None = 3, window: int = 4) -> Bench:
    opening = Follow(ID, "fibonacci", GOAL_ID, after, own, window)
    bench = Bench(window, accepted=False, opening=opening)
    assert bench.goal.opening() == opening
    return bench


def test_on_another_connection_it_goes_on_after_what_has_arrived() -> None:
    bench = Bench(window=8)
    bench.feed(1, 2, 3)
    bench.read(1)
    assert bench.goal.opening() == Follow(ID, "fibonacci", GOAL_ID, 3, True, 6)
    bench.follow(GoalStatus.EXECUTING, place=3)
    assert bench.goal.status is GoalStatus.EXECUTING
    bench.feed(4)
    assert bench.read(3) == [2, 3, 4]
    assert bench.goal.dropped == 0


def test_on_another_connection_it_goes_on_from_its_place_if_nothing_has_arrived() -> None:
    assert Bench(place=5).goal.opening() == Follow(ID, "fibonacci", GOAL_ID, 5, True, 4)


@pytest.mark.parametrize("own", [True, False])
def test_an_observer_stays_one_and_the_goals_own_client_too(own: bool) -> None:
    bench = followed(own, after=None)
    bench.follow(place=2)
    assert bench.goal.opening() == Follow(ID, "fibonacci", GOAL_ID, 2, own, 4)


def test_what_got_lost_between_two_connections_counts_as_dropped() -> None:
    bench = Bench()
    bench.feed(1)
    bench.goal.opening()
    bench.follow(GoalStatus.EXECUTING, place=5)
    bench.feed(6)
    assert bench.read(2) == [1, 6]
    assert bench.goal.dropped == 4


def test_credit_that_was_not_given_is_not_given_to_another_connection() -> None:
    bench = Bench(window=4)
    bench.feed(1)
    bench.read(1)
    assert bench.posted == []
    opening = bench.reopened()
    assert opening.credit == 4
    bench.feed(2)
    bench.read(1)
    assert bench.posted == []


def test_a_stream_that_is_full_asks_for_nothing_until_it_is_read() -> None:
    bench = Bench(window=4)
    bench.feed(1, 2, 3, 4)
    assert bench.goal.opening() == Follow(ID, "fibonacci", GOAL_ID, 4, True, 0)
    assert bench.read(2) == [1, 2]
    assert credits_in(bench.posted) == [2]
    bench.feed(5)
    assert bench.read(3) == [3, 4, 5]


def test_a_stream_that_is_full_survives_any_number_of_connections() -> None:
    bench = Bench(window=4)
    bench.feed(1, 2, 3, 4)
    for _ in range(5):
        assert bench.reopened().credit == 0
        bench.follow(place=4)
    assert bench.read(4) == [1, 2, 3, 4]


@pytest.mark.parametrize("window", [0, 4])
def test_a_stream_that_is_closed_asks_for_the_outcome_only(window: int) -> None:
    bench = Bench(window)
    bench.goal.close()
    if window:
        bench.feed(1)  # it was on its way
    opening = bench.reopened()
    assert (opening.after, opening.credit) == (int(window > 0), None)


@pytest.mark.parametrize("window", [0, 4])
def test_a_goals_own_client_is_that_also_if_it_wants_the_outcome_only(window: int) -> None:
    bench = Bench(window)
    bench.goal.close()
    opening = bench.reopened()
    assert opening.own


def test_a_status_that_changed_between_two_connections_is_told() -> None:
    bench = Bench()
    bench.goal.opening()
    bench.follow(GoalStatus.EXECUTING)
    bench.end()
    assert bench.next() is GoalStatus.EXECUTING


def test_a_status_from_before_the_one_on_another_connection_is_not_told_any_more() -> None:
    bench = Bench()
    bench.goal.opening()
    bench.goal.on_message(Following(ID, STAMP, GoalStatus.CANCELED, False, 0))
    bench.goal.on_message(StatusChanged(ID, GoalStatus.CANCELING))
    bench.feed(1)
    assert bench.next() == FeedbackItem(1, b"1")
    assert bench.goal.status is GoalStatus.CANCELED


def test_a_status_that_is_the_same_on_another_connection_is_not_told_again() -> None:
    bench = Bench()
    bench.goal.opening()
    bench.follow(GoalStatus.ACCEPTED)
    bench.check_that_all_is_read()


# The statuses of all goals


class StatusBench:
    """The statuses at the other end, and what is posted about them."""

    def __init__(self, window: int = 4, *, begun: bool = True) -> None:
        self.posted: list[FromClient] = []
        self.statuses = RemoteStatuses(ID, "fibonacci", window, self.posted.append)
        if begun:
            assert not self.statuses.on_message(Watching(ID, 0))

    def change(self, *stamps: int, dropped: int = 0) -> None:
        for stamp in stamps:
            changed = GoalChanged(ID, bytes(GOAL_ID), stamp, GoalStatus.EXECUTING, dropped)
            assert not self.statuses.on_message(changed)

    def read(self, count: int) -> list[int]:
        stamps = []
        for _ in range(count):
            info = at_once(self.statuses.receive())
            assert info is not None
            stamps.append(info.stamp)
        return stamps

    def finish(self) -> None:
        assert self.statuses.on_message(Finished(ID))

    def reopened(self) -> WatchStatus:
        """What is sent on another connection."""
        opening = self.statuses.opening()
        assert isinstance(opening, WatchStatus)
        return opening


async def test_statuses_begin_when_the_server_says_so() -> None:
    bench = StatusBench(begun=False)
    assert bench.statuses.opening() == WatchStatus(ID, "fibonacci", 4)
    await while_waiting(bench.statuses.answered, lambda: bench.statuses.on_message(Watching(ID, 0)))


def test_on_another_connection_the_known_goals_come_anew_behind_those_that_have_come() -> None:
    bench = StatusBench(begun=False)
    assert not bench.statuses.on_message(Watching(ID, 3))
    bench.change(1, 2)
    bench.read(1)
    assert not bench.statuses.on_message(Watching(ID, 7))
    assert bench.statuses.known == 2 + 7


async def test_the_goals_that_there_were_are_listed_once_each() -> None:
    bench = StatusBench(10, begun=False)
    assert not bench.statuses.on_message(Watching(ID, 2))

    async def listed() -> list[int]:
        return [info.stamp for info in await bench.statuses.listed()]

    def change(*goals: int) -> None:
        for number in goals:
            goal_id = bytes([number] * 16)
            assert not bench.statuses.on_message(
                GoalChanged(ID, goal_id, number, GoalStatus.EXECUTING, 0)
            )

    def break_off() -> None:
        change(1)  # and then the connection is lost
        assert not bench.statuses.on_message(Watching(ID, 3))
        change(1, 2, 3, 4)

    assert await while_waiting(listed, break_off) == [1, 2, 3]
    assert at_once(bench.statuses.receive()) is not None  # the fourth came later


async def test_a_list_is_not_waited_for_when_another_server_has_fewer_goals() -> None:
    bench = StatusBench(begun=False)
    assert not bench.statuses.on_message(Watching(ID, 2))
    again = Watching(ID, 0)
    assert (
        await while_waiting(bench.statuses.listed, lambda: bench.statuses.on_message(again)) == []
    )


async def test_a_list_ends_with_the_server_and_fails_with_the_connection() -> None:
    bench = StatusBench(begun=False)
    assert not bench.statuses.on_message(Watching(ID, 2))
    bench.change(1)
    (found,) = cast("list[GoalInfo]", await while_waiting(bench.statuses.listed, bench.finish))
    assert found.stamp == 1
    bench = StatusBench(begun=False)
    assert not bench.statuses.on_message(Watching(ID, 2))
    error = await while_waiting(bench.statuses.listed, lambda: bench.statuses.fail(LOST))
    assert isinstance(error, ConnectionLost)


async def test_statuses_that_the_server_refuses_do_not_begin() -> None:
    bench = StatusBench(begun=False)
    refusal = Failed(ID, Why.FORBIDDEN, "no")
    error = await while_waiting(bench.statuses.answered, lambda: bench.statuses.on_message(refusal))
    assert isinstance(error, AuthenticationFailed)
    assert StatusBench().statuses.on_message(refusal)


async def test_statuses_are_waited_for_and_come_in_order() -> None:
    bench = StatusBench()
    info = await while_waiting(bench.statuses.receive, lambda: bench.change(1))
    assert info == GoalInfo(GOAL_ID, 1, GoalStatus.EXECUTING)
    assert isinstance(info, GoalInfo)
    assert isinstance(info.goal_id, GoalID)
    assert isinstance(info.status, GoalStatus)
    bench.change(2, 3)
    assert bench.read(2) == [2, 3]


async def test_statuses_end_after_what_there_was() -> None:
    bench = StatusBench()
    bench.change(1)
    bench.finish()
    assert bench.read(1) == [1]
    assert at_once(bench.statuses.receive()) is None
    another = StatusBench()
    assert await while_waiting(another.statuses.receive, another.finish) is None


def test_an_end_of_statuses_before_the_beginning_is_the_peers_error() -> None:
    bench = StatusBench(begun=False)
    with pytest.raises(ProtocolError):
        bench.statuses.on_message(Finished(ID))


def test_what_the_server_left_out_of_the_statuses_is_told() -> None:
    bench = StatusBench()
    assert bench.statuses.dropped == 0
    bench.change(1, dropped=3)
    assert bench.statuses.dropped == 3


@pytest.mark.parametrize(
    ("window", "batch"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (8, 4), (64, 32)]
)
def test_credit_for_statuses_is_given_in_batches_of_half_a_window(window: int, batch: int) -> None:
    bench = StatusBench(window)
    bench.change(*range(window))
    for count in range(1, window + 1):
        bench.read(1)
        assert credits_in(bench.posted) == [batch] * (count // batch)


def test_no_credit_for_statuses_is_given_after_the_end() -> None:
    bench = StatusBench()
    bench.change(1, 2, 3)
    bench.finish()
    assert bench.read(3) == [1, 2, 3]
    assert bench.posted == []


@pytest.mark.parametrize("window", [1, 2, 5])
def test_statuses_beyond_the_credit_are_the_peers_error(window: int) -> None:
    bench = StatusBench(window)
    bench.change(*range(window))
    with pytest.raises(ProtocolError, match=r"^there were more messages than credit for them$"):
        bench.change(window, window + 1)  # one too many may be from a connection before


@pytest.mark.parametrize(
    "message", [ENDED, Following(ID, 1, GoalStatus.ACCEPTED, False, 0), Ping()], ids=type
)
def test_what_is_about_no_statuses_is_the_peers_error(message: object) -> None:
    with pytest.raises(ProtocolError, match=f"a {type(message).__name__} does not answer"):
        StatusBench().statuses.on_message(message)


async def test_closing_the_statuses_says_so_once_and_wakes_who_reads() -> None:
    bench = StatusBench()
    assert await while_waiting(bench.statuses.receive, bench.statuses.close) is None
    bench.statuses.close()
    assert bench.posted == [Close(ID)]
    bench.change(1)
    assert at_once(bench.statuses.receive()) is None
    bench.finish()
    assert bench.posted == [Close(ID)]


def test_statuses_that_have_ended_need_not_be_closed() -> None:
    bench = StatusBench()
    bench.finish()
    bench.statuses.close()
    assert bench.posted == []


def test_on_another_connection_statuses_are_asked_for_as_far_as_there_is_room() -> None:
    bench = StatusBench(window=4)
    bench.change(1)
    assert bench.statuses.opening() == WatchStatus(ID, "fibonacci", 3)
    bench.change(2, 3, 4)
    assert bench.statuses.opening() == WatchStatus(ID, "fibonacci", 0)
    with pytest.raises(ProtocolError, match=r"^there were more messages than credit for them$"):
        bench.change(5)
    assert bench.read(4) == [1, 2, 3, 4]


def test_credit_for_statuses_that_was_not_given_is_not_given_to_another_connection() -> None:
    bench = StatusBench(window=4)
    bench.change(1)
    bench.read(1)
    assert bench.statuses.opening() == WatchStatus(ID, "fibonacci", 4)
    bench.change(2)
    bench.read(1)
    assert bench.posted == []


def test_statuses_that_nobody_reads_survive_any_number_of_connections() -> None:
    bench = StatusBench(window=4)
    bench.change(1, 2, 3, 4)
    for _ in range(5):
        assert bench.reopened().credit == 0
    assert bench.read(4) == [1, 2, 3, 4]


def test_statuses_that_are_closed_are_not_asked_for_on_another_connection() -> None:
    bench = StatusBench()
    assert not bench.statuses.is_over
    bench.statuses.close()
    assert bench.statuses.is_over
    assert not Bench().goal.is_over  # its outcome may still be wanted


def test_what_was_left_out_of_the_statuses_on_all_connections_is_told() -> None:
    bench = StatusBench()
    bench.change(1, dropped=3)
    bench.statuses.opening()
    bench.change(2, dropped=1)
    assert bench.statuses.dropped == 4
