"""`fibaction.wire.session`: a real server behind a session, and messages made by hand."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any, get_args

import anyio
import pytest
from anyio.abc import ByteStream, TaskGroup
from hypothesis import given
from hypothesis import strategies as st

from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    LimitReached,
    ProtocolError,
    UnknownGoal,
)
from fibaction.goals import GoalID
from fibaction.server import ActionServer
from fibaction.server.feedback_log import FeedbackCursor
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import AccessPolicy, Peer, Permission
from fibaction.wire.channel import Channel, StreamChannel
from fibaction.wire.errors import failed
from fibaction.wire.framing import header
from fibaction.wire.messages import (
    VERSION,
    AskPeers,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Follow,
    Following,
    FromClient,
    Goodbye,
    Hello,
    ListActions,
    Ping,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    WatchStatus,
    Welcome,
    Why,
    decode_from_server,
    encode,
)
from fibaction.wire.session import Session
from fibaction.wire.settings import Limits, ServerSettings
from fibaction.wire.subscriptions import PIECE
from fibaction.wire.wire_server import WireServer
from tests import fibonacci as fib
from tests.fibonacci import FIBONACCI
from tests.virtual_time import in_virtual_time
from tests.wire import memory
from tests.wire.bench import (
    ANN,
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    A,
    B,
    Client,
    feedback,
    held,
    scripted,
    serving,
)
from tests.wire.memory import LONG, Running, logged, settled

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def closes(client: Client, goodbye: Goodbye, error: type[ActionError]) -> None:
    """The session ends like that, and with nothing else."""
    assert await client.hear(Goodbye) == goodbye
    await client.hear_the_end()
    assert type(client.error) is error
    prefix = "" if goodbye.why == Why.FORBIDDEN else "the server has closed the connection: "
    assert goodbye.reason == f"{prefix}{client.error}"


def over(text: str) -> Goodbye:
    return Goodbye(f"the server has closed the connection: {text}", Why.PROTOCOL)


# The handshake


@pytest.mark.parametrize(
    "message",
    [ListActions(1), Ping(), Goodbye("early")],
    ids=lambda message: type(message).__name__,
)
async def test_a_client_that_does_not_say_hello_first_is_told_so(message: Any) -> None:
    async with serving(held()) as bench:
        client = await bench.connect()
        await client.say(message)
        name = type(message).__name__
        await closes(client, over(f"its first message was a {name}, not a Hello"), ProtocolError)


async def test_a_client_of_another_version_is_told_so() -> None:
    async with serving(held()) as bench:
        client = await bench.connect()
        await client.say(Hello(2, LONG))
        text = "it speaks version 2 of the protocol, and this is 1"
        await closes(client, over(text), ProtocolError)


async def test_a_client_that_says_hello_twice_is_told_so() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.say(Hello(VERSION, LONG))
        await closes(client, over("it said hello twice"), ProtocolError)


async def test_a_client_that_is_let_in_ends_its_older_connections() -> None:
    access = AccessPolicy(tokens={"secret": "ann"})
    async with serving(held(), access=access) as bench:
        stranger = await bench.connect()
        await stranger.say(Hello(VERSION, LONG, "guess", ANN))
        await stranger.hear(Goodbye)
        await stranger.hear_the_end()
        assert bench.superseded == []
        nameless = await bench.connect()
        await nameless.say(Hello(VERSION, LONG, "secret"))
        await nameless.hear(Welcome)
        assert bench.superseded == []
        client = await bench.connect()
        await client.say(Hello(VERSION, LONG, "secret", ANN))
        await client.hear(Welcome)
        assert bench.superseded == [ANN]


async def test_a_session_that_is_ended_leaves_its_goals_to_the_next_at_once() -> None:
    async with serving(giving(*feedback(1), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.send(1)
        assert isinstance((await client.hear_all())[-1], Ended)
        client.session.end()
        assert client.session._goals._open == {}
        assert bench.orphans.is_own(GoalID(A), ANN)
        again = await bench.greet()
        await again.ask(follow(0), Following)
        await client.hear_the_end()
        assert str(client.error) == "its client has a newer connection"
        assert [type(message) for message in await again.hear_all()] == [Feedback, Ended]


async def test_another_goal_under_the_id_of_one_whose_end_was_lost_is_rejected() -> None:
    async with serving(giving(*feedback(1), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.send(1)
        client.channel.cut()
        again = await bench.greet()
        other = FIBONACCI.goal.encode(fib.Goal(99))
        rejected = await again.ask(SendGoal(2, "fibonacci", A, other, ANY), Rejected)
        assert rejected.reason == "its ID is in use by another goal"
        await again.ask(follow(0), Following)
        assert [type(message) for message in await again.hear_all()] == [Feedback, Ended]


async def test_a_client_that_says_nothing_in_time_is_told_so_and_may_try_again() -> None:
    async with serving(held(), limits=Limits(handshake=0.01)) as bench:
        client = await bench.connect()
        text = "the server has closed the connection: it has not said hello within 0.01 s"
        assert await client.hear(Goodbye) == Goodbye(text, Why.LIMIT)
        await client.hear_the_end()
        assert isinstance(client.error, LimitReached)  # which is a warning in the log


@in_virtual_time()
async def test_a_client_that_said_hello_in_time_is_left_in_peace() -> None:
    async with serving(held(), limits=Limits(handshake=5)) as bench:
        client = await bench.greet()
        await anyio.sleep(60)
        assert await client.is_served()


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        ("", "the server asks for a token, and the client gave none"),
        ("wrong", "the server rejected the client's token"),
        ("rigt", "the server rejected the client's token"),
        ("right ", "the server rejected the client's token"),
    ],
)
async def test_a_client_without_the_right_token_is_told_so(token: str, reason: str) -> None:
    async with serving(held(), access=AccessPolicy({"right": "ann"})) as bench:
        client = await bench.connect()
        await client.say(Hello(VERSION, LONG, token), ListActions(1))
        await closes(client, Goodbye(reason, Why.FORBIDDEN), AuthenticationFailed)


async def test_what_is_no_message_ends_the_session_with_the_reason() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.channel.send([b"\xc1"])
        goodbye = await client.hear(Goodbye)
        assert goodbye.why == Why.PROTOCOL
        assert "invalid client message" in goodbye.reason
        await client.hear_the_end()


async def test_a_client_that_leaves_is_not_answered() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.say(Goodbye("I am done"))
        await client.hear_the_end()
        assert isinstance(client.error, ConnectionLost)
        assert str(client.error) == "the client left: I am done"


async def test_a_client_that_is_lost_ends_its_session() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        client.channel.cut()
        await settled()
        assert isinstance(client.error, ConnectionLost)


@in_virtual_time()
async def test_a_client_is_given_the_time_that_it_asks_for_between_signs_of_life() -> None:
    async with serving(held()) as bench:
        client = await bench.connect()
        await client.ask(Hello(VERSION, LONG / 2), Welcome)
        await anyio.sleep(LONG * 1.5)
        assert client.error is None
        await anyio.sleep(LONG * 2)
        assert isinstance(client.error, ConnectionLost)
        assert "has been silent for" in str(client.error)


async def test_a_sign_of_life_has_no_answer() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.say(Ping())
        assert await client.hear_all() == []
        assert await client.is_served()


# Goals


async def test_a_goal_is_told_from_its_acceptance_to_its_end() -> None:
    async with serving(scripted(*feedback(1, 2), fib.Result([3]))) as bench:
        client = await bench.greet()
        following = await client.send(1, credit=5)
        assert (following.status, following.latest, following.place) == (1, False, 0)
        for number in (1, 2):
            payload = FIBONACCI.feedback.encode(fib.Feedback([number]))
            assert await client.hear(Feedback) == Feedback(1, number, payload)
        result = FIBONACCI.result.encode(fib.Result([3]))
        assert await client.hear(Ended) == Ended(1, GoalStatus.SUCCEEDED, result, "", 2)
        assert await client.hear_all() == []


async def test_a_goal_that_is_rejected_is_told_with_the_reason() -> None:
    async with serving(scripted(GoalRejected("no arm"))) as bench:
        client = await bench.greet()
        message = SendGoal(1, "fibonacci", A, GOAL, 1)
        assert await client.ask(message, Rejected) == Rejected(1, "no arm")


async def test_a_goal_of_the_wrong_type_is_rejected_and_the_session_goes_on() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        answer = await client.ask(SendGoal(1, "fibonacci", A, b"\xc1", 1), Rejected)
        assert answer.reason
        assert await client.is_served()


async def test_a_goal_of_which_only_the_end_is_wanted_is_told_no_more() -> None:
    async with serving(scripted(*feedback(1, 2), fib.Result([3]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=None)
        assert (await client.hear(Ended)).status == GoalStatus.SUCCEEDED


async def test_a_goal_is_followed_from_the_place_that_is_asked_for() -> None:
    go = anyio.Event()
    async with serving(scripted(*feedback(1, 2, 3), go, fib.Result([4]))) as bench:
        sender, other = await bench.greet(), await bench.greet()
        await sender.send(1)
        assert len(await sender.hear_all()) == 3
        following = await other.ask(Follow(5, "fibonacci", A, 1, False, ANY), Following)
        assert (following.status, following.place) == (EXECUTING, 1)
        assert [(await other.hear(Feedback)).number for _ in range(2)] == [2, 3]
        go.set()
        assert (await other.hear(Ended)).id == 5
        assert (await sender.hear(Ended)).id == 1


async def test_a_goal_that_nobody_knows_cannot_be_followed() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        failed = await client.ask(Follow(1, "fibonacci", B, None, True, 1), Failed)
        assert (failed.id, failed.why) == (1, Why.UNKNOWN_GOAL)
        assert B.hex() in failed.text


async def test_an_action_that_is_not_served_is_told_with_those_that_are() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        failed = await client.ask(SendGoal(1, "swim", A, GOAL, 1), Failed)
        text = "nobody serves the action 'swim' here: there is 'fibonacci'"
        assert failed == Failed(1, Why.SERVER_NOT_FOUND, text)


async def test_where_nothing_is_served_that_is_what_is_told() -> None:
    async with serving() as bench:
        client = await bench.greet()
        failed = await client.ask(WatchStatus(1, "swim", 1), Failed)
        assert failed.text == "nobody serves the action 'swim' here: there is nothing"


async def test_a_goal_of_a_server_that_has_stopped_is_not_found() -> None:
    server = held()
    async with serving(server) as bench:
        client = await bench.greet()
        await server.stop()
        failed = await client.ask(SendGoal(1, "fibonacci", A, GOAL, 1), Failed)
        assert failed.why == Why.SERVER_NOT_FOUND


# Credit


async def test_no_more_feedback_comes_than_there_is_credit_for() -> None:
    async with serving(scripted(*feedback(1, 2, 3, 4, 5), fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=2)
        assert [message.number for message in await client.hear_all()] == [1, 2]
        await client.say(Credit(1, 2))
        assert [message.number for message in await client.hear_all()] == [3, 4]
        await client.say(Credit(1, 0))
        assert await client.hear_all() == []
        await client.say(Credit(1, ANY), Credit(1, ANY))
        assert [type(message) for message in await client.hear_all()] == [Feedback, Ended]


async def test_credit_for_a_wait_that_has_not_begun_counts() -> None:
    go = anyio.Event()
    async with serving(scripted(go, *feedback(1, 2, 3), fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        await client.say(Credit(1, 1))
        await settled()
        go.set()
        assert [message.number for message in await client.hear_all()] == [1, 2]


async def test_credit_for_feedback_that_waits_while_the_goal_goes_on_lets_it_come() -> None:
    async with serving(scripted(*feedback(1, 2, 3), anyio.Event())) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert [message.number for message in await client.hear_all()] == [1]
        await client.say(Credit(1, 1))
        assert [message.number for message in await client.hear_all()] == [2]


async def test_a_status_comes_without_credit() -> None:
    async with serving(scripted(*feedback(1, 2), anyio.Event())) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert (await client.hear(Feedback)).number == 1
        await client.say(CancelGoals(2, "fibonacci", A, None))
        heard = await client.hear_by_id()
        assert heard[1] == [StatusChanged(1, GoalStatus.CANCELING)]


async def test_the_end_waits_for_credit_while_feedback_is_left() -> None:
    async with serving(scripted(*feedback(1, 2), fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert [type(message) for message in await client.hear_all()] == [Feedback]
        await client.say(Credit(1, 2))
        assert [type(message) for message in await client.hear_all()] == [Feedback, Ended]


async def test_the_end_does_not_wait_for_credit_when_no_feedback_is_left() -> None:
    async with serving(scripted(*feedback(1), fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert [type(message) for message in await client.hear_all()] == [Feedback, Ended]


async def test_a_client_that_wants_no_more_is_told_the_end() -> None:
    go = anyio.Event()
    async with serving(scripted(*feedback(1, 2, 3), go, fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert [message.number for message in await client.hear_all()] == [1]
        await client.say(Close(1))
        assert await client.hear_all() == []
        go.set()
        assert [type(message) for message in await client.hear_all()] == [Ended]


async def test_a_client_that_wants_no_more_before_the_answer_is_told_the_end() -> None:
    decide = anyio.Event()

    async def on_goal(goal: fib.Goal) -> None:
        await decide.wait()

    async with serving(ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY), Close(1))
        assert await client.hear_all() == []
        decide.set()
        assert [type(message) for message in await client.hear_all()] == [Following, Ended]


async def test_credit_for_nothing_and_a_close_of_nothing_are_ignored() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.say(Credit(7, 1), Close(7))
        assert await client.hear_all() == []
        assert await client.is_served()


# The end, and who has heard of it


def giving(*items: fib.Feedback | fib.Result, **settings: Any) -> ActionServer[Any, Any, Any]:
    """A server whose goals give that at once."""

    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        for item in items:
            yield item

    return ActionServer(FIBONACCI, executor, **settings)


def follow(after: int | None, *, own: bool = True, request: int = 1) -> Follow:
    return Follow(request, "fibonacci", A, after, own, ANY)


@pytest.mark.parametrize("credit", [None, ANY])
async def test_a_goal_is_kept_until_its_client_has_heard_the_end(credit: int | None) -> None:
    async with serving(scripted(*feedback(1), fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1, credit=credit)
        assert isinstance((await client.hear_all())[-1], Ended)
        assert list(client.session._goals._open) == [1]
        assert bench.orphans.is_own(GoalID(A), ANN)
        await client.say(Received(1))
        assert await client.hear_all() == []
        assert client.session._goals._open == {}
        assert not bench.orphans.is_own(GoalID(A), ANN)
        await client.send(1, B)  # and the ID can be used again


async def test_a_goal_that_is_observed_is_kept_for_nobody() -> None:
    go = anyio.Event()
    async with serving(scripted(go, fib.Result([]))) as bench:
        client, other = await bench.greet(ANN), await bench.greet(BOB)
        await client.send(1)
        for own in (False, True):  # whatever it says of itself
            await other.ask(follow(0, own=own, request=5 + own), Following)
        go.set()
        assert len(await other.hear_by_id()) == 2
        assert other.session._goals._open == {}
        await other.say(Received(5), Received(6))
        assert await other.is_served()
        assert list(client.session._goals._open) == [1]


async def test_who_only_looks_on_may_go_before_the_end() -> None:
    async with serving(scripted(anyio.Event(), fib.Result([]))) as bench:
        client, other = await bench.greet(ANN), await bench.greet(BOB)
        await client.send(1)
        for request in (5, 6):
            await other.ask(follow(0, own=False, request=request), Following)
        await other.say(Close(5), Received(5))
        assert await other.is_served()
        assert list(other.session._goals._open) == [6]
        await other.ask(follow(0, own=False, request=5), Following)  # the ID can be used again


async def test_who_only_looks_on_may_go_before_the_answer() -> None:
    decided = anyio.Event()

    async def authorize(_peer: Peer, _action: str, verb: Permission) -> bool:
        if verb is Permission.OBSERVE:
            await decided.wait()
        return True

    access = AccessPolicy(authorize=authorize)
    async with serving(held(), access=access) as bench:
        client, other = await bench.greet(ANN), await bench.greet(BOB)
        await client.send(1)
        await other.say(follow(0, own=False, request=5), Received(5))
        assert await other.is_served()
        decided.set()
        assert await other.hear_all() == []
        assert other.session._goals._open == {}


async def test_what_is_received_before_the_end_or_of_nothing_is_ignored() -> None:
    go = anyio.Event()
    async with serving(scripted(go, fib.Result([]))) as bench:
        client = await bench.greet()
        await client.send(1)
        await client.say(Received(1), Received(7), AwaitServer(8, "fibonacci"), Received(8))
        assert await client.hear_all() == [Done(8)]
        go.set()
        assert [type(message) for message in await client.hear_all()] == [Ended]
        assert list(client.session._goals._open) == [1]
        await client.say(Received(1), Received(1))
        assert await client.is_served()


async def test_goals_whose_ends_are_received_leave_nothing_behind() -> None:
    async with serving(giving(*feedback(1, 2), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        for number in range(1, 300):
            await client.say(SendGoal(number, "fibonacci", number.to_bytes(16, "big"), GOAL, ANY))
            while not isinstance(await client.hear(object), Ended):
                pass
            await client.say(Received(number))
        assert await client.is_served()
        session, orphans = client.session, bench.orphans
        assert (session._goals._open, session._goals._ready, session._goals._held) == ({}, {}, 0)
        assert orphans._owned == {}


@pytest.mark.parametrize("result_timeout", [10, 0])
async def test_an_end_that_was_lost_with_the_line_is_told_again(result_timeout: float) -> None:
    result = fib.Result([3])
    async with serving(giving(*feedback(1, 2), result, result_timeout=result_timeout)) as bench:
        client = await bench.greet()
        await client.send(1)
        (*_, ended) = await client.hear_all()
        for _ in range(3):  # it may be lost again
            client.channel.cut()
            client = await bench.greet()
            following = await client.ask(follow(2), Following)
            assert (following.status, following.place) == (GoalStatus.SUCCEEDED, 2)
            assert await client.hear_all() == [ended]
        assert ended == Ended(
            1, GoalStatus.SUCCEEDED, FIBONACCI.result.encode(fib.Result([3])), "", 2
        )
        await client.say(Received(1))
        assert await client.is_served()
        assert bench.orphans._owned == {}


@pytest.mark.parametrize(
    "result_timeout",
    [
        10,
        0,
    ],
)
async def test_feedback_that_was_lost_with_the_line_is_told_again(result_timeout: float) -> None:
    server = giving(*feedback(1, 2, 3), fib.Result([4]), result_timeout=result_timeout)
    async with serving(server) as bench:
        client = await bench.greet()
        await client.send(1)
        assert isinstance((await client.hear_all())[-1], Ended)
        client.channel.cut()
        again = await bench.greet()
        assert (await again.ask(follow(1), Following)).place == 1
        heard = await again.hear_all()
        assert [message.number for message in heard[:-1]] == [2, 3]
        assert isinstance(heard[-1], Ended)


@pytest.mark.parametrize("result_timeout", [10, 0])
async def test_a_goal_that_is_sent_again_after_it_has_ended_runs_once(
    result_timeout: float,
) -> None:
    runs: list[bytes] = []

    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        runs.append(goal.goal_id)
        yield fib.Feedback([1])
        yield fib.Result([2])

    async with serving(ActionServer(FIBONACCI, executor, result_timeout=result_timeout)) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        client.channel.cut()  # with the answer, and all that came behind it
        again = await bench.greet()
        following = await again.ask(SendGoal(1, "fibonacci", A, GOAL, ANY), Following)
        assert following.place == 0
        assert [type(message) for message in await again.hear_all()][-2:] == [Feedback, Ended]
        assert runs == [A]
        await again.say(Received(1))
        assert await again.is_served()
        assert bench.orphans._owned == {}


async def test_an_end_that_was_lost_is_told_once_to_a_client_that_follows_its_goal_twice() -> None:
    async with serving(giving(*feedback(1), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.send(1)
        client.channel.cut()
        again = await bench.greet()
        await again.say(follow(0), follow(0, request=2))
        heard = await again.hear_by_id()
        told, refused = sorted(heard.values(), key=len, reverse=True)
        assert [type(message) for message in told] == [Following, Feedback, Ended]
        assert [message.why for message in refused] == [Why.UNKNOWN_GOAL]


@pytest.mark.parametrize("after", [2, 3, 99])
async def test_of_a_goal_that_was_sent_twice_each_call_goes_on_behind_what_it_had(
    after: int,
) -> None:
    """What is kept for the client is the stream of the second, which had one message only."""
    async with serving(giving(*feedback(1, 2, 3), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.send(1, credit=0)
        await client.say(SendGoal(2, "fibonacci", A, GOAL, 1))
        await client.hear_all()
        client.channel.cut()
        again = await bench.greet()
        assert (await again.ask(follow(after), Following)).place == min(after, 3)
        heard = await again.hear_all()
        assert [one.number for one in heard[:-1]] == list(range(after + 1, 4))
        assert isinstance(heard[-1], Ended)


async def test_of_a_goal_that_was_sent_twice_both_calls_go_on_and_on_the_next_connection_too() -> (
    None
):
    first, second = anyio.Event(), anyio.Event()
    steps = [first, *feedback(1), second, *feedback(2), fib.Result([])]
    async with serving(scripted(*steps)) as bench:
        client = await bench.greet()
        await client.send(1)
        await client.ask(SendGoal(2, "fibonacci", A, GOAL, ANY), Following)
        first.set()
        heard = await client.hear_by_id()
        assert [[one.number for one in heard[call]] for call in (1, 2)] == [[1], [1]]
        client.channel.cut()
        again = await bench.greet()
        await again.say(follow(1, request=1), follow(1, request=2))
        await again.hear_by_id()
        second.set()
        heard = await again.hear_by_id()
        for call in (1, 2):
            told, ended = heard[call]
            assert (told.number, ended.status, ended.place) == (2, GoalStatus.SUCCEEDED, 2)


@pytest.mark.parametrize("result_timeout", [10, 0])
async def test_feedback_that_there_was_no_credit_for_is_told_on_the_next_connection(
    result_timeout: float,
) -> None:
    server = giving(*feedback(1, 2, 3), fib.Result([4]), result_timeout=result_timeout)
    async with serving(server) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        assert [message.number for message in await client.hear_all()] == [1]
        client.channel.cut()
        again = await bench.greet()
        assert (await again.ask(follow(1), Following)).place == 1
        assert [type(message) for message in await again.hear_all()] == [Feedback, Feedback, Ended]


@in_virtual_time()
@pytest.mark.parametrize("result_timeout", [10, 0])
async def test_an_end_that_is_not_fetched_again_is_kept_as_long_as_a_client_has_to_come_back(
    result_timeout: float,
) -> None:
    async with serving(
        giving(*feedback(1), fib.Result([]), result_timeout=result_timeout), grace=50
    ) as bench:
        client = await bench.greet()
        await client.send(1)
        assert isinstance((await client.hear_all())[-1], Ended)
        client.channel.cut()
        await anyio.sleep(49)
        again = await bench.greet()
        assert (await again.ask(follow(1), Following)).status == GoalStatus.SUCCEEDED
        assert [type(message) for message in await again.hear_all()] == [Ended]
        again.channel.cut()
        await anyio.sleep(51)
        late = await bench.greet()
        assert (await late.ask(follow(1), Failed)).why == Why.UNKNOWN_GOAL


async def test_a_client_that_wants_no_old_feedback_is_told_the_end_that_was_lost() -> None:
    async with serving(giving(*feedback(1), fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.send(1)
        assert isinstance((await client.hear_all())[-1], Ended)
        client.channel.cut()
        again = await bench.greet()
        assert (await again.ask(follow(None), Following)).place == 1
        assert [type(message) for message in await again.hear_all()] == [Ended]


async def test_an_end_that_was_lost_is_told_to_nobody_else() -> None:
    async with serving(giving(fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet(ANN)
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await client.hear_all()
        client.channel.cut()
        for other in (await bench.greet(BOB), await bench.greet(b"")):
            assert (await other.ask(follow(0), Failed)).why == Why.UNKNOWN_GOAL
        ann = await bench.greet(ANN)
        assert (await ann.ask(follow(0, own=False), Failed)).why == Why.UNKNOWN_GOAL
        assert (await ann.ask(follow(0, request=2), Following)).status == GoalStatus.SUCCEEDED


async def test_who_has_left_is_told_no_end_again() -> None:
    async with serving(giving(fib.Result([]), result_timeout=0)) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await client.hear_all()
        await client.say(Goodbye("I know enough"))
        await client.hear_the_end()
        assert bench.orphans._owned == {}


# What is larger than the client takes


LARGE = fib.Result([0] * 1000)


async def test_a_result_over_the_clients_limit_fails_that_goal_and_no_other() -> None:
    go = anyio.Event()
    server = ScriptedServer(
        FIBONACCI, [*feedback(1), go, LARGE], [*feedback(1), go, *feedback(2), fib.Result([])]
    )
    async with serving(server) as bench:
        client = await bench.greet(max_frame=500)
        await client.send(1, A)
        await client.hear(Feedback)
        await client.send(2, B)
        await client.hear(Feedback)
        go.set()
        heard = await client.hear_by_id()
        size = len(encode(Ended(1, GoalStatus.SUCCEEDED, FIBONACCI.result.encode(LARGE), "", 1)))
        text = f"the answer has {size} bytes, and 500 are the limit"
        assert heard[1] == [Failed(1, Why.LIMIT, text)]
        assert [type(message) for message in heard[2]] == [Feedback, Ended]
        assert await client.is_served()


async def test_a_goal_whose_result_could_not_be_told_is_not_kept() -> None:
    async with serving(giving(LARGE)) as bench:
        client = await bench.greet(max_frame=500)
        await client.say(SendGoal(1, "fibonacci", A, GOAL, None))
        await client.hear(Following)
        await client.hear(Failed)
        assert await client.is_served()
        assert client.session._goals._open == {}


async def test_feedback_over_the_clients_limit_is_left_out_and_the_goal_goes_on() -> None:
    large = fib.Feedback([0] * 1000)
    async with serving(giving(*feedback(1), large, *feedback(3), large, fib.Result([]))) as bench:
        client = await bench.greet(max_frame=500)
        await client.send(1, credit=2)
        assert [message.number for message in await client.hear_all()] == [1, 3]
        await client.say(Credit(1, 1))  # for what comes behind; it takes credit to find out
        result = FIBONACCI.result.encode(fib.Result([]))
        assert await client.hear_all() == [Ended(1, GoalStatus.SUCCEEDED, result, "", 4)]


async def test_a_refusal_is_no_larger_than_the_client_takes() -> None:
    async with serving(scripted(GoalRejected("x" * 1000))) as bench:
        client = await bench.greet(max_frame=500)
        await client.say(SendGoal(1, "fibonacci", A, GOAL, 1))
        (answer,) = await client.hear_all()
        assert len(encode(answer)) <= 500


async def test_a_server_says_how_much_it_takes() -> None:
    async with serving(held(), limits=Limits(frame=1234)) as bench:
        client = await bench.connect()
        welcome = await client.ask(Hello(VERSION, LONG, "", ANN), Welcome)
        assert welcome.max_frame == 1234


# Each in its turn


async def test_a_goal_with_endless_feedback_does_not_delay_another() -> None:
    async def endless(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        while goal.request.order:
            yield fib.Feedback([0] * 1000)  # a piece of it fills a write
        yield fib.Result([])

    async with serving(ActionServer(FIBONACCI, endless, feedback_window=1000)) as bench:
        client = await bench.greet()
        client.channel.stop_reading()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        few = FIBONACCI.goal.encode(fib.Goal(0))
        await client.say(SendGoal(2, "fibonacci", B, few, ANY))
        await settled()
        client.channel.go_on_reading()
        before = 0
        with anyio.fail_after(5):
            while not isinstance(message := await client.hear(object), Ended):
                before += isinstance(message, Feedback) and message.id == 1
        assert message.id == 2
        # One piece before each message of the other goal, and what was on its way before.
        assert PIECE < before <= 6 * PIECE


@pytest.mark.parametrize("count", [2, 20])
async def test_goals_with_as_much_to_tell_take_turns(count: int) -> None:
    piece = [fib.Feedback([0] * 1000)] * PIECE
    server = giving(*piece * 8, fib.Result([]), feedback_window=1000)
    async with serving(server) as bench:
        client = await bench.greet()
        client.channel.stop_reading()
        for number in range(count):
            goal_id = bytes([number + 1] * 16)
            await client.say(SendGoal(number, "fibonacci", goal_id, GOAL, ANY))
        await settled()
        client.channel.go_on_reading()
        told = dict.fromkeys(range(count), 0)
        spread = 0
        for message in await client.hear_all():
            if isinstance(message, Feedback):
                told[message.id] += 1
                spread = max(spread, max(told.values()) - min(told.values()))
        assert set(told.values()) == {8 * PIECE}
        # The first is some turns ahead: one that was being written, and two in which those that
        # came after it were told only that they are followed, and executing.
        assert spread <= 4 * PIECE


async def test_what_there_is_to_tell_waits_where_it_is_made() -> None:
    async def endless(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        while True:
            yield fib.Feedback([0] * 1000)

    async with serving(ActionServer(FIBONACCI, endless, feedback_window=10)) as bench:
        client = await bench.greet()
        client.channel.stop_reading()
        for number in range(20):
            goal_id = bytes([number + 1] * 16)
            await client.say(SendGoal(number, "fibonacci", goal_id, GOAL, ANY))
        await settled()
        assert client.session._link._queued == 0
        assert len(client.session._goals._open) == 20
        assert not client.session._link._queue


# Who a client is


async def test_a_client_is_known_by_the_name_of_its_token_and_its_address() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        assert client.session.client.name == "the client"
    async with serving(held(), access=AccessPolicy({"sesame": "ann"})) as bench:
        client = await bench.greet(token="sesame")
        assert client.session.client.name == "ann at the client"


# Access

REQUESTS: dict[Permission, list[Any]] = {
    Permission.SEND: [SendGoal(1, "fibonacci", A, GOAL, 1)],
    Permission.CANCEL: [
        CancelGoals(1, "fibonacci", A, None),
        CancelGoals(1, "fibonacci", None, None),
    ],
    Permission.OBSERVE: [
        Follow(1, "fibonacci", A, None, False, 1),
        Follow(1, "fibonacci", A, None, True, 1),
        WatchStatus(1, "fibonacci", 1),
        AwaitServer(1, "fibonacci"),
    ],
}


class Untouched(Endpoint):
    """Nobody may ask it for anything."""

    @property
    def info(self) -> Any:
        raise AssertionError

    async def send_goal(self, *args: Any, **kwargs: Any) -> Any:
        raise AssertionError

    async def feedback(self, *args: Any, **kwargs: Any) -> Any:
        raise AssertionError

    async def cancel_goals(self, *args: Any, **kwargs: Any) -> Any:
        raise AssertionError

    async def status(self) -> Any:
        raise AssertionError

    async def wait_for_server(self) -> None:
        raise AssertionError


@pytest.mark.parametrize(
    ("verb", "message"),
    [(verb, message) for verb, messages in REQUESTS.items() for message in messages],
    ids=lambda value: getattr(value, "name", None) or type(value).__name__,
)
async def test_what_is_not_allowed_is_refused_and_the_endpoint_not_asked(
    verb: Permission, message: Any
) -> None:
    asked = []

    def authorize(peer: Peer, action: str, wanted: Permission) -> bool:
        asked.append((peer, action, wanted))
        return wanted is not verb

    access = AccessPolicy({"secret": "ann"}, authorize)
    async with serving(access=access) as bench:
        bench.endpoints["fibonacci"] = Untouched()
        client = await bench.greet(token="secret")
        failed = await client.ask(message, Failed)
        text = f"this client may not {verb.value} at the action 'fibonacci'"
        assert failed == Failed(1, Why.FORBIDDEN, text)
        assert asked == [(Peer("the client", "ann"), "fibonacci", verb)]


async def test_whoever_may_not_do_anything_is_not_told_what_there_is() -> None:
    async with serving(access=AccessPolicy(authorize=lambda *_: False)) as bench:
        client = await bench.greet()
        failed = await client.ask(WatchStatus(1, "swim", 1), Failed)
        assert failed.why == Why.FORBIDDEN


async def test_what_is_allowed_is_done() -> None:
    async def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        await anyio.lowlevel.checkpoint()
        return verb is Permission.SEND

    async with serving(held(), access=AccessPolicy(authorize=authorize)) as bench:
        client = await bench.greet()
        await client.send(1)
        assert (await client.ask(AwaitServer(2, "fibonacci"), Failed)).why == Why.FORBIDDEN


async def test_whoever_may_only_send_may_follow_its_own_goal_again_and_nobody_elses() -> None:
    access = AccessPolicy(authorize=lambda _, __, verb: verb is Permission.SEND)
    async with serving(held(), access=access) as bench:
        client = await bench.greet(ANN)
        await client.send(1)
        client.channel.cut()
        bob, unnamed, ann = [await bench.greet(who) for who in (BOB, b"", ANN)]
        follow = Follow(1, "fibonacci", A, 0, True, 1)
        for other in (bob, unnamed):
            assert (await other.ask(follow, Failed)).why == Why.FORBIDDEN
        assert (await ann.ask(follow, Following)).status == EXECUTING


# What goes wrong


class Broken(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
    """A server with a bug."""

    async def status(self) -> Any:
        raise ValueError("a bug")


async def test_an_endpoint_that_raises_what_it_may_not_fails_that_request_only() -> None:
    async with serving(Broken(FIBONACCI, [anyio.Event()])) as bench:
        client = await bench.greet()
        with logged() as lines:
            failed = await client.ask(WatchStatus(1, "fibonacci", 1), Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, "the server failed: ValueError")
        (line,) = lines
        assert line.levelno == logging.ERROR
        assert line.exc_info is not None
        assert line.getMessage().startswith("the client: its WatchStatus failed")
        await client.send(1)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # trio's cannot be raised by hand
async def test_a_permission_that_awaits_what_somebody_has_canceled_is_a_refusal_only() -> None:
    async def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        await anyio.lowlevel.checkpoint()
        if verb is Permission.OBSERVE:
            raise anyio.get_cancelled_exc_class()
        return True

    async with serving(held(), access=AccessPolicy(authorize=authorize)) as bench:
        client = await bench.greet()
        with logged() as lines:
            failed = await client.ask(WatchStatus(1, "fibonacci", ANY), Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, "the server failed: CancelledError")
        (line,) = lines
        assert line.levelno == logging.ERROR
        assert line.getMessage().startswith("the client: its WatchStatus failed")
        await client.send(1)  # and the connection is as good as before


async def test_an_error_of_the_way_behind_is_told_as_a_lost_connection() -> None:
    class Away(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        async def status(self) -> Any:
            raise ConnectionLost("the robot is away")

    async with serving(Away(FIBONACCI, [anyio.Event()])) as bench:
        client = await bench.greet()
        failed = await client.ask(WatchStatus(1, "fibonacci", 1), Failed)
        assert failed == Failed(1, Why.CONNECTION_LOST, "the robot is away")


async def test_nothing_is_answered_after_the_end() -> None:
    class Late(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        async def status(self) -> Any:
            try:
                await anyio.sleep_forever()
            finally:
                raise ConnectionLost("too late")

    async with serving(Late(FIBONACCI, [anyio.Event()])) as bench:
        client = await bench.greet()
        await client.say(WatchStatus(1, "fibonacci", 1))
        await settled()
        await client.say(Hello(VERSION, LONG))
        await closes(client, over("it said hello twice"), ProtocolError)


async def test_a_reason_that_is_no_unicode_fails_that_request_only() -> None:
    # As `os.fsdecode` makes it of a file name that is no UTF-8.
    async with serving(scripted(GoalRejected("no file \udcff"))) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, 1))
        assert [message.id for message in await client.hear_all()] == [1]
        assert await client.is_served()


# Limits


@pytest.mark.parametrize(
    "message",
    [AwaitServer(1, "fibonacci"), ListActions(1), SendGoal(1, "fibonacci", A, GOAL, 1)],
    ids=lambda message: type(message).__name__,
)
async def test_an_id_that_is_in_use_ends_the_session(message: Any) -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.send(1)
        await client.say(message)
        await closes(client, over("it used the ID 1 twice"), ProtocolError)


async def test_an_id_that_was_answered_can_be_used_again() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        for _ in range(3):
            assert await client.is_served()


async def test_no_more_goals_are_taken_than_the_limit_and_more_once_one_has_ended() -> None:
    async with serving(held(), limits=Limits(goals=1, requests=7)) as bench:
        client = await bench.greet()
        await client.send(1, A)
        text = "too much at once: the limits of a connection are 1 goals and 7 other requests"
        rejected = await client.ask(SendGoal(2, "fibonacci", B, GOAL, 1), Rejected)
        assert rejected == Rejected(2, text)
        other = await bench.greet()
        await other.ask(CancelGoals(1, "fibonacci", A, None), CancelAnswered)
        assert [type(message) for message in await client.hear_all()] == [StatusChanged, Ended]
        # It is kept for a client that has not said that it knows.
        await client.ask(SendGoal(3, "fibonacci", B, GOAL, 1), Rejected)
        await client.say(Received(1))
        await client.send(3, B)


async def test_at_the_limit_of_goals_a_goal_can_still_be_canceled() -> None:
    async with serving(held(), limits=Limits(goals=1)) as bench:
        client = await bench.greet()
        await client.send(1)
        await client.say(CancelGoals(2, "fibonacci", A, None))
        assert [type(message) for message in (await client.hear_by_id())[2]] == [CancelAnswered]


async def test_goals_that_are_sent_at_once_do_not_pass_the_limit() -> None:
    async with serving(held(), limits=Limits(goals=2)) as bench:
        client = await bench.greet()
        await client.say(
            *(SendGoal(i, "fibonacci", bytes([i] * 16), GOAL, None) for i in range(1, 6))
        )
        kinds = [type(message) for message in await client.hear_all()]
        assert kinds.count(Following) == 2
        assert kinds.count(Rejected) == 3


async def test_no_more_requests_are_taken_than_the_limit() -> None:
    async with serving(limits=Limits(requests=2)) as bench:
        bench.endpoints["fibonacci"] = held()
        client = await bench.greet()
        await client.say(*(AwaitServer(i, "fibonacci") for i in range(1, 5)))
        heard = await client.hear_all()
        assert [(type(message), message.id, message.why) for message in heard] == [
            (Failed, 3, Why.LIMIT),
            (Failed, 4, Why.LIMIT),
        ]
        await client.say(Close(1))
        await settled()
        await client.say(AwaitServer(3, "fibonacci"))
        assert await client.hear_all() == []


async def test_goals_that_are_decided_upon_take_no_more_memory_than_the_limit() -> None:
    decide = anyio.Event()

    async def on_goal(goal: fib.Goal) -> None:
        await decide.wait()

    async def forever(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        await anyio.sleep_forever()
        yield fib.Result([])

    server = ActionServer(FIBONACCI, forever, on_goal=on_goal)
    async with serving(server, limits=Limits(memory=len(GOAL))) as bench:
        client, other = await bench.greet(), await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, None))
        assert await client.hear_all() == []
        rejected = await client.ask(SendGoal(2, "fibonacci", B, GOAL, None), Rejected)
        assert rejected == Rejected(2, f"too many bytes at once: the limit is {len(GOAL)}")
        await other.say(SendGoal(2, "fibonacci", B, GOAL, None))
        decide.set()
        await client.hear(Following)
        await other.hear(Following)
        await client.send(3, bytes([3] * 16), credit=None)


async def test_a_goal_whose_client_leaves_in_the_same_moment_is_not_undecided_for_ever() -> None:
    asked = 0

    async def on_goal(goal: fib.Goal) -> None:
        nonlocal asked
        asked += 1
        if asked == 1:
            await anyio.sleep_forever()

    async with serving(ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)) as bench:
        client, other = await bench.greet(), await bench.greet()
        # Both arrive at once, so the session is over before a task of its could wait for an answer.
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY), Goodbye("never mind"))
        await settled()
        assert str(client.error) == "the client left: never mind"
        await other.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        assert isinstance(await other.hear(Following), Following)
        assert asked == 2


@pytest.mark.parametrize("requests", [1, 1000], ids=["over the limit", "unknown goals"])
async def test_a_client_that_asks_and_does_not_read_fills_no_memory(requests: int) -> None:
    async with serving(held(), limits=Limits(requests=requests, queue=10_000)) as bench:
        client = await bench.greet()
        client.channel.stop_reading()
        for start in range(0, 4000, 100):
            await client.say(
                *(Follow(i, "fibonacci", B, None, False, 1) for i in range(start, start + 100))
            )
            await settled()
        # Twice the limit, a message that may go beyond it, and the one that was too much; the
        # connection has ended over that.
        answer = len(failed(4000, UnknownGoal(GoalID(B)), 10_000))
        assert client.session._link._queued <= 2 * 10_000 + 2 * answer


async def test_a_client_that_does_not_read_slows_itself_down_only() -> None:
    many = scripted(*(fib.Feedback([0] * 100) for _ in range(50)), fib.Result([]))
    async with serving(many, limits=Limits(queue=1000)) as bench:
        client, other = await bench.greet(), await bench.greet()
        client.channel.stop_reading()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        assert client.session._link._queued < 2000
        await other.send(1, B)
        assert isinstance((await other.hear_all())[-1], Ended)
        client.channel.go_on_reading()
        assert isinstance((await client.hear_all())[-1], Ended)


# Clients that are lost, and come back


@in_virtual_time()
async def test_the_goal_of_a_client_that_does_not_come_back_is_canceled() -> None:
    async with serving(held(), then="cancel", grace=10) as bench:
        client, other = await bench.greet(), await bench.greet()
        await client.send(1)
        client.channel.cut()
        await anyio.sleep(11)
        following = await other.ask(Follow(1, "fibonacci", A, None, False, 1), Following)
        assert following.status == GoalStatus.CANCELED


@in_virtual_time()
async def test_the_goal_of_a_client_that_comes_back_goes_on() -> None:
    async with serving(held(), then="cancel", grace=10) as bench:
        client = await bench.greet()
        await client.send(1)
        client.channel.cut()
        await anyio.sleep(5)
        again = await bench.greet()
        await again.ask(Follow(1, "fibonacci", A, 0, True, 1), Following)
        await anyio.sleep(60)
        assert await again.hear_all() == []


@in_virtual_time()
async def test_the_goal_of_a_client_that_sends_it_again_goes_on() -> None:
    async with serving(held(), then="cancel", grace=10) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, 1))
        await settled()
        client.channel.cut()
        await settled()
        again = await bench.greet()
        await again.ask(SendGoal(1, "fibonacci", A, GOAL, 1), Following)
        await anyio.sleep(60)
        assert await again.hear_all() == []


@in_virtual_time()
async def test_the_goal_of_a_client_that_is_back_before_its_loss_is_noticed_goes_on() -> None:
    async with serving(held(), then="cancel", grace=10) as bench:
        client = await bench.greet()
        await client.send(1)
        again = await bench.greet()
        await again.ask(Follow(1, "fibonacci", A, 0, True, 1), Following)
        client.channel.cut()
        await anyio.sleep(60)
        assert await again.hear_all() == []


async def test_a_goal_that_somebody_else_sends_too_stays_with_its_own_client() -> None:
    go = anyio.Event()
    async with serving(scripted(go, *feedback(1), fib.Result([]))) as bench:
        ann, bob = await bench.greet(ANN), await bench.greet(BOB)
        await ann.send(1)
        await bob.ask(SendGoal(1, "fibonacci", A, GOAL, ANY), Following)
        go.set()
        assert [type(message) for message in await ann.hear_all()] == [Feedback, Ended]


async def test_the_goal_of_a_client_that_leaves_is_canceled_at_once() -> None:
    async with serving(held(), then="cancel") as bench:
        client, other = await bench.greet(), await bench.greet()
        await client.send(1)
        await other.ask(Follow(1, "fibonacci", A, None, False, 1), Following)
        await client.say(Goodbye("done"))
        assert [message.status for message in await other.hear_all()] == [3, 5]


async def test_an_observer_that_is_lost_leaves_no_orphan() -> None:
    async with serving(held(), then="cancel", grace=0) as bench:
        client, other = await bench.greet(), await bench.greet()
        await client.send(1)
        await other.ask(Follow(1, "fibonacci", A, None, False, 1), Following)
        other.channel.cut()
        assert await client.hear_all() == []


# Leaving


async def test_a_session_that_is_drained_tells_the_ends_and_says_goodbye() -> None:
    server = scripted(*feedback(1, 2), anyio.Event())
    async with serving(server) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        await client.hear(Feedback)
        await server.stop()
        async with Running(client.session.drain) as draining:
            assert not draining.is_done
            assert await client.hear_all() == []
            await client.say(Credit(1, 2))
            await draining.answer()
        assert [type(message) for message in await client.hear_all()] == [Feedback, Ended, Goodbye]


async def test_a_session_that_is_drained_does_not_wait_for_goals_that_go_on() -> None:
    async with serving(held()) as bench:
        client = await bench.greet()
        await client.send(1)
        with anyio.fail_after(5):
            await client.session.drain()
        assert await client.hear(Goodbye) == Goodbye("the server is closing the connection")


async def test_a_session_that_is_drained_does_not_wait_for_a_client_that_is_lost() -> None:
    server = scripted(*feedback(1, 2), fib.Result([]))
    async with serving(server) as bench:
        client = await bench.greet()
        await client.send(1, credit=1)
        await client.hear(Feedback)
        async with Running(client.session.drain) as draining:
            client.channel.cut()
            await draining.answer()


# A connection that ends in the middle of something


class Slow(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
    """A server that takes its time, and notes who has waited in vain."""

    def __init__(self, *, shielded: bool = False) -> None:
        super().__init__(FIBONACCI, [anyio.Event()])
        self.go = anyio.Event()
        self.shielded = shielded
        self.given_up = 0
        self.asked = 0

    async def pause(self) -> None:
        self.asked += 1
        try:
            with anyio.CancelScope(shield=self.shielded):
                await self.go.wait()
        except BaseException:
            self.given_up += 1
            raise

    def offer_goal(self, *args: Any, **kwargs: Any) -> Any:
        async def answer() -> Any:
            await self.pause()
            return ScriptedServer.offer_goal(self, *args, **kwargs)

        return answer()

    async def feedback(self, *args: Any, **kwargs: Any) -> Any:
        await self.pause()
        return await super().feedback(*args, **kwargs)


@pytest.mark.parametrize("message", [SendGoal(1, "fibonacci", A, GOAL, 1), follow(0)], ids=type)
@pytest.mark.parametrize("begun", [True, False])
async def test_what_is_being_answered_when_the_connection_ends_is_given_up(
    message: Any, begun: bool
) -> None:
    server = Slow()
    async with serving(server) as bench:
        client = await bench.greet()
        await client.say(message)
        if begun:
            await settled()
            assert server.asked == 1
        client.channel.cut()
        await settled()
        assert isinstance(client.error, ConnectionLost)
        assert server.given_up == server.asked
        assert client.session._goals._held == 0
        assert bench.orphans._owned == {}


async def test_a_decision_that_the_end_of_the_connection_cut_off_is_made_anew() -> None:
    asked = 0
    decide = anyio.Event()

    async def on_goal(goal: fib.Goal) -> None:
        nonlocal asked
        asked += 1
        await decide.wait()

    async with serving(ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        assert asked == 1
        client.channel.cut()
        await settled()
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        assert asked == 2
        decide.set()
        await client.hear(Following)


async def test_a_permission_that_the_end_of_the_connection_cut_off_sends_nothing() -> None:
    allow = anyio.Event()

    async def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        await allow.wait()
        return True

    server = scripted(anyio.Event())
    async with serving(server, access=AccessPolicy(authorize=authorize)) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        client.channel.cut()
        await settled()
        allow.set()
        await settled()
        assert server.received == []
        assert client.session._goals._held == 0


@in_virtual_time()
async def test_a_goal_that_is_accepted_while_the_connection_ends_is_an_orphan() -> None:
    server = Slow(shielded=True)
    async with serving(server, then="cancel", grace=10) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        client.channel.cut()
        await settled()
        server.go.set()
        await settled()
        assert isinstance(client.error, ConnectionLost)
        assert bench.orphans.is_own(GoalID(A), ANN)
        again = await bench.greet()
        stream = await server.feedback(GoalID(A))
        await anyio.sleep(11)
        assert stream.status is GoalStatus.CANCELED
        assert await again.is_served()


async def test_a_refusal_after_the_connection_has_ended_is_told_to_nobody() -> None:
    class Unsure(Slow):
        def offer_goal(self, *args: Any, **kwargs: Any) -> Any:
            async def answer() -> Any:
                await self.pause()
                raise GoalRejected("no arm")

            return answer()

    server = Unsure(shielded=True)
    async with serving(server) as bench:
        client = await bench.greet()
        await client.say(SendGoal(1, "fibonacci", A, GOAL, ANY))
        await settled()
        client.channel.cut()
        await settled()
        assert not client.session._link.is_open
        server.go.set()
        await settled()
        assert isinstance(client.error, ConnectionLost)
        assert client.session._goals._open == {}
        assert client.session._link._queued == 0


async def test_a_stream_that_fails_is_told_and_the_session_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(stream: FeedbackCursor, limit: int = 1) -> Any:
        raise ValueError("a bug")

    async with serving(held()) as bench:
        client = await bench.greet()
        await client.send(1)
        monkeypatch.setattr(
            FeedbackCursor, "take", fails
        )  # as that of an endpoint of somebody else's
        with logged():
            await client.say(Credit(1, 1))
            failed = await client.hear(Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, "the server failed: ValueError")
        assert client.session._goals._open == {}
        assert await client.is_served()


async def test_a_connection_that_is_lost_leaves_no_listener_behind() -> None:
    server = held()
    async with serving(server) as bench:
        client, other = await bench.greet(ANN), await bench.greet(BOB)
        await client.send(1)
        await other.ask(follow(0, own=False), Following)
        streams = [one.session._goals._open[1].stream for one in (client, other)]
        for one in (client, other):
            one.channel.cut()
        await settled()
        for stream in streams:
            assert stream is not None
            assert stream.news.on_next is None


# Anything at all


class Chunks(ByteStream):
    """Bytes that arrive in pieces; what is sent is lost."""

    def __init__(self, chunks: list[bytes]) -> None:
        self._chunks = chunks

    async def receive(self, max_bytes: int = 65536) -> bytes:
        await anyio.lowlevel.checkpoint()
        if not self._chunks:
            raise anyio.EndOfStream
        return self._chunks.pop(0)

    async def send(self, item: bytes) -> None:
        await anyio.lowlevel.checkpoint()

    async def send_eof(self) -> None:
        raise AssertionError

    async def aclose(self) -> None:
        await anyio.lowlevel.checkpoint()


class Neighbours:
    """A hub with a good client, and a bad one."""

    limits = Limits(goals=3, requests=4, memory=1000, frame=1000, queue=5000)

    def __init__(self, hub: WireServer, tasks: TaskGroup) -> None:
        self._hub = hub
        self._tasks = tasks

    async def good(self) -> Client:
        end, other = memory.pair("the good one")
        self._tasks.start_soon(self._hub.serve, end)
        await settled()
        (session,) = self._hub._sessions
        client = Client(other, session)
        await client.ask(Hello(VERSION, LONG), Welcome)
        return client

    async def serve(self, channel: Channel) -> None:
        """Serve the bad one to its end, which must be an end in good order."""
        with anyio.fail_after(5):
            await self._hub.serve(channel)

    def start(self, channel: Channel) -> None:
        self._tasks.start_soon(self._hub.serve, channel)

    def session(self, but: Session) -> Session | None:
        """The bad one's session, as long as it goes on."""
        return next((one for one in self._hub._sessions if one is not but), None)


