"""`fibaction.wire.requests`: what a client asks for beside goals, through a session."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction.goals import CancelCode
from fibaction.states import GoalStatus
from fibaction.wire.messages import (
    Actions,
    AskPeers,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Finished,
    Following,
    GoalChanged,
    ListActions,
    Peers,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Why,
)
from tests.fibonacci import FIBONACCI
from tests.wire.bench import EXECUTING, GOAL, A, B, held, serving

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def test_a_canceled_goal_is_answered_and_ends() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        stamp = (await client.send(1)).stamp
        await client.say(CancelGoals(2, "fibonacci", A, None))
        heard = await client.hear_by_id()
        assert heard[2] == [CancelAnswered(2, 0, [(A, stamp, GoalStatus.CANCELING)], "")]
        assert heard[1] == [
            StatusChanged(1, GoalStatus.CANCELING),
            Ended(1, GoalStatus.CANCELED, None, "", 0),
        ]


async def test_a_cancel_of_all_by_time_that_finds_none_is_answered() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        answer = await client.ask(CancelGoals(2, "fibonacci", None, 1), CancelAnswered)
        assert answer == CancelAnswered(2, CancelCode.NONE, [], "")


async def test_what_is_served_is_listed() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        assert await client.ask(ListActions(1), Actions) == Actions(1, [FIBONACCI.info])


async def test_statuses_are_told_as_far_as_there_is_credit() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        stamp = (await client.send(1)).stamp
        assert await client.ask(WatchStatus(2, "fibonacci", 1), Watching) == Watching(2, 1)
        who = client.session.client.name
        assert await client.hear(GoalChanged) == GoalChanged(2, A, stamp, EXECUTING, 0, 0, who)
        await client.say(CancelGoals(3, "fibonacci", A, None))
        assert 2 not in await client.hear_by_id()
        await client.say(Credit(2, 5))
        assert [message.status for message in await client.hear_all()] == [3, 5]


async def test_who_uses_an_action_is_told() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        assert client.session.client.actions == set()
        answer = await client.ask(AskPeers(2, "fibonacci"), Peers)
        assert answer == Peers(2, ["who uses fibonacci"])
        assert client.session.client.actions == {"fibonacci"}


async def test_a_client_that_wants_no_more_statuses_is_told_that_there_are_none() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.ask(WatchStatus(2, "fibonacci", 1), Watching)
        assert await client.ask(Close(2), Finished) == Finished(2)


async def test_a_close_while_statuses_wait_for_credit_ends_them() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.send(1, A)
        await client.send(2, B)
        await client.ask(WatchStatus(3, "fibonacci", 1), Watching)
        assert [type(message) for message in await client.hear_all()] == [GoalChanged]
        await client.say(Close(3))
        assert await client.hear_all() == [Finished(3)]


async def test_statuses_end_when_the_server_stops() -> None:
    server = held()
    async with serving(server) as bench:
        client = await bench.greet()
        await client.ask(WatchStatus(2, "fibonacci", 1), Watching)
        await server.stop()
        assert await client.hear(Finished) == Finished(2)


async def test_a_client_is_told_when_the_server_is_there() -> None:
    server = held()
    async with serving() as bench:
        bench.endpoints["fibonacci"] = server
        client = await bench.greet()
        await client.say(AwaitServer(1, "fibonacci"), AwaitServer(2, "fibonacci"))
        assert await client.hear_all() == []
        await client.say(Close(1))
        assert await client.hear_all() == []
        async with server:
            assert await client.hear(Done) == Done(2)
            assert await client.hear_all() == []


async def test_an_answer_over_the_clients_limit_fails_that_request_only() -> None:
    async with serving(held()) as bench:
        client = await bench.greet(max_frame=150)
        for number in range(10):
            await client.say(SendGoal(number, "fibonacci", bytes([number + 1] * 16), GOAL, None))
            await client.hear(Following)
        await client.say(CancelGoals(50, "fibonacci", None, None), ListActions(51))
        heard = await client.hear_by_id()
        for request in (50, 51):
            (failed,) = heard[request]
            assert (type(failed), failed.why) == (Failed, Why.LIMIT)
        await client.ask(AwaitServer(52, "fibonacci"), Done)
