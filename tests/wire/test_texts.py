"""Texts of a peer: errors quote them on one printable line, and reasons have a limited length."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from fibaction._runtime.text import LENGTH, REASON
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    CancelAnswered,
    CancelGoals,
    Ended,
    Failed,
    Follow,
    GoalChanged,
    Goodbye,
    Received,
    Rejected,
    SendGoal,
    Why,
    encode,
)
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    GoalRejected,
    ProtocolError,
    ServerNotFound,
)
from fibaction.words.statuses import GoalStatus
from tests.wire import memory
from tests.wire.ends import (
    GOAL,
    GOAL_ID,
    ONCE,
    A,
    endpoint_of,
    goal_of,
    held,
    outcome_of,
    reached,
    serving,
    watched,
)
from tests.wire.memory import LONG, Running

pytestmark = pytest.mark.anyio

NASTY = "\nWARNING root: forged\x1b[2J\u2028\u202e" * 10**4
"""A text that is long, and that would be several lines of a log, or orders to a terminal."""


CUT = NASTY[: REASON - 1] + "…"


def is_excerpt(text: str, length: int) -> bool:
    """Return whether a text quotes the nasty one, in its length at most, with 100 of its own."""
    return text.isprintable() and "\\x0aWARNING root: forged" in text and len(text) < length + 100


@pytest.mark.parametrize(
    ("answer", "kind", "length"),
    [
        (lambda call: Rejected(call, NASTY), GoalRejected, REASON),
        (lambda call: Failed(call, Why.SERVER_NOT_FOUND, NASTY), ServerNotFound, REASON),
        (lambda call: Goodbye(NASTY, Why.FORBIDDEN), AuthenticationFailed, LENGTH),
    ],
)
async def test_an_error_of_a_server_is_one_line(
    answer: Callable[[int], Any], kind: type[ActionError], length: int
) -> None:
    async with reached(settings=ONCE) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, GOAL)) as sending:
            await server.say(answer((await server.hear(SendGoal)).id))
            with pytest.raises(kind) as caught:
                await sending.answer()
    assert is_excerpt(str(caught.value), length)
    assert getattr(caught.value, "reason", CUT) == CUT


async def test_reasons_of_outcomes_and_cancels_are_cut() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call):
            await server.say(Ended(call, GoalStatus.ABORTED, None, NASTY, 0))
            assert (await outcome_of(goal)).reason == CUT
            assert (await server.hear(Received)).id == call
        async with Running(lambda: endpoint_of(connection).cancel_goals(GOAL_ID)) as asking:
            call = (await server.hear(CancelGoals)).id
            await server.say(CancelAnswered(call, 1, [], NASTY))
            assert (await asking.answer()).reason == CUT


async def test_the_name_of_a_client_is_one_line() -> None:
    async with reached() as (connection, server):
        statuses, call = await watched(connection, server)
        await server.say(GoalChanged(call, A, 1, GoalStatus.EXECUTING, 0, 0, NASTY))
        assert is_excerpt((await statuses.receive()).client, LENGTH)


async def test_a_server_quotes_the_name_of_an_action() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        failed = await client.ask(Follow(1, NASTY, A, None, False, 1), Failed)
    assert failed.text.isprintable()
    assert len(failed.text) < 2 * LENGTH


async def test_the_error_that_ended_a_connection_does_not_keep_a_message() -> None:
    end, other = memory.pair()
    link = Link(end, LONG)

    def handle(frame: bytes) -> None:
        raise ProtocolError("invalid")

    await other.send([encode(Goodbye("x"))])
    error = await link.run(handle)

    assert type(error) is ProtocolError
    assert error.__traceback__ is None
