"""Several feedback messages in one: only for a client that accepts it, and only small ones."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some

from fibaction.server.execution import turns
from fibaction.wire.channel import CHUNK
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.frames import LEAST_FRAME
from fibaction.wire.messages import (
    Credit,
    Ended,
    Feedback,
    FeedbackBatch,
    Following,
    SendGoal,
)
from fibaction.words.errors import ProtocolError
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.wire.ends import (
    EXECUTING,
    GOAL_ID,
    SUCCEEDED,
    feedback,
    follow,
    goal_of,
    kinds,
    outcome_of,
    reached,
    scripted,
    send,
    serving,
)

pytestmark = pytest.mark.anyio


def payloads(*numbers: int) -> list[bytes]:
    return [FIBONACCI.feedback.encode(one) for one in feedback(*numbers)]


def sizes(*lengths: int) -> list[fib.Feedback]:
    """Feedback with payloads of about those lengths."""
    return [fib.Feedback([1] * length) for length in lengths]


# The server


@pytest.fixture(autouse=True)
def one_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    """An executor that does not wait yields all at once, also on a busy machine."""
    monkeypatch.setattr(turns, "EXECUTOR_SLICE", 60.0)


async def test_feedback_that_is_there_at_once_is_one_message() -> None:
    async with serving(scripted(*feedback(1, 2, 3), fib.Result([4]))) as served:
        client = await served.greet(batches=True)
        told = await client.ask_all(send(1))
        assert kinds(told) == [Following, FeedbackBatch, Ended]
        assert (told[1].number, told[1].payloads) == (1, payloads(1, 2, 3))
        assert told[2].place == 3


async def test_a_client_that_does_not_accept_batches_gets_single_messages() -> None:
    async with serving(scripted(*feedback(1, 2, 3), fib.Result([4]))) as served:
        client = await served.greet()
        told = await client.ask_all(send(1))
        assert kinds(told) == [Following, Feedback, Feedback, Feedback, Ended]


async def test_a_batch_uses_up_one_credit_for_each_of_its_messages() -> None:
    async with serving(scripted(*feedback(1, 2, 3, 4, 5), fib.Result([6]))) as served:
        client = await served.greet(batches=True)
        told = await client.ask_all(send(1, credit=2))
        assert kinds(told) == [Following, FeedbackBatch]
        told = [told[1], *await client.ask_all(Credit(1, 2))]
        assert [(one.number, one.payloads) for one in told] == [
            (1, payloads(1, 2)),
            (3, payloads(3, 4)),
        ]
        told = await client.ask_all(Credit(1, 2))
        assert kinds(told) == [Feedback, Ended]
        assert (told[0].number, told[0].payload) == (5, payloads(5)[0])


async def test_feedback_with_a_gap_is_told_by_single_messages_with_their_numbers() -> None:
    # A gateway: its own client has missed a message.
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            first, third = Feedback(call_id, 1, b"1", 5), Feedback(call_id, 3, b"3", 6)
            await server.say(first, third)

            class Gateway(type(scripted())):  # type: ignore[misc]  # a class that is made here
                async def feedback(self, *_: Any, **__: Any) -> Any:
                    return goal

            async with serving(Gateway(FIBONACCI, ())) as served:
                client = await served.greet(batches=True)
                told = await client.ask_all(follow(0, own=False))
                assert told[1:] == [Feedback(1, 1, b"1", 5), Feedback(1, 3, b"3", 6)]


@pytest.mark.parametrize("length", [CHUNK // 3, CHUNK // 2, 2 * CHUNK])
async def test_feedback_that_fills_more_than_one_write_is_told_by_single_messages(
    length: int,
) -> None:
    async with serving(scripted(*sizes(length, length, length), fib.Result([]))) as served:
        client = await served.greet(batches=True)
        told = await client.ask_all(send(1))
        assert kinds(told) == [Following, Feedback, Feedback, Feedback, Ended]
        assert [message.number for message in told[1:-1]] == [1, 2, 3]


async def test_of_feedback_that_is_too_large_for_one_frame_the_messages_that_fit_are_told() -> None:
    steps = [*sizes(LEAST_FRAME // 2, LEAST_FRAME // 2 + 300, LEAST_FRAME + 1, 1), fib.Result([])]
    async with serving(scripted(*steps)) as served:
        client = await served.greet(max_frame=LEAST_FRAME, batches=True)
        told = await client.ask_all(send(1))
        assert [message.number for message in told[1:-1]] == [1, 2, 4]
        assert set(kinds(told[1:-1])) == {Feedback}


# The client


async def test_an_empty_batch_is_the_servers_error() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(FeedbackBatch(call_id, 1, []))
            with pytest.raises(ProtocolError, match=r"invalid server message: .*length"):
                await outcome_of(goal)


async def test_a_batch_with_a_time_too_few_is_the_servers_error() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(FeedbackBatch(call_id, 1, [b"1", b"2"], [5]))
            with pytest.raises(ProtocolError, match="2 messages of feedback have 1 times"):
                await outcome_of(goal)


some_gaps = some.lists(some.tuples(some.integers(0, 3), some.integers(1, 5)), max_size=6)


@given(rows=some_gaps, latest=some.booleans(), holds=some.booleans(), after=some.integers(0, 6))
def test_a_batch_means_what_as_many_single_messages_mean(
    rows: list[tuple[int, int]], latest: bool, holds: bool, after: int
) -> None:
    """A row is a gap and a number of messages; `after` messages are read in between."""

    def read(*, in_batches: bool) -> Any:
        goal = RemoteGoal(GOAL_ID, SendGoal(1, "a", GOAL_ID, b"", 30), 30, lambda message: None)
        goal.on_message(Following(1, 7, EXECUTING, latest=latest, place=0))
        goal.hold(holds)
        number = 0
        taken: list[Any] = []
        for gap, count in rows:
            number += gap
            numbers = range(number + 1, number + count + 1)
            bodies = [b"%d" % one for one in numbers]
            times = [10 * one for one in numbers]
            if in_batches:
                goal.on_message(FeedbackBatch(1, numbers[0], bodies, times))
            else:
                for one, body, at in zip(numbers, bodies, times, strict=True):
                    goal.on_message(Feedback(1, one, body, at))
            number = numbers[-1]
            if len(taken) < after:
                taken += goal.take(after - len(taken))
        goal.on_message(Ended(1, SUCCEEDED, b"", "", number))
        while not isinstance(last := goal.take()[0], type(goal.known_outcome())):
            taken.append(last)
        return taken, goal.dropped, goal.cursor

    assert read(in_batches=True) == read(in_batches=False)
