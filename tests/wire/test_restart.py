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

from fibaction.border.abc import Endpoint, FeedbackItem, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.wire.auth import Permission
from fibaction.wire.client.connection import open_connection
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.messages import (
    CancelGoals,
    Close,
    Credit,
    Ended,
    Failed,
    Feedback,
    Follow,
    Following,
    Goodbye,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Why,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import ConnectionLost, GoalKept, GoalRejected, UnknownGoal
from fibaction.words.goals import UNKNOWN_SENDER, CancelAnswer, GoalID, Outcome, digest_of
from fibaction.words.statuses import GoalStatus
from tests.wire import memory
from tests.wire.ends import (
    ANN,
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    GOAL_ID,
    PATIENT,
    SUCCEEDED,
    WHERE,
    WINDOW,
    A,
    Network,
    Served,
    asked_again,
    endpoint_of,
    follow,
    following,
    goal_of,
    held,
    kinds,
    numbers_of,
    outcome_of,
    reached,
    send,
    serving,
)
from tests.wire.memory import Running, settled

pytestmark = pytest.mark.anyio

KEPT = GoalKept("the server keeps the goal")


def numbered(call_id: int, *numbers: int) -> list[Feedback]:
    return [Feedback(call_id, number, b"") for number in numbers]


# At the client: another attempt


async def test_the_feedback_of_another_attempt_is_numbered_anew() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(*numbered(call_id, 1, 2))
            assert await numbers_of(goal, 2) == [1, 2]
            server, asked = await asked_again(network, server, Follow)
            assert asked == Follow(call_id, "fibonacci", GOAL_ID, 2, True, WINDOW, 1)
            await server.say(following(asked, attempt=2), *numbered(call_id, 1))
            assert await numbers_of(goal, 1) == [1]
            assert (goal.attempt, goal.cursor, goal.dropped) == (2, 1, 0)
            server, asked = await asked_again(network, server, Follow)
            assert asked == Follow(call_id, "fibonacci", GOAL_ID, 1, True, WINDOW, 2)
            ended = Ended(call_id, SUCCEEDED, b"result", "", 2)
            await server.say(following(asked, attempt=2, place=1), *numbered(call_id, 2), ended)
            assert await numbers_of(goal) == [2]
            assert (goal.status, goal.dropped) == (SUCCEEDED, 0)


async def test_an_attempt_that_begins_on_an_open_connection_takes_no_credit() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            for attempt in (2, 3):
                again = Following(call_id, 7, EXECUTING, latest=False, place=0, attempt=attempt)
                await server.say(again, *numbered(call_id, 1, 2))
                assert await numbers_of(goal, 2) == [1, 2]
                assert await server.hear(Credit) == Credit(call_id, 2)


async def test_unread_feedback_of_the_attempt_before_is_read_first() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(*numbered(call_id, 1, 2))
            await settled()
            for attempt in (2, 3, 4):  # those between have no feedback
                server, asked = await asked_again(network, server, Follow)
                await server.say(following(asked, attempt=attempt))
            await server.say(*numbered(call_id, 1))
            await settled()
            server, asked = await asked_again(network, server, Follow)
            assert (asked.after, asked.attempt, asked.credit) == (1, 4, WINDOW - 3)
            await server.say(following(asked, attempt=4))
            for item in ((1, 1), (1, 2), (4, 1)):
                (update,) = goal.take()
                assert (update.attempt, update.number) == (goal.attempt, goal.cursor) == item


async def test_attempts_without_feedback_are_not_remembered() -> None:
    goal = RemoteGoal(GOAL_ID, send(1, credit=WINDOW), WINDOW, lambda _: None)
    for attempt in range(1, 100):
        goal.on_message(Following(1, 7, EXECUTING, latest=False, place=0, attempt=attempt))
        if attempt == 1:
            goal.on_message(Feedback(1, 1, b""))
    assert len(goal._earlier) == 1
    goal.on_message(Feedback(1, 1, b""))
    assert [*goal.take(), *goal.take()] == [FeedbackItem(1, b"", 1), FeedbackItem(1, b"", 99)]


async def test_what_was_missed_is_counted_within_each_attempt() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            again = Following(call_id, 7, EXECUTING, latest=False, place=0, attempt=2)
            await server.say(*numbered(call_id, 1, 3), again, *numbered(call_id, 3))
            await server.say(Ended(call_id, SUCCEEDED, b"", "", 5))
            assert await numbers_of(goal) == [1, 3, 3]
            assert goal.dropped == 1 + 2 + 2


async def test_feedback_that_is_not_wanted_is_not_missed_in_any_attempt() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            second, third = (
                Following(call_id, 7, EXECUTING, latest=False, place=0, attempt=attempt)
                for attempt in (2, 3)
            )
            await server.say(*numbered(call_id, 1), second, *numbered(call_id, 1))
            await settled()
            goal.close()
            assert goal.attempt == 2
            await server.say(*numbered(call_id, 2), third)
            await server.say(Ended(call_id, SUCCEEDED, b"", "", 0))
            assert (await outcome_of(goal)).status is SUCCEEDED
            assert (goal.attempt, goal.newest_attempt, goal.dropped) == (3, 3, 0)


@pytest.mark.parametrize("latest", [True, False])
async def test_the_oldest_feedback_gives_way_also_to_another_attempt(latest: bool) -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server, latest=latest) as (goal, call_id):
            goal.hold(False)
            again = Following(call_id, 7, EXECUTING, latest=latest, place=0, attempt=2)
            await server.say(*numbered(call_id, 1, 2), again, *numbered(call_id, 1))
            await settled()
            assert await numbers_of(goal, 1) == ([1] if latest else [2])
            assert goal.attempt == (2 if latest else 1)
            assert goal.dropped == (2 if latest else 1)


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


