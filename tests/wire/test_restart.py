"""Clients and a goal that its server has kept across a restart: another attempt, the same
owner, and nothing of the stop.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as some

from fibaction.border.abc import FeedbackItem, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.wire.auth import Permission
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.messages import (
    CancelGoals,
    Credit,
    Ended,
    Failed,
    Feedback,
    Follow,
    Following,
    Goodbye,
    Rejected,
    SendGoal,
    Why,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import GoalKept, GoalRejected, UnknownGoal
from fibaction.words.goals import UNKNOWN_SENDER, CancelAnswer, GoalID, Outcome, digest_of
from tests.wire.ends import (
    ANN,
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    GOAL_ID,
    SUCCEEDED,
    WINDOW,
    A,
    Network,
    asked_again,
    endpoint_of,
    follow,
    following,
    goal_of,
    held,
    kinds,
    numbers_of,
    reached,
    send,
    serving,
)

pytestmark = pytest.mark.anyio

KEPT = GoalKept("the server keeps the goal")


def numbered(call_id: int, *numbers: int) -> list[Feedback]:
    return [Feedback(call_id, number, b"", 5) for number in numbers]


# At the client: another attempt


async def test_a_goal_shares_the_keys_of_its_attributes_and_has_no_queue_until_it_needs_one() -> (
    None
):
    """Each of the two would be a tenth of the memory of an active goal over TCP."""
    first, second = (
        RemoteGoal(GOAL_ID, send(1, credit=WINDOW), WINDOW, lambda _: None) for _ in range(2)
    )
    assert len(vars(first)) <= 30
    assert first._items is second._items


async def test_attempts_without_feedback_are_not_remembered() -> None:
    goal = RemoteGoal(GOAL_ID, send(1, credit=WINDOW), WINDOW, lambda _: None)
    for attempt in range(1, 100):
        goal.on_message(Following(1, 7, EXECUTING, latest=False, place=0, attempt=attempt))
        if attempt == 1:
            goal.on_message(Feedback(1, 1, b"", 5))
    assert len(goal._earlier) == 1
    goal.on_message(Feedback(1, 1, b"", 6))
    items = [FeedbackItem(1, b"", 1, 5), FeedbackItem(1, b"", 99, 6)]
    assert [*goal.take(), *goal.take()] == items


async def test_an_attempt_may_be_a_lower_one_after_a_store_has_lost_its_last_writes() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server, attempt=3) as (goal, call_id):
            await server.say(*numbered(call_id, 1, 2))
            assert await numbers_of(goal, 2) == [1, 2]
            server, asked = await asked_again(network, server, Follow)
            assert asked.attempt == 3
            await server.say(following(asked, attempt=2), *numbered(call_id, 1))
            assert await numbers_of(goal, 1) == [1]
            assert goal.attempt == 2


STEPS = some.lists(
    some.one_of(
        some.tuples(some.just("feedback"), some.integers(1, 3)),
        some.tuples(some.just("attempt"), some.integers(1, 3)),
        some.tuples(some.just("take"), some.integers(0, 3)),
        some.tuples(some.sampled_from(["reconnect", "hold", "release"]), some.just(0)),
    ),
    max_size=40,
)


@given(STEPS)
def test_a_reader_gets_the_feedback_of_each_attempt_in_order_and_counts_the_rest(
    steps: list[tuple[str, int]],
) -> None:
    """A server that has the credit that it was given, and a client that reads at times."""
    credit, attempt, number, passed = WINDOW, 1, 0, 0
    told: deque[tuple[int, int]] = deque()
    read: list[tuple[int, int]] = []

    def post(message: Any) -> None:
        nonlocal credit
        if isinstance(message, Credit):
            credit += message.count

    def take(limit: int) -> bool:
        items = [update for update in goal.take(limit) if isinstance(update, FeedbackItem)]
        assert len({item.attempt for item in items}) <= 1
        for item in items:
            read.append((item.attempt, item.number))
            while told.popleft() != read[-1]:  # those before were dropped here
                pass
        assert not items or (goal.attempt, goal.cursor) == read[-1]
        return bool(items)

    goal = RemoteGoal(GOAL_ID, send(1, credit=WINDOW), WINDOW, post)
    goal.on_message(Following(1, 7, EXECUTING, latest=False, place=0))
    for step, value in steps:
        if step == "feedback" and credit:
            number, credit = number + value, credit - 1
            told.append((attempt, number))
            goal.on_message(Feedback(1, number, b""))
        elif step == "attempt":
            passed, attempt, number = passed + number, attempt + value, 0
            goal.on_message(Following(1, 7, EXECUTING, latest=False, place=0, attempt=attempt))
        elif step == "take":
            take(value)
        elif step == "reconnect":
            asked = goal.opening()
            assert isinstance(asked, Follow)
            assert (asked.attempt, asked.after) == (attempt, number)
            assert asked.credit is not None
            assert 0 <= asked.credit <= WINDOW
            credit = asked.credit
        elif step in ("hold", "release"):
            goal.hold(step == "hold")
        assert credit or told  # it is never stuck
    goal.on_message(Ended(1, SUCCEEDED, b"", "", number))
    while take(1):
        pass
    assert not told
    assert goal.dropped == passed + number - len(read)


# At the server: another attempt


class Kept(ForwardingEndpoint):
    """An endpoint with one goal, which it keeps across restarts."""

    def __init__(self, attempt: int = 1) -> None:
        super().__init__(held())
        self.goal = GoalRecord(GOAL_ID, digest_of(GOAL), 7, UNKNOWN_SENDER)
        self.goal.attempt = attempt
        self.goal.status = self.goal.told_status = EXECUTING
        self.log = FeedbackLog(self.goal, window=10)
        self.error: Exception | None = None
        """Raised by each request."""
        self.owned: list[bool] = []

    async def __aenter__(self) -> Kept:
        return self  # `inner` is for the name only

    async def __aexit__(self, *_: object) -> None:
        pass

    def start_again(self) -> None:
        """Run the goal again, as after a restart."""
        self.goal.attempt += 1
        self.goal.feedback_count = 0
        self.log = FeedbackLog(self.goal, window=10)
        self.error = None

    def tell(self, count: int) -> None:
        for _ in range(count):
            self.log.append(b"")

    def end(self) -> None:
        self.goal.status = self.goal.told_status = SUCCEEDED
        self.goal.outcome = Outcome(SUCCEEDED, b"result")
        self.log.finish()

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        if self.error is not None:
            raise self.error
        if digest_of(request.goal) != self.goal.digest:
            raise GoalRejected("another goal", goal_id=request.goal_id)
        if not self.goal.sender.owner:
            self.goal.sender = request.sender
        own = request.sender.owner == self.goal.sender.owner
        return self.log.follow(feedback=request.feedback, own=own, after=0)

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        if self.error is not None:
            raise self.error
        self.owned.append(own)
        return self.log.follow(own=own, after=after, attempt=attempt)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        assert self.error is not None
        raise self.error

    def owner_of(self, goal_id: GoalID) -> bytes:
        return b"" if isinstance(self.error, UnknownGoal) else self.goal.sender.owner


@pytest.mark.parametrize(
    ("after", "attempt", "place"), [(17, 1, 0), (2, 2, 2), (17, 2, 3), (2, 3, 0), (None, 1, 3)]
)
async def test_a_client_goes_on_within_the_attempt_that_it_knows(
    after: int | None, attempt: int, place: int
) -> None:
    kept = Kept(attempt=2)
    kept.tell(3)
    async with serving(kept) as served:
        client = await served.greet()
        await client.say(follow(after, attempt=attempt))
        told, *items = await client.hear_all()
        assert told == Following(1, 7, EXECUTING, latest=False, place=place, attempt=2)
        assert [item.number for item in items] == [*range(place + 1, 4)]


async def test_the_end_that_a_server_has_forgotten_is_told_within_its_attempt() -> None:
    kept = Kept(attempt=2)
    async with serving(kept) as served:
        client = await served.greet()
        assert (await client.ask(send(1), Following)).attempt == 2
        kept.tell(3)
        kept.end()
        assert len(await client.hear_all()) == 4
        kept.error = UnknownGoal(GOAL_ID)
        for request, (after, attempt, place) in enumerate([(2, 2, 2), (2, 1, 0)]):
            client.channel.cut()
            client = await served.greet()
            asked = follow(after, request=request, attempt=attempt)
            told = await client.ask(asked, Following)
            assert (told.place, told.attempt) == (place, 2)
            await client.hear_all()


@pytest.mark.parametrize("numbers", [(), (1, 2)])
@pytest.mark.parametrize("credit", [ANY, 1])
async def test_a_gateway_tells_another_attempt_before_its_first_feedback(
    numbers: tuple[int, ...], credit: int
) -> None:
    async with reached() as (connection, server):
        async with serving(ForwardingEndpoint(endpoint_of(connection))) as served:
            client = await served.greet()
            await client.say(send(1, credit=credit))
            sent = await server.hear(SendGoal)
            again = Following(sent.id, 7, EXECUTING, latest=False, place=0, attempt=2)
            await server.say(following(sent), *numbered(sent.id, 1), again)
            await server.say(*numbered(sent.id, *numbers))
            heard = await client.hear_all()
            await client.say(Credit(1, ANY))
            await server.say(Ended(sent.id, SUCCEEDED, b"", "", len(numbers)))
            heard += await client.hear_all()
            assert heard == [
                Following(1, 7, EXECUTING, latest=False, place=0, attempt=1),
                *numbered(1, 1),
                Following(1, 7, EXECUTING, latest=False, place=0, attempt=2),
                *numbered(1, *numbers),
                Ended(1, SUCCEEDED, b"", "", len(numbers)),
            ]


# At the server: whose goal it is


async def started_again(kept: Kept, *, session: bytes = ANN, **settings: Any) -> Any:
    """The block of a server with the goal that a client has sent before a restart."""
    async with serving(kept) as served:
        await (await served.greet(session)).ask(send(1), Following)
    return serving(kept, **settings)


@pytest.mark.parametrize("session", [ANN, b""])
async def test_the_client_that_sent_a_goal_owns_it_after_a_restart(session: bytes) -> None:
    kept = Kept()
    async with await started_again(kept, session=session) as served:
        for other in (session, BOB):
            await (await served.greet(other)).ask(follow(0), Following)
    # A client without a session is another one on each connection.
    assert kept.owned == [bool(session), False]


async def test_a_client_that_may_only_send_may_follow_its_own_goals_after_a_restart() -> None:
    access = WireSettings(authorize=lambda _, __, verb: verb is Permission.SEND)
    kept = Kept()
    async with await started_again(kept, access=access) as served:
        for session in (BOB, b""):
            other = await served.greet(session)
            assert (await other.ask(follow(0), Failed)).why == Why.FORBIDDEN
        assert await (await served.greet(ANN)).ask(follow(0), Following)


async def test_a_goal_that_is_followed_and_then_sent_again_is_compared_by_its_endpoint() -> None:
    kept = Kept()
    async with await started_again(kept) as served:
        client = await served.greet()
        await client.ask(follow(0), Following)
        kept.end()
        await client.hear(Ended)
        other = SendGoal(2, "fibonacci", A, b"another", ANY)
        assert (await client.ask(other, Rejected)).reason == "another goal"
        kept.error = UnknownGoal(GOAL_ID)  # only its ID can be compared
        assert (await client.ask(send(3), Following)).status == SUCCEEDED
        await client.hear(Ended)
        kept.error = None
        await client.ask(send(4), Following)
        await client.hear(Ended)
        kept.error = UnknownGoal(GOAL_ID)
        other = SendGoal(5, "fibonacci", A, b"another", ANY)
        assert (await client.ask(other, Rejected)).reason == "its ID is in use by another goal"


# At the server: the stop of a server that keeps its goals


async def test_nothing_is_told_of_a_goal_that_is_kept_for_the_next_start() -> None:
    kept = Kept()
    async with serving(kept) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.ask(send(1), Following)
        await other.ask(follow(0, own=False, credit=None), Following)
        kept.tell(1)
        await client.hear(Feedback)
        kept.log.fail(KEPT)
        for one in (client, other):
            assert await one.hear_all() == []
            assert await one.is_served()


async def test_a_server_that_closes_does_not_wait_for_an_end_that_is_not_told() -> None:
    kept = Kept()
    with anyio.fail_after(5):
        async with serving(kept) as served:
            client = await served.greet()
            await client.ask(send(1, credit=0), Following)
            kept.goal.status = SUCCEEDED  # as the executor has said, but the store has failed
            kept.log.fail(KEPT)
        assert kinds(await client.hear_all()) == [Goodbye]


@pytest.mark.parametrize(
    "message", [send(1), follow(0), CancelGoals(1, "fibonacci", A, None)], ids=type
)
async def test_a_request_to_a_server_that_keeps_its_goals_has_no_answer(message: Any) -> None:
    kept = Kept()
    kept.error = KEPT
    async with serving(kept) as served:
        client = await served.greet()
        await client.say(message)
        assert await client.hear_all() == []
        assert await client.is_served()
        kept.error = None  # and its ID is free
        await client.ask(send(1), Following)