@asynccontextmanager
async def neighbours() -> AsyncGenerator[Neighbours, None]:
    server = ActionServer(FIBONACCI, fib.fibonacci, feedback_window=4, shutdown_timeout=0.5)
    async with server, Background() as tasks:
        terms = ServerSettings(LONG, AccessPolicy(), Neighbours.limits, "keep", LONG)
        hub = WireServer(tasks, {"fibonacci": server}, terms)
        yield Neighbours(hub, tasks)


numbers = st.integers(0, 4) | st.just(2**63 - 1)
actions = st.sampled_from(["fibonacci", "fibonacci", "swim", ""])
goal_ids = st.sampled_from([bytes(16), A, B, bytes([3] * 16), bytes([4] * 16)])
goals = st.integers(-1, 9).map(lambda order: FIBONACCI.goal.encode(fib.Goal(order)))
credits_ = st.sampled_from([0, 1, 2, 2**31 - 1])
wanted = st.none() | credits_
MESSAGES: dict[type, st.SearchStrategy[Any]] = {
    Hello: st.builds(
        Hello,
        st.sampled_from([1, 2]),
        st.just(LONG),
        st.text(max_size=3),
        st.sampled_from([b"", ANN, BOB]),
    ),
    SendGoal: st.builds(
        SendGoal, numbers, actions, goal_ids, goals | st.binary(max_size=400), wanted
    ),
    Follow: st.builds(
        Follow, numbers, actions, goal_ids, st.none() | numbers, st.booleans(), wanted
    ),
    CancelGoals: st.builds(
        CancelGoals, numbers, actions, st.none() | goal_ids, st.none() | numbers
    ),
    WatchStatus: st.builds(WatchStatus, numbers, actions, credits_),
    AwaitServer: st.builds(AwaitServer, numbers, actions),
    ListActions: st.builds(ListActions, numbers),
    Credit: st.builds(Credit, numbers, credits_),
    Close: st.builds(Close, numbers),
    Received: st.builds(Received, numbers),
    AskPeers: st.builds(AskPeers, numbers, actions),
    Ping: st.builds(Ping),
    Goodbye: st.builds(Goodbye, st.text(max_size=3), st.integers(0, 9)),
}
requests = st.one_of(
    *(strategy for kind, strategy in MESSAGES.items() if kind not in (Hello, Goodbye))
)
sequences = st.lists(requests | requests | st.one_of(*MESSAGES.values()), max_size=30)