async def test_a_stream_is_asked_for_behind_feedback_of_an_attempt() -> None:
    async with reached() as (connection, server):
        endpoint = endpoint_of(connection)
        async with Running(lambda: endpoint.feedback(GOAL_ID, after=17, attempt=2)) as asking:
            asked = await server.hear(Follow)
            assert (asked.after, asked.attempt) == (17, 2)
            await server.say(following(asked, attempt=3))
            goal = await asking.answer()
            assert (goal.attempt, goal.cursor) == (3, 0)


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


async def test_a_goal_that_is_followed_before_it_is_run_again_begins_anew_then() -> None:
    kept = Kept()
    async with serving(kept) as served:
        client = await served.greet()
        assert (await client.ask(follow(17), Following)).attempt == 1
        kept.goal.attempt = 2  # the server has decided
        kept.tell(1)
        kept.goal.status = kept.goal.told_status = GoalStatus.CANCELING
        kept.log.tell_status()
        assert await client.hear_all() == [
            Following(1, 7, GoalStatus.CANCELING, latest=False, place=0, attempt=2),
            StatusChanged(1, GoalStatus.CANCELING),
            *numbered(1, 1),
        ]


async def test_the_begin_of_an_attempt_takes_no_credit() -> None:
    kept = Kept()
    async with serving(kept) as served:
        client = await served.greet()
        await client.say(follow(None, credit=1))
        await client.hear(Following)
        kept.goal.attempt = 2
        kept.tell(2)
        assert kinds(await client.hear_all()) == [Following, Feedback]
        await client.say(Credit(1, 1))
        assert kinds(await client.hear_all()) == [Feedback]


async def test_an_attempt_that_begins_after_a_close_counts_nothing_as_missed() -> None:
    async with reached() as (connection, server):
        async with serving(ForwardingEndpoint(endpoint_of(connection))) as served:
            client = await served.greet()
            await client.say(send(1))
            sent = await server.hear(SendGoal)
            await server.say(following(sent), *numbered(sent.id, 1))
            assert kinds(await client.hear_all()) == [Following, Feedback]
            await client.say(Close(1))
            await server.hear(Close)
            await server.say(following(sent, attempt=2), Ended(sent.id, SUCCEEDED, b"", "", 0))
            again, ended = await client.hear_all()
            assert (again.attempt, again.place, ended.place) == (2, 0, 0)


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


async def test_the_end_of_a_goal_is_kept_for_its_client_also_after_a_restart() -> None:
    kept = Kept()
    async with await started_again(kept) as served:
        client = await served.greet()
        assert await client.ask(follow(0), Following)
        kept.end()
        for _ in range(2):
            ended = await client.hear(Ended)
            client.channel.cut()
            kept.error = UnknownGoal(GOAL_ID)
            client = await served.greet()
            assert await client.ask(follow(0), Following)
        assert await client.hear(Ended) == ended
        await client.say(Received(1))
        assert (await client.ask(follow(0), Failed)).why == Why.UNKNOWN_GOAL


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


# Both together


async def test_a_client_does_not_notice_a_restart_but_for_the_attempt() -> None:
    kept = Kept()
    served: list[Served] = []
    lines: list[memory.MemoryChannel] = []

    async def dial() -> memory.MemoryChannel:
        if not served:
            raise ConnectionLost("both servers have gone")
        end, other = memory.pair(other=WHERE)
        lines.append(end)
        served[-1].serve(end)
        await anyio.lowlevel.checkpoint()
        return other

    async with serving(kept) as first:
        served.append(first)
        async with open_connection(dial, WHERE, PATIENT) as connection:
            endpoint: Endpoint = endpoint_of(connection)
            goal = await endpoint.send_goal(GOAL_ID, GOAL)
            kept.tell(3)
            assert await numbers_of(goal, 2) == [1, 2]
            kept.error = KEPT
            async with Running(lambda: endpoint.send_goal(GOAL_ID, GOAL)) as sending:
                kept.log.fail(KEPT)
                async with serving(kept) as second:
                    served.append(second)
                    kept.start_again()
                    lines[0].cut()
                    other = await sending.answer()
                    assert (other.attempt, other.own) == (2, True)
                    kept.tell(2)
                    assert await numbers_of(goal, 3) == [3, 1, 2]
                    kept.end()
                    for stream in (goal, other):
                        assert (await outcome_of(stream)).result == b"result"
                    assert (goal.attempt, goal.dropped) == (2, 0)
                    assert kept.owned == [True]
                    goal.close()
                    other.close()
                    served.clear()  # its end may be noticed before that of the connection
