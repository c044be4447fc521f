"""What the client's half does for its caller: a real client, and a server whose messages are made
by a test.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction.border.abc import Connection, GoalRequest
from fibaction.wire.client.connection import open_connection
from fibaction.wire.client.open_calls import BURST, OpenCalls
from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.messages import (
    VERSION,
    AwaitServer,
    Close,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    Goodbye,
    ListActions,
    Ping,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Welcome,
    Why,
)
from fibaction.wire.settings import ClientSettings, Limits
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    InvalidMessage,
    InvalidURL,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from tests.support.virtual_time import in_virtual_time
from tests.wire.ends import (
    AWAY,
    CALLS,
    GOAL,
    GOAL_ID,
    ONCE,
    PATIENT,
    SUCCEEDED,
    WHERE,
    WINDOW,
    Network,
    endpoint_of,
    following,
    goal_of,
    is_used,
    numbers_of,
    observed,
    outcome_of,
    reached,
    real,
    update_of,
)
from tests.wire.memory import LONG, Apart, MemoryChannel, Running, settled

pytestmark = pytest.mark.anyio

Call = Callable[[Connection], Awaitable[Any]]
every_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


async def fails_at_once(connection: Connection, error: type[ActionError]) -> str:
    """All calls do, and with the same text, which it gives."""
    texts = set()
    for call in CALLS.values():
        with anyio.fail_after(0.1), pytest.raises(error) as caught:
            await call(connection)
        assert type(caught.value) is error
        texts.add(str(caught.value))
    (text,) = texts
    return text


async def cannot_connect(
    network: Network, error: type[ActionError], settings: ClientSettings = PATIENT
) -> str:
    """The first attempt fails, and there is no other; gives the text."""
    with anyio.fail_after(60), pytest.raises(error) as caught:
        async with open_connection(network.dial, WHERE, settings):
            raise AssertionError
    assert type(caught.value) is error
    assert network.dialed == 1
    return str(caught.value)


def end(call_id: int, place: int = 0) -> Ended:
    return Ended(call_id, SUCCEEDED, b"result", "", place)


# The handshake


async def test_the_first_message_names_the_client_on_each_connection() -> None:
    network = Network()
    settings = ClientSettings(heartbeat=LONG, token="s3cret", limits=Limits(frame=1234))
    assert "s3cret" not in repr(settings)
    hellos = []

    async def accept() -> None:
        for _ in range(2):
            server, hello = await network.reached()
            hellos.append(hello)
            await server.say(Welcome(VERSION, LONG))
            await settled()
            server.channel.cut()

    async with Running(accept) as accepting:
        async with open_connection(network.dial, WHERE, settings):
            await accepting.answer()
    assert hellos[0] == hellos[1]
    hello = hellos[0]
    assert (hello.version, hello.heartbeat, hello.token) == (VERSION, LONG, "s3cret")
    assert hello.max_frame == 1234
    assert len(hello.session) >= 16


HINT = ": give one as token=, or in the URL as ?token="
UNEXPECTED = f"{WHERE}: a Welcome of version 2 was not expected"
TOO_EARLY = f"{WHERE}: the first message was a Done, not a Welcome"
STARTS: dict[str, tuple[Any, str, type[ActionError], str]] = {
    "no token": (Goodbye("no", Why.FORBIDDEN), "", AuthenticationFailed, f"{WHERE}: no{HINT}"),
    "token": (Goodbye("no", Why.FORBIDDEN), "s3cret", AuthenticationFailed, f"{WHERE}: no"),
    "a goodbye": (Goodbye("no", Why.PROTOCOL), "", ProtocolError, f"{WHERE}: no"),
    "another version": (Welcome(2, LONG), "", ProtocolError, UNEXPECTED),
    "no welcome": (Done(1), "", ProtocolError, TOO_EARLY),
}


@pytest.mark.parametrize(("message", "token", "error", "text"), STARTS.values(), ids=STARTS)
async def test_a_server_that_begins_otherwise_is_left_for_good(
    message: Any, token: str, error: type[ActionError], text: str
) -> None:
    network = Network()
    settings = msgspec.structs.replace(PATIENT, token=token)
    async with Running(lambda: network.answer(message)) as answering:
        assert await cannot_connect(network, error, settings) == text
        assert (await answering.answer()).channel.is_cut


# Before there is a connection


async def answer_the_wait(network: Network, waiting: Running) -> None:
    """Take the next connection in, and answer who waits for the server."""
    server = await network.accept()
    asked = await server.hear(AwaitServer)
    assert asked.action == "fibonacci"
    await server.say(Done(asked.id))
    await waiting.answer()


@in_virtual_time()
async def test_an_attempt_that_hangs_has_five_seconds() -> None:
    network = Network()
    network.hangs = True
    start = anyio.current_time()
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        assert anyio.current_time() - start == pytest.approx(5)
        text = await fails_at_once(connection, ServerNotFound)
        assert text == f"{WHERE} did not answer within 5 s"
        network.hangs = False
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            await answer_the_wait(network, waiting)


@in_virtual_time()
async def test_a_server_that_does_not_answer_the_hello_is_lost() -> None:
    settings = ClientSettings(heartbeat=1, reconnect=False)
    text = await cannot_connect(Network(), ConnectionLost, settings)
    assert text == f"{WHERE} has been silent for 4.5 s"
    assert anyio.current_time() < 6


@in_virtual_time()
async def test_attempts_are_made_for_as_long_as_it_takes_and_not_too_often() -> None:
    network = Network()
    network.refusal = AWAY
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            await anyio.sleep(0.2)
            assert network.dialed >= 4
            await anyio.sleep(3600)
            assert 1800 <= network.dialed <= 3700
            assert not waiting.is_done
            absence = endpoint_of(connection).absence
            assert absence is not None
            assert absence.reason == str(AWAY)
            network.refusal = None
            await answer_the_wait(network, waiting)
        assert endpoint_of(connection).absence is None
        await settled()
        async with Running(connection.actions) as asking:
            assert not asking.is_done


async def test_a_wait_for_the_server_ends_where_too_many_requests_are_open() -> None:
    async with reached() as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            asked = await server.hear(AwaitServer)
            await server.say(Failed(asked.id, Why.LIMIT, "too much at once"))
            with pytest.raises(LimitReached, match="too much at once"):
                await waiting.answer()


async def test_a_wait_for_the_server_goes_on_while_the_server_is_full() -> None:
    network = Network()
    full = Goodbye("the server is full", Why.LIMIT)
    async with Running(lambda: network.answer(full)):
        async with open_connection(network.dial, WHERE, PATIENT) as connection:
            async with Running(endpoint_of(connection).wait_for_server) as waiting:
                assert not waiting.is_done
                await answer_the_wait(network, waiting)


# Calls


async def test_a_call_that_is_alone_is_sent_at_once_and_those_beside_it_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[bool] = []
    wake = MemoryChannel.wake_writer

    def noted(channel: MemoryChannel, *, at_once: bool = False) -> None:
        told.append(at_once)
        wake(channel, at_once=at_once)

    monkeypatch.setattr(MemoryChannel, "wake_writer", noted)
    async with reached() as (connection, server):
        told.clear()
        before = len(server.channel.writes)
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(connection.actions)
            assert len(await server.hear_all()) == 3
            assert told == [True, False, False]
            assert len(server.channel.writes) == before + 1
            tasks.cancel_scope.cancel()


# What `Failed` says, by its number; and of a goal, where that differs.
FAILURES: list[tuple[int, type[ActionError], type[ActionError]]] = [
    (Why.UNKNOWN_GOAL, ServerFailed, UnknownGoal),
    (Why.SERVER_NOT_FOUND, ServerNotFound, ServerNotFound),
    (Why.CONNECTION_LOST, ConnectionLost, ConnectionLost),
    (Why.FORBIDDEN, AuthenticationFailed, AuthenticationFailed),
    (Why.LIMIT, LimitReached, LimitReached),
    (Why.PROTOCOL, ProtocolError, ProtocolError),
    (Why.TRANSPORT, TransportError, TransportError),
    (Why.SERVER_FAILED, ServerFailed, ServerFailed),
    (Why.INVALID_MESSAGE, InvalidMessage, InvalidMessage),
    (Why.INVALID_URL, InvalidURL, InvalidURL),
    (0, ConnectionLost, ConnectionLost),
    (99, ConnectionLost, ConnectionLost),
]


@pytest.mark.parametrize(("why", "kind", "of_a_goal"), FAILURES)
async def test_each_number_of_a_failure_is_an_error_and_the_call_is_over(
    why: int, kind: type[ActionError], of_a_goal: type[ActionError]
) -> None:
    async with reached() as (connection, server):
        for name in ("actions", "cancel_goals", "status", "send_goal", "feedback"):
            async with Running(partial(CALLS[name], connection)) as asking:
                (asked,) = await server.hear_all()
                await server.say(Failed(asked.id, why, "for a reason"))
                with pytest.raises(ActionError) as caught:
                    await asking.answer()
            is_of_a_goal = name in ("send_goal", "feedback")
            assert type(caught.value) is (of_a_goal if is_of_a_goal else kind)
            if isinstance(caught.value, UnknownGoal):
                assert caught.value.goal_id == GOAL_ID
            else:
                assert str(caught.value) == "for a reason"
            assert await server.hear_all() == []


@pytest.mark.parametrize(
    "answer", [Done(1), Rejected(1, "no"), Following(1, 1, GoalStatus.ACCEPTED, False, 0)], ids=type
)
async def test_an_answer_of_the_wrong_kind_is_an_error_of_that_call(answer: Any) -> None:
    async with reached() as (connection, server):
        async with Running(connection.actions) as asking:
            assert (await server.hear(ListActions)).id == 1
            await server.say(answer)
            name = type(answer).__name__
            with pytest.raises(ProtocolError, match=f"^a {name} does not answer what was asked$"):
                await asking.answer()
        await is_used(connection, server)


@every_call
async def test_a_call_that_is_given_up_is_closed(call: Call) -> None:
    async with reached() as (connection, server):
        async with Running(lambda: call(connection)):
            (asked,) = await server.hear_all()
        closing = Received if isinstance(asked, Follow) else Close
        assert await server.hear_all() == [closing(asked.id)]


async def test_a_goal_that_is_given_up_before_its_answer_is_ignored_but_for_its_end() -> None:
    async with reached() as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")):
            sent = await server.hear(SendGoal)
        assert await server.hear_all() == [Close(sent.id)]
        await server.say(following(sent), Feedback(sent.id, 1, b""), end(sent.id, 1))
        assert await server.hear_all() == [Received(sent.id)]
        await is_used(connection, server)


async def test_signs_of_life_and_answers_to_no_call_are_ignored() -> None:
    async with reached() as (connection, server):
        await server.say(Ping(), Done(77), end(78))
        assert await server.hear_all() == [Received(78)]  # so that nothing is kept for it
        await is_used(connection, server)


@pytest.mark.parametrize(
    "call",
    [
        lambda connection: connection.peers("no text \udcff"),
        lambda connection: endpoint_of(connection).get_result(cast("GoalID", object())),
        lambda connection: endpoint_of(connection).send_goal(cast("GoalID", 2**70), b"goal"),
    ],
)
async def test_arguments_that_cannot_be_sent_are_an_error_of_that_call_only(call: Call) -> None:
    async with reached() as (connection, server):
        with anyio.fail_after(5), pytest.raises(InvalidMessage, match="the message cannot be sent"):
            await call(connection)
        await is_used(connection, server)


@in_virtual_time()
async def test_a_request_that_no_server_can_read_is_not_asked_for_ever() -> None:
    async with real(anyio.Event()) as endpoint:
        with anyio.fail_after(2), pytest.raises(ProtocolError):
            await endpoint.cancel_goals(cast("GoalID", b"short"))


# A goal


async def test_a_goal_without_feedback_asks_for_none_and_need_not_be_closed() -> None:
    async with reached() as (connection, server):
        endpoint = endpoint_of(connection)
        sending = Running(lambda: endpoint.send_goal(GOAL_ID, b"goal", feedback=False))
        async with sending:
            sent = await server.hear(SendGoal)
            assert sent.credit is None
            await server.say(following(sent), StatusChanged(sent.id, GoalStatus.CANCELING))
            goal = await sending.answer()
        await settled()
        assert goal.status is GoalStatus.CANCELING
        assert await numbers_of(goal) == []
        goal.hold(False)
        goal.close()
        await server.say(end(sent.id, 9))
        assert (await outcome_of(goal)).status is SUCCEEDED
        assert await server.hear_all() == [Received(sent.id)]


async def test_a_stream_that_is_closed_gives_the_outcome_only_and_says_so_once() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(Feedback(call_id, 1, b"1"))
            async with Running(lambda: numbers_of(goal)) as reading:
                with goal:
                    pass
                goal.close()
                assert await reading.answer() in ([], [1])
            assert await server.hear_all() == [Close(call_id)]
            canceling = StatusChanged(call_id, GoalStatus.CANCELING)
            await server.say(Feedback(call_id, 2, b"2"), canceling)
            await settled()
            assert await numbers_of(goal) == []
            assert goal.status is GoalStatus.CANCELING
            await server.say(end(call_id, 2))
            assert await update_of(goal) == await outcome_of(goal)
            assert (await outcome_of(goal)).result == b"result"
            assert await server.hear_all() == [Received(call_id)]


@pytest.mark.parametrize("why", [Why.LIMIT, Why.SERVER_NOT_FOUND, Why.UNKNOWN_GOAL])
async def test_a_goal_that_fails_gives_what_has_come_before(why: int) -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(Feedback(call_id, 1, b"1"), Failed(call_id, why, "for a reason"))
            assert await server.hear_all() == []  # there is no end to have heard of
            assert await numbers_of(goal, 1) == [1]
            if why == Why.UNKNOWN_GOAL:  # the server has forgotten it
                assert (await outcome_of(goal)).status is goal.status is GoalStatus.UNKNOWN
                assert await numbers_of(goal) == []
                return
            errors = []
            for wait in (outcome_of, outcome_of, numbers_of):
                with pytest.raises(TransportError, match=r"^for a reason$") as caught:
                    await wait(goal)
                errors.append(caught.value)
            assert {type(error) for error in errors} == {
                LimitReached if why == Why.LIMIT else ServerNotFound
            }
            assert len(set(map(id, errors))) == 3  # each raised for itself


def ended_as(status: GoalStatus, call_id: int) -> Ended:
    return Ended(call_id, status, None, "", 0)


UNFIT: dict[str, tuple[bool, Callable[[int], Any], str]] = {
    **{
        type(make(1)).__name__: (
            True,
            make,
            f"a {type(make(1)).__name__} does not answer what was asked",
        )
        for make in (Done, Finished)
    },
    "early end": (False, end, "a Ended does not answer what was asked"),
    **{
        status.name: (
            True,
            partial(ended_as, status),
            f"a goal has ended as {status.name}",
        )
        for status in GoalStatus
        if status.is_active
    },
}


@pytest.mark.parametrize(("accepted", "make", "text"), UNFIT.values(), ids=UNFIT)
async def test_a_message_that_does_not_fit_a_goal_ends_the_connection_for_good(
    accepted: bool, make: Callable[[int], Any], text: str
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")) as sending:
            sent = await server.hear(SendGoal)
            if accepted:
                await server.say(following(sent))
                goal = await sending.answer()
            await server.say(make(sent.id))
            with pytest.raises(ProtocolError, match=f"^{WHERE}: {text}$"):
                await (outcome_of(goal) if accepted else sending.answer())
    assert network.dialed == 1


# Goals of other clients


@pytest.mark.parametrize("has_ended", [False, True])
async def test_an_observer_that_drops_its_stream_before_the_end_says_so(has_ended: bool) -> None:
    async with reached() as (connection, server):
        goal, call_id = await observed(connection, server)
        if has_ended:
            await server.say(end(call_id))
            assert await server.hear_all() == [Received(call_id)]
        del goal
        assert await server.hear_all() == [Received(call_id)] * (not has_ended)


@pytest.mark.parametrize("way", ["own", "failed", "lost"])
async def test_a_stream_that_has_nothing_to_say_is_dropped_silently(way: str) -> None:
    async with reached(settings=ONCE) as (connection, server):
        if way == "own":
            async with goal_of(connection, server) as (goal, _):
                pass
        else:
            goal, call_id = await observed(connection, server)
            if way == "failed":
                await server.say(Failed(call_id, Why.LIMIT, "too much"))
                await settled()
            else:
                server.channel.cut()
                with pytest.raises(ConnectionLost):
                    await outcome_of(goal)
        del goal
        assert await server.hear_all() == []


# Statuses


@pytest.mark.parametrize("is_early", [True, False])
@pytest.mark.parametrize(
    "make", [Finished, end, lambda call_id: Following(call_id, 1, GoalStatus.ACCEPTED, False, 0)]
)
async def test_a_message_that_does_not_fit_statuses_ends_the_connection_for_good(
    make: Callable[[int], Any], is_early: bool
) -> None:
    if make is Finished and not is_early:
        return
    async with reached() as (connection, server):
        async with Running(endpoint_of(connection).status) as asking:
            asked = await server.hear(WatchStatus)
            if not is_early:
                await server.say(Watching(asked.id, 0))
                statuses = await asking.answer()
            await server.say(make(asked.id))
            with anyio.fail_after(5), pytest.raises(ProtocolError, match="does not answer"):
                await (asking.answer() if is_early else statuses.receive())


# Leaving


async def test_leaving_writes_what_was_said_and_says_goodbye_last() -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            goal.close()
    assert await server.hear(Close) == Close(call_id)
    assert (await server.hear(Goodbye)).why == 0
    await server.hear_the_end()


WAIT: Call = lambda connection: endpoint_of(connection).wait_for_server()  # noqa: E731  # as the others


@pytest.mark.parametrize("call", [*CALLS.values(), WAIT], ids=[*CALLS, "wait_for_server"])
async def test_no_call_waits_any_longer_once_the_connection_was_left(call: Call) -> None:
    async with anyio.create_task_group() as tasks:
        errors: list[str] = []

        async def ask() -> None:
            with pytest.raises(ConnectionLost) as caught:
                await call(connection)
            errors.append(str(caught.value))

        async with reached() as (connection, _):
            tasks.start_soon(ask)
            await settled()
        with anyio.fail_after(5):
            await ask()
            await settled()
    assert errors == [f"the connection to {WHERE} was closed here"] * 2


async def test_a_connection_that_is_left_while_it_is_being_lost_does_not_come_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go = anyio.Event()

    async def close_slowly(_: MemoryChannel) -> None:
        with anyio.CancelScope(shield=True):
            await go.wait()

    async def let_go() -> None:
        await settled()
        go.set()

    monkeypatch.setattr(MemoryChannel, "aclose", close_slowly)
    async with anyio.create_task_group() as tasks:
        async with reached() as (connection, server):
            server.channel.cut()
            await settled()
            tasks.start_soon(let_go)
    with anyio.fail_after(5), pytest.raises(ConnectionLost):
        await endpoint_of(connection).wait_for_server()


async def test_a_connection_that_is_left_before_it_is_welcome_again_stays_left() -> None:
    network = Network()
    async with anyio.create_task_group() as tasks:
        async with reached(network) as (connection, server):
            network.closes = False
            server.channel.cut()
            again, _ = await network.reached()

            async def welcome_late() -> None:
                await again.hear(Goodbye)
                await settled()
                await again.say(Welcome(VERSION, LONG, MAX_FRAME))
                await settled()
                again.channel.cut()

            tasks.start_soon(welcome_late)
    with anyio.fail_after(5), pytest.raises(ConnectionLost):
        await connection.actions()


@in_virtual_time()
async def test_leaving_a_server_that_does_not_read_takes_a_second() -> None:
    async with reached() as (_, server):
        server.channel.stop_reading()
        start = anyio.current_time()
    assert anyio.current_time() - start == pytest.approx(1)
    assert server.channel.is_cut


@in_virtual_time()
async def test_leaving_reads_on_until_the_server_has_closed() -> None:
    network = Network()
    network.closes = False
    async with anyio.create_task_group() as tasks:

        async def close() -> None:
            await server.hear(Goodbye)
            await anyio.sleep(0.3)
            assert not server.channel.is_cut
            await server.say(*[Ended(call_id, SUCCEEDED, b"", "", 0)] * 3)  # to no call any more
            server.channel.cut()

        async with reached(network) as (connection, server):
            async with goal_of(connection, server) as (_, call_id):
                tasks.start_soon(close)
            start = anyio.current_time()
    assert anyio.current_time() - start == pytest.approx(0.3)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_no_call_waits_on_where_the_task_that_leaves_is_itself_canceled() -> None:
    apart = Apart(reached())
    connection, server = await apart.entered()
    async with Running(connection.actions) as asking:
        server.channel.stop_reading()
        await apart.canceled_while_it_leaves()
        with pytest.raises(ConnectionLost, match="was closed here"):
            await asking.answer(within=0.5)


# With a real server at the other end


async def test_of_many_goals_the_first_are_written_before_the_last_is_sent() -> None:
    writes: list[int] = []

    class Link:
        def wake_writer(self, *, at_once: bool = False) -> None:
            if at_once:
                writes.append(len(calls.openings()))

        def post(self, frame: bytes) -> None:
            raise AssertionError(frame)

    calls = OpenCalls(WINDOW, 1)
    calls.reopen(cast("Any", Link()), MAX_FRAME, 28)
    async with anyio.create_task_group() as tasks:
        for _ in range(100):
            tasks.start_soon(calls.send, "fibonacci", GoalRequest(GOAL_ID, GOAL))
        await anyio.wait_all_tasks_blocked()
        calls.detach()
        tasks.cancel_scope.cancel()

    assert writes == [1, BURST, BURST, BURST]
