"""Goals that move from one connection of a client to another, whose servers share their goals."""

from __future__ import annotations

import itertools
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from fibaction.border.abc import GoalRequest
from fibaction.border.event_loop import Background
from fibaction.wire.client.connection import RemoteConnection, new_session
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.messages import (
    Credit,
    Ended,
    Failed,
    Feedback,
    Follow,
    ListActions,
    Received,
    SendGoal,
    Why,
)
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ServerFailed,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.words.goals import UNKNOWN_OUTCOME, Outcome
from tests.wire.ends import (
    GOAL_ID,
    PATIENT,
    SUCCEEDED,
    WINDOW,
    A,
    Network,
    following,
    numbers_of,
    outcome_of,
)
from tests.wire.memory import Peer, Running, settled

pytestmark = pytest.mark.anyio

ENDED = Outcome(SUCCEEDED, b"result", "")
GONE = ConnectionLost("the worker is gone")


class Client:
    """A client with a connection to each of two servers."""

    def __init__(self, tasks: Any) -> None:
        self.networks = Network(), Network()
        self.lost: list[tuple[RemoteGoal, ActionError]] = []
        session, ids = new_session(), itertools.count(1)
        self.one, self.other = (
            RemoteConnection(network.dial, "memory", PATIENT, session=session, ids=ids)
            for network in self.networks
        )
        for connection in (self.one, self.other):
            tasks.start_soon(connection.run)

    def lose(self, goal: RemoteGoal, error: ActionError) -> None:
        self.lost.append((goal, error))

    async def send(self, server: Peer) -> RemoteGoal:
        """A goal that the first server has accepted."""

        async def send() -> RemoteGoal:
            request = GoalRequest(GOAL_ID, b"goal")
            return await self.one.calls.send("fibonacci", request, on_lost=self.lose)

        async with Running(send) as sending:
            await server.say(following(await server.hear(SendGoal)))
            goal: RemoteGoal = await sending.answer()
            return goal

    async def observe(self, server: Peer) -> RemoteGoal:
        """A goal of another client."""

        async def observe() -> RemoteGoal:
            return await self.one.calls.follow(
                GOAL_ID,
                lambda call_id, window: Follow(call_id, "fibonacci", A, None, False, window),
                on_lost=self.lose,
            )

        async with Running(observe) as asking:
            await server.say(following(await server.hear(Follow)))
            goal: RemoteGoal = await asking.answer()
            return goal


@asynccontextmanager
async def two_servers() -> AsyncGenerator[tuple[Client, Peer, Peer], None]:
    async with Background() as tasks:
        client = Client(tasks)
        one, other = [await network.accept() for network in client.networks]
        await settled()
        yield client, one, other


async def test_a_goal_goes_on_elsewhere_behind_its_last_feedback() -> None:
    async with two_servers() as (client, one, other):
        goal = await client.send(one)
        await one.say(Feedback(goal.id, 1, b""), Feedback(goal.id, 2, b""))
        assert await numbers_of(goal, 1) == [1]
        client.one.end(GONE)
        assert client.lost == [(goal, GONE)]
        assert client.one.calls.is_empty
        goal.lost_at = 1.0
        client.other.calls.adopt(goal, client.lose)
        asked = await other.hear(Follow)
        assert asked == Follow(goal.id, "fibonacci", A, 2, True, WINDOW - 1, 1)
        await other.say(following(asked, place=2), *(Feedback(goal.id, n, b"") for n in (3, 4)))
        assert await numbers_of(goal, 3) == [2, 3, 4]
        assert goal.lost_at is None
        assert await other.hear(Credit) == Credit(goal.id, 2)  # and not to the first one
        await other.say(Ended(goal.id, SUCCEEDED, b"result", "", 4))
        assert await outcome_of(goal) == ENDED
        assert await other.hear(Received) == Received(goal.id)
        assert (goal.dropped, client.other.calls.is_empty) == (0, True)


@pytest.mark.parametrize("moves", [False, True])
async def test_the_end_is_noted_for_its_first_server_only(moves: bool) -> None:
    async with two_servers() as (client, server, other):
        ended: list[str] = []
        goal = await client.send(server)
        goal.when_ended(lambda: ended.append("at the first"))
        if moves:
            client.one.end(GONE)
            client.other.calls.adopt(goal, client.lose)
            server = other
            await server.say(following(await server.hear(Follow)))
        await server.say(Ended(goal.id, SUCCEEDED, b"result", "", 0))
        assert await outcome_of(goal) == ENDED
        assert ended == ([] if moves else ["at the first"])


@pytest.mark.parametrize(
    ("why", "error"),
    [
        (Why.CONNECTION_LOST, ConnectionLost),
        (Why.SERVER_NOT_FOUND, ServerNotFound),
        (Why.UNKNOWN_GOAL, UnknownGoal),
    ],
)
async def test_a_goal_that_its_server_does_not_have_any_more_is_lost(
    why: int, error: type[ActionError]
) -> None:
    async with two_servers() as (client, one, _):
        goal = await client.send(one)
        await one.say(Failed(goal.id, why, "not here"))
        await settled()
        assert [(lost, type(reason)) for lost, reason in client.lost] == [(goal, error)]
        assert client.one.calls.is_empty


async def test_a_goal_whose_server_has_a_bug_is_not_lost_but_fails() -> None:
    async with two_servers() as (client, one, _):
        goal = await client.send(one)
        await one.say(Failed(goal.id, Why.SERVER_FAILED, "a bug"))
        with pytest.raises(ServerFailed):
            await outcome_of(goal)
        assert not client.lost


async def test_a_goal_of_another_client_moves_as_an_observer() -> None:
    async with two_servers() as (client, one, other):
        goal = await client.observe(one)
        client.one.end(GONE)
        client.lost.clear()
        client.other.calls.adopt(goal, client.lose)
        asked = await other.hear(Follow)
        assert asked.own is False
        await other.say(following(asked))
        await settled()
        assert not client.other.calls.is_empty
        call_id = goal.id
        del goal  # nobody follows it any more
        assert await other.hear(Received) == Received(call_id)
        assert client.other.calls.is_empty


async def test_a_goal_that_was_closed_while_it_was_lost_asks_for_the_end_only() -> None:
    async with two_servers() as (client, one, other):
        goal = await client.send(one)
        client.one.end(GONE)
        goal.close()
        client.other.calls.adopt(goal, client.lose)
        asked = await other.hear(Follow)
        assert asked.credit is None


async def test_what_was_not_answered_can_be_ended_alone() -> None:
    async with two_servers() as (client, one, _):
        goal = await client.send(one)
        async with Running(client.one.actions) as asking:
            await one.hear(ListActions)
            client.one.calls.fail_unanswered(GONE)
            with pytest.raises(ConnectionLost, match="the worker is gone"):
                await asking.answer()
        await one.say(Ended(goal.id, SUCCEEDED, b"result", "", 0))
        assert await outcome_of(goal) == ENDED


async def test_a_lost_goal_can_be_finished_in_another_attempt() -> None:
    async with two_servers() as (client, one, _):
        goal = await client.send(one)
        await one.say(Feedback(goal.id, 1, b""))
        await settled()
        client.one.end(GONE)
        goal.finish(UNKNOWN_OUTCOME, 2, 3)
        assert await numbers_of(goal) == [1]
        assert (goal.attempt, goal.dropped) == (3, 2)