def test_every_message_of_a_client_has_a_strategy() -> None:
    assert set(MESSAGES) == set(get_args(FromClient))


def chopped(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
    return [data[one:other] for one, other in pairwise(places)]


def framed(frames: list[bytes]) -> bytes:
    return b"".join(header(len(frame)) + frame for frame in frames)


hello = encode(Hello(VERSION, LONG, session=ANN))
valid = MESSAGES[SendGoal].map(encode) | requests.map(encode)
almost = st.builds(
    lambda frame, place, byte: frame[:place] + bytes([byte]) + frame[place + 1 :],
    valid,
    st.integers(0, 20),
    st.integers(0, 255),
)
"""A message with one byte changed."""
streams = st.binary(max_size=60) | st.builds(
    lambda frames, rest: framed([hello, *frames]) + rest,
    st.lists(valid | almost | st.binary(max_size=20), max_size=10),
    st.binary(max_size=10),
)


def one_line(lines: list[logging.LogRecord], peer: str) -> str:
    """The one line that tells of a peer, which it names once; without the name."""
    (line,) = [line for line in lines if peer in line.getMessage()]
    assert line.exc_info is None
    before, after = line.getMessage().split(peer)
    return before + after


async def is_unharmed(good: Client) -> None:
    """Its session is as good as before."""
    goal_id = GoalID.random()
    await good.send(1, goal_id)
    for _ in range(2):
        await good.hear(Feedback)
    assert (await good.hear(Ended)).status == GoalStatus.SUCCEEDED
    assert await good.is_served()


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
@given(data=streams, cuts=st.lists(st.integers(0, 300), max_size=10))
def test_any_bytes_end_their_own_session_only_and_in_one_line(
    backend: str, data: bytes, cuts: list[int]
) -> None:
    async def check() -> None:
        async with neighbours() as both:
            good = await both.good()
            stream = Chunks(chopped(data, cuts))
            with logged() as lines:
                await both.serve(StreamChannel(stream, "the bad one", Neighbours.limits.frame))
            assert one_line(lines, "the bad one").strip(": ")
            await is_unharmed(good)

    anyio.run(check, backend=backend)


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
@given(messages=sequences, batches=st.integers(1, 30), reads=st.booleans())
def test_any_messages_in_any_order_harm_their_own_session_at_most(
    backend: str, messages: list[Any], batches: int, reads: bool
) -> None:
    async def check() -> None:
        limits = Neighbours.limits
        async with neighbours() as both:
            good = await both.good()
            end, other = memory.pair("the bad one")
            both.start(end)
            if not reads:
                other.stop_reading()
            bad = memory.Peer(other, decode_from_server)
            with logged() as lines:
                try:
                    await bad.say(Hello(VERSION, LONG, session=ANN))
                    for start in range(0, len(messages), batches):
                        await bad.say(*messages[start : start + batches])
                        await settled()
                        session = both.session(but=good.session)
                        if session is not None:
                            assert len(session._goals._open) <= limits.goals
                            assert len(session._waiting) <= limits.requests
                            assert set(session._goals._ready) <= set(session._goals._open.values())
                            assert session._goals._held <= limits.memory
                except ConnectionLost:
                    pass
                other.go_on_reading()
                other.cut()
                await settled()
                assert both.session(but=good.session) is None
            assert one_line(lines, "the bad one").strip(": ")
            await is_unharmed(good)

    anyio.run(check, backend=backend)
