"""`fibaction.wire.connection`: a real connection, and a server whose answers are made by hand."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.abc import Endpoint, FeedbackItem
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    LimitReached,
    ProtocolError,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.goals import ActionPeers, CancelAnswer, CancelCode, GoalID, GoalInfo
from fibaction.server import ActionServer
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.connection import (
    LEAVE_TIMEOUT,
    OPEN_TIMEOUT,
    RemoteConnection,
    open_connection,
)
from fibaction.wire.framing import MAX_FRAME
from fibaction.wire.link import HIGH_WATER, OVERFULL
from fibaction.wire.messages import (
    VERSION,
    Actions,
    AskPeers,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    GoalChanged,
    Goodbye,
    Hello,
    ListActions,
    Peers,
    Ping,
    Received,
    Rejected,
    SendGoal,
    Watching,
    WatchStatus,
    Welcome,
    Why,
    decode_from_client,
    encode,
)
from fibaction.wire.settings import ClientSettings, Limits, ServerSettings
from fibaction.wire.wire_server import WireServer
from tests import fibonacci as fib
from tests.fibonacci import FIBONACCI
from tests.virtual_time import in_virtual_time
from tests.wire import memory
from tests.wire.memory import LONG, Apart, Peer, Running, logged, settled

pytestmark = pytest.mark.anyio

WHERE = "memory://robot"
GOAL_ID = GoalID(bytes([1] * 16))
WINDOW = 4
PATIENT = ClientSettings(heartbeat=LONG, window=WINDOW, reconnect_timeout=30)
ONCE = ClientSettings(heartbeat=LONG, window=WINDOW, reconnect=False)
AWAY = ServerNotFound("nobody listens")


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


class Network:
    """Where connections are opened, one after the other."""

    def __init__(self) -> None:
        self.refusal: TransportError | None = None
        self.hangs = False
        self.dialed = 0
        self._waiting: deque[Peer] = deque()
        self._more = Notifier()

    async def dial(self) -> memory.MemoryChannel:
        self.dialed += 1
        await anyio.lowlevel.checkpoint()
        if self.hangs:
            await anyio.sleep_forever()
        if self.refusal is not None:
            raise self.refusal
        end, other = memory.pair(other=WHERE)
        self._waiting.append(Peer(end, decode_from_client))
        self._more.notify()
        return other

    async def accept(self, heartbeat: float = LONG) -> Peer:
        """Take the next connection in."""
        server = await self.answer()
        await server.say(Welcome(VERSION, heartbeat))
        return server

    async def answer(self, *messages: Any) -> Peer:
        """Take the next connection, and say something else than Welcome."""
        with anyio.fail_after(60):
            while not self._waiting:
                await self._more.wait()
        server = self._waiting.popleft()
        await server.hear(Hello)
        if messages:
            await server.say(*messages)
        return server


@asynccontextmanager
async def reached(
    network: Network, keeping: ClientSettings = PATIENT, heartbeat: float = LONG
) -> AsyncGenerator[tuple[RemoteConnection, Peer], None]:
    """A connection, and its server."""
    async with Running(lambda: network.accept(heartbeat)) as accepting:
        async with open_connection(network.dial, WHERE, keeping) as connection:
            yield connection, await accepting.answer()


def endpoint_of(connection: RemoteConnection) -> Endpoint:
    return connection.endpoint(FIBONACCI)


CALLS: dict[str, Callable[[RemoteConnection], Awaitable[Any]]] = {
    "actions": RemoteConnection.actions,
    "send_goal": lambda connection: endpoint_of(connection).send_goal(GOAL_ID, b"goal"),
    "feedback": lambda connection: endpoint_of(connection).feedback(GOAL_ID),
    "get_result": lambda connection: endpoint_of(connection).get_result(GOAL_ID),
    "cancel_goals": lambda connection: endpoint_of(connection).cancel_goals(),
    "status": lambda connection: endpoint_of(connection).status(),
}
"""All that a client can ask for, and that does not wait for a server."""

every_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


async def fails_at_once(connection: RemoteConnection, error: type[ActionError]) -> str:
    """All calls do, and with the same text, which it gives."""
    texts = set()
    for call in CALLS.values():
        with anyio.fail_after(0.1), pytest.raises(error) as caught:
            await call(connection)
        assert type(caught.value) is error
        texts.add(str(caught.value))
    (text,) = texts
    return text


async def is_used(connection: RemoteConnection, server: Peer) -> None:
    """A call goes to the server, and its answer comes back."""
    async with Running(connection.actions) as asking:
        await server.say(Actions((await server.hear(ListActions)).id, []))
        assert await asking.answer() == []


def following(message: SendGoal | Follow, **changes: Any) -> Following:
    values: dict[str, Any] = {"stamp": 7, "status": 2, "latest": False, "place": 0, **changes}
    return Following(message.id, **values)


@asynccontextmanager
async def goal_of(
    connection: RemoteConnection, server: Peer, *, feedback: bool = True
) -> AsyncGenerator[tuple[Any, int], None]:
    """A goal that was accepted, and its ID on the connection."""
    endpoint = endpoint_of(connection)
    sending = Running(lambda: endpoint.send_goal(GOAL_ID, b"goal", feedback=feedback))
    async with sending:
        sent = await server.hear(SendGoal)
        await server.say(following(sent))
        yield await sending.answer(), sent.id


async def observed(connection: RemoteConnection, server: Peer, *, place: int = 0) -> Any:
    """The goal of somebody else, followed from a place on."""
    async with Running(lambda: endpoint_of(connection).feedback(GOAL_ID)) as asking:
        await server.say(following(await server.hear(Follow), place=place))
        return await asking.answer()


async def watched(connection: RemoteConnection, server: Peer) -> Any:
    """The statuses of the goals, of which there is none yet."""
    async with Running(endpoint_of(connection).status) as asking:
        await server.say(Watching((await server.hear(WatchStatus)).id, 0))
        return await asking.answer()


# The handshake


async def test_the_first_message_says_who_the_client_is() -> None:
    network = Network()
    keeping = ClientSettings(heartbeat=LONG, token="s3cret")
    async with Background() as tasks:
        connection = RemoteConnection(network.dial, WHERE, keeping)
        tasks.start_soon(connection.run)
        await settled()
        server = network._waiting.popleft()
        hello = await server.hear(Hello)
        assert (hello.version, hello.heartbeat, hello.token) == (VERSION, LONG, "s3cret")
        server.channel.cut()
        await settled()
        with anyio.fail_after(5):
            while not network._waiting:
                await network._more.wait()
        again = await network._waiting.popleft().hear(Hello)
        assert again.session == hello.session
        assert len(hello.session) >= 16


def test_a_token_is_not_shown() -> None:
    assert "s3cret" not in repr(ClientSettings(token="s3cret"))


async def test_nobody_there_is_an_error_at_once_where_no_other_attempt_is_wanted() -> None:
    network = Network()
    network.refusal = AWAY
    with anyio.fail_after(5), pytest.raises(ServerNotFound, match="nobody listens"):
        async with open_connection(network.dial, WHERE, ONCE):
            raise AssertionError
    assert network.dialed == 1


async def test_a_client_that_is_not_let_in_is_told_so_and_does_not_try_again() -> None:
    network = Network()
    goodbye = Goodbye("the server wants another token", Why.FORBIDDEN)
    keeping = msgspec.structs.replace(PATIENT, token="s3cret")
    async with Running(lambda: network.answer(goodbye)):
        with anyio.fail_after(5), pytest.raises(AuthenticationFailed) as caught:
            async with open_connection(network.dial, WHERE, keeping):
                raise AssertionError
    assert str(caught.value) == f"{WHERE}: the server wants another token"
    assert network.dialed == 1


@pytest.mark.parametrize("why", [Why.FORBIDDEN, Why.PROTOCOL])
async def test_a_client_that_gave_no_token_where_one_is_wanted_is_told_how(why: int) -> None:
    network = Network()
    async with Running(lambda: network.answer(Goodbye("the server wants a token", why))):
        with anyio.fail_after(5), pytest.raises(ActionError) as caught:
            async with open_connection(network.dial, WHERE, PATIENT):
                raise AssertionError
    hint = ": give one as token=, or behind the URL as ?token=" if why == Why.FORBIDDEN else ""
    assert str(caught.value) == f"{WHERE}: the server wants a token{hint}"
    assert network.dialed == 1


async def test_a_dial_that_is_not_let_in_does_not_try_again() -> None:
    network = Network()
    network.refusal = AuthenticationFailed("another certificate")
    with anyio.fail_after(5), pytest.raises(AuthenticationFailed, match="another certificate"):
        async with open_connection(network.dial, WHERE, PATIENT):
            raise AssertionError
    assert network.dialed == 1


WRONG_STARTS = {
    "another version": (Welcome(2, LONG), "a Welcome of version 2 was not expected"),
    "no welcome": (Done(1), "the first message was a Done, not a Welcome"),
    "a goodbye": (Goodbye("another version", Why.PROTOCOL), f"{WHERE}: another version"),
}


@pytest.mark.parametrize(("message", "text"), WRONG_STARTS.values(), ids=WRONG_STARTS)
async def test_a_server_that_begins_in_a_wrong_way_is_left_for_good(
    message: Any, text: str
) -> None:
    network = Network()
    async with Running(lambda: network.answer(message)) as answering:
        with anyio.fail_after(5), pytest.raises(ProtocolError, match=text):
            async with open_connection(network.dial, WHERE, PATIENT):
                raise AssertionError
        server = await answering.answer()
        assert server.channel.is_cut
    assert network.dialed == 1


async def test_a_server_that_says_welcome_twice_is_left_for_good() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            await server.say(Welcome(VERSION, LONG))
            text = "a Welcome of version 1 was not expected"
            with pytest.raises(ProtocolError, match=text):
                await waiting.answer()
        assert await fails_at_once(connection, ProtocolError) == f"{WHERE}: {text}"
    assert network.dialed == 1


async def test_what_is_no_message_ends_the_connection_for_good() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        await server.channel.send([b"\xc1"])
        await settled()
        assert "invalid server message" in await fails_at_once(connection, ProtocolError)
    assert network.dialed == 1


async def test_an_end_is_answered_with_received() -> None:
    async with reached(Network()) as (connection, server):
        async with goal_of(connection, server) as (_, call_id):
            await server.say(Ended(call_id, GoalStatus.SUCCEEDED, b"result", "", 0))
            assert await server.hear(Received) == Received(call_id)
            assert connection._calls._calls == {}


async def test_the_end_of_a_goal_that_was_given_up_before_its_answer_is_answered() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")):
            sent = await server.hear(SendGoal)
        assert await server.hear_all() == [Close(sent.id)]
        await server.say(following(sent), Ended(sent.id, GoalStatus.SUCCEEDED, b"result", "", 0))
        assert await server.hear_all() == [Received(sent.id)]


async def test_signs_of_life_and_answers_that_nobody_waits_for_are_ignored() -> None:
    async with reached(Network()) as (connection, server):
        await server.say(Ping(), Done(77), Ended(78, GoalStatus.SUCCEEDED, None, "", 0))
        assert await server.hear_all() == [Received(78)]  # so that nothing is kept for it
        async with Running(connection.actions) as asking:
            question = await server.hear(ListActions)
            await server.say(Actions(question.id, [FIBONACCI.info]))
            assert await asking.answer() == [FIBONACCI.info]


# Before there is a connection


async def test_calls_before_the_first_connection_fail_at_once() -> None:
    network = Network()
    network.refusal = AWAY
    with anyio.fail_after(5):
        async with open_connection(network.dial, WHERE, PATIENT) as connection:
            assert await fails_at_once(connection, ServerNotFound) == "nobody listens"


@in_virtual_time()
async def test_an_attempt_that_hangs_has_its_time() -> None:
    network = Network()
    network.hangs = True
    start = anyio.current_time()
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        assert anyio.current_time() - start == pytest.approx(OPEN_TIMEOUT)
        text = await fails_at_once(connection, ServerNotFound)
        assert text == f"{WHERE} did not answer within 5 s"
        network.hangs = False
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            server = await network.accept()
            await server.say(Done((await server.hear(AwaitServer)).id))
            await waiting.answer()


@in_virtual_time()
async def test_a_server_that_does_not_answer_the_hello_is_lost() -> None:
    network = Network()
    keeping = ClientSettings(heartbeat=1, reconnect=False)
    with pytest.raises(ConnectionLost, match=r"has been silent for 4\.5 s"):
        async with open_connection(network.dial, WHERE, keeping):
            raise AssertionError
    assert anyio.current_time() < 6


@in_virtual_time()
async def test_attempts_are_made_for_as_long_as_it_takes_and_not_too_often() -> None:
    network = Network()
    network.refusal = AWAY
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        await anyio.sleep(3600)
        assert 1800 <= network.dialed <= 3700
        network.refusal = None
        await network.accept()
        await settled()
        async with Running(connection.actions) as asking:
            assert not asking.is_done


async def test_whoever_waits_for_the_server_waits_for_the_first_connection() -> None:
    network = Network()
    network.refusal = AWAY
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            assert not waiting.is_done
            network.refusal = None
            server = await network.accept()
            message = await server.hear(AwaitServer)
            assert message.action == "fibonacci"
            await server.say(Done(message.id))
            await waiting.answer()


async def test_whoever_waits_for_the_server_waits_while_it_is_full() -> None:
    network = Network()
    full = Goodbye("the server is full", Why.LIMIT)
    async with Running(lambda: network.answer(full)):
        async with open_connection(network.dial, WHERE, PATIENT) as connection:
            async with Running(endpoint_of(connection).wait_for_server) as waiting:
                assert not waiting.is_done
                server = await network.accept()
                await server.say(Done((await server.hear(AwaitServer)).id))
                await waiting.answer()


# Calls


async def test_a_cancel_is_asked_and_answered() -> None:
    async with reached(Network()) as (connection, server):
        endpoint = endpoint_of(connection)
        async with Running(lambda: endpoint.cancel_goals(GOAL_ID, 5)) as asking:
            asked = await server.hear(CancelGoals)
            assert asked == CancelGoals(asked.id, "fibonacci", GOAL_ID, 5)
            await server.say(CancelAnswered(asked.id, 0, [(GOAL_ID, 4, GoalStatus.CANCELING)], "x"))
            goal = GoalInfo(GOAL_ID, 4, GoalStatus.CANCELING)
            assert await asking.answer() == CancelAnswer(CancelCode.NONE, (goal,), "x")


async def test_a_goal_is_sent_followed_and_ends() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")) as sending:
            sent = await server.hear(SendGoal)
            assert sent == SendGoal(sent.id, "fibonacci", GOAL_ID, b"goal", WINDOW)
            await server.say(following(sent))
            goal = await sending.answer()
            assert (goal.goal_id, goal.stamp, goal.status) == (GOAL_ID, 7, GoalStatus.EXECUTING)
        await server.say(
            Feedback(sent.id, 1, b"one"), Ended(sent.id, GoalStatus.SUCCEEDED, b"result", "", 1)
        )
        with anyio.fail_after(5):
            assert await goal.receive() == FeedbackItem(1, b"one")
            assert await goal.receive() is None
            assert (await goal.outcome()).result == b"result"
        assert connection._calls._calls == {}


async def test_a_call_that_is_alone_is_sent_at_once_and_those_beside_it_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with reached(Network()) as (connection, _):
        assert connection._link is not None
        told: list[bool] = []
        monkeypatch.setattr(
            connection._link, "wake_writer", lambda *, at_once: told.append(at_once)
        )
        async with Background() as tasks:
            for _ in range(3):
                tasks.start_soon(connection.actions)
            await settled()
        assert told == [True, False, False]


async def test_a_goal_without_feedback_asks_for_none() -> None:
    async with reached(Network()) as (connection, server):
        sending = Running(
            lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal", feedback=False)
        )
        async with sending:
            assert (await server.hear(SendGoal)).credit is None


async def test_a_goal_that_is_rejected_is_over() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")) as sending:
            await server.say(Rejected((await server.hear(SendGoal)).id, "no arm"))
            with pytest.raises(GoalRejected) as caught:
                await sending.answer()
        assert (caught.value.reason, caught.value.goal_id) == ("no arm", GOAL_ID)
        assert connection._calls._calls == {}


async def test_following_an_unknown_goal_is_an_error_and_its_result_is_unknown() -> None:
    async with reached(Network()) as (connection, server):
        endpoint = endpoint_of(connection)
        async with Running(lambda: endpoint.feedback(GOAL_ID, after=3, own=True)) as asking:
            asked = await server.hear(Follow)
            assert asked == Follow(asked.id, "fibonacci", GOAL_ID, 3, True, WINDOW)
            await server.say(Failed(asked.id, Why.UNKNOWN_GOAL, "unknown"))
            with pytest.raises(UnknownGoal):
                await asking.answer()
        async with Running(lambda: endpoint.get_result(GOAL_ID)) as asking:
            await server.say(Failed((await server.hear(Follow)).id, Why.UNKNOWN_GOAL, "unknown"))
            assert (await asking.answer()).status is GoalStatus.UNKNOWN


async def test_who_uses_an_action_is_asked_of_the_server() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: connection.peers("fibonacci")) as asking:
            asked = await server.hear(AskPeers)
            await server.say(Peers(asked.id, ["10.0.0.7:1"]))
            assert await asking.answer() == ActionPeers((WHERE,), ("10.0.0.7:1",))


@every_call
async def test_what_the_server_has_refused_is_over_and_nothing_more_is_said_of_it(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: call(connection)) as asking:
            (asked,) = await server.hear_all()
            await server.say(Failed(asked.id, Why.LIMIT, "too much at once"))
            with pytest.raises(TransportError, match="too much at once"):
                await asking.answer()
        assert await server.hear_all() == []
        assert connection._calls._calls == {}


async def test_statuses_are_watched() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(endpoint_of(connection).status) as asking:
            asked = await server.hear(WatchStatus)
            assert asked == WatchStatus(asked.id, "fibonacci", WINDOW)
            await server.say(
                Watching(asked.id, 1), GoalChanged(asked.id, GOAL_ID, 5, GoalStatus.EXECUTING, 0)
            )
            statuses = await asking.answer()
        with anyio.fail_after(5):
            assert await statuses.receive() == GoalInfo(GOAL_ID, 5, GoalStatus.EXECUTING)
            await server.say(Finished(asked.id))
            assert await statuses.receive() is None
        assert connection._calls._calls == {}


async def test_a_message_that_no_server_takes_is_not_sent() -> None:
    async with reached(Network()) as (connection, server):
        with (
            anyio.fail_after(5),
            pytest.raises(ProtocolError, match=f"{MAX_FRAME} are the server's limit"),
        ):
            await endpoint_of(connection).send_goal(GOAL_ID, bytes(MAX_FRAME))
        assert await server.hear_all() == []
        assert connection._calls._calls == {}


async def test_each_side_says_how_much_it_takes() -> None:
    network = Network()
    keeping = ClientSettings(heartbeat=LONG, window=WINDOW, max_frame=1234)
    async with Background() as tasks:
        connection = RemoteConnection(network.dial, WHERE, keeping)
        tasks.start_soon(connection.run)
        await settled()
        server = network._waiting.popleft()
        assert (await server.hear(Hello)).max_frame == 1234
        await server.say(Welcome(VERSION, LONG, 60))
        await settled()
        assert connection._calls._max_frame == 60
        size = len(encode(SendGoal(1, "fibonacci", GOAL_ID, bytes(10), WINDOW)))
        text = rf"^the message has {size + 30} bytes, and 60 are the server's limit$"
        with anyio.fail_after(5), pytest.raises(ProtocolError, match=text):
            await endpoint_of(connection).send_goal(GOAL_ID, bytes(40))
        assert await server.hear_all() == []
        async with Running(
            lambda: endpoint_of(connection).send_goal(GOAL_ID, bytes(10 + 60 - size))
        ):
            sent = await server.hear(SendGoal)
            assert len(encode(sent)) == 60


async def test_a_goal_that_the_next_server_does_not_take_is_not_sent_to_it() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        network.refusal = AWAY
        server.channel.cut()
        await settled()
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, bytes(2000))) as send:
            network.refusal = None
            server = await network.answer()
            await server.say(Welcome(VERSION, LONG, 1000))
            with pytest.raises(ProtocolError, match="1000 are the server's limit"):
                await send.answer(within=1)


def test_an_endpoint_says_what_it_was_asked_for() -> None:
    connection = RemoteConnection(Network().dial, WHERE, PATIENT)
    assert connection.endpoint(FIBONACCI).info == FIBONACCI.info
    assert connection.endpoint(FIBONACCI.info).info == FIBONACCI.info


async def test_an_answer_of_the_wrong_kind_is_an_error_of_that_call() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(connection.actions) as asking:
            await server.say(Done((await server.hear(ListActions)).id))
            with pytest.raises(ProtocolError, match="a Done does not answer what was asked"):
                await asking.answer()
        assert not server.channel.is_cut


async def test_a_message_that_does_not_fit_a_goal_ends_the_connection_for_good() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(Done(call_id))
            with anyio.fail_after(5), pytest.raises(ProtocolError, match="a Done does not answer"):
                await goal.outcome()
    assert network.dialed == 1


@every_call
async def test_a_call_that_is_given_up_is_closed(call: Callable[..., Awaitable[Any]]) -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: call(connection)):
            (asked,) = await server.hear_all()
        closing = Received if isinstance(asked, Follow) else Close
        assert await server.hear_all() == [closing(asked.id)]
        assert connection._calls._calls == {}


async def test_a_goal_that_is_given_up_before_its_answer_is_ignored_from_then_on() -> None:
    async with reached(Network()) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")):
            sent = await server.hear(SendGoal)
        await server.hear(Close)
        await server.say(
            following(sent),
            Feedback(sent.id, 1, b""),
            Ended(sent.id, GoalStatus.SUCCEEDED, None, "", 1),
        )
        await settled()
        assert not server.channel.is_cut


# When the connection is lost


@every_call
async def test_a_call_without_an_answer_is_made_again(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(lambda: call(connection)) as calling:
            (first,) = await server.hear_all()
            server.channel.cut()
            server = await network.accept()
            assert await server.hear_all() == [first]
            assert not calling.is_done


@every_call
async def test_a_call_between_two_connections_waits_for_the_next(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    network = Network()
    network_down = AWAY
    async with reached(network) as (connection, server):
        network.refusal = network_down
        server.channel.cut()
        await settled()
        async with Running(lambda: call(connection)) as calling:
            assert not calling.is_done
            network.refusal = None
            server = await network.accept()
            assert len(await server.hear_all()) == 1


@every_call
async def test_without_reconnecting_the_loss_ends_every_call(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    network = Network()
    async with reached(network, ONCE) as (connection, server):
        async with Running(lambda: call(connection)) as calling:
            server.channel.cut()
            with pytest.raises(ConnectionLost, match=f"{WHERE} closed its side"):
                await calling.answer()
        assert f"{WHERE} closed its side" in await fails_at_once(connection, ConnectionLost)
    assert network.dialed == 1


async def test_a_loss_is_one_line_of_the_log() -> None:
    network = Network()
    async with reached(network) as (_, server):
        with logged() as lines:
            server.channel.cut()
            await network.accept()
            await settled()
        assert [line.getMessage() for line in lines] == [f"{WHERE} closed its side"]


async def test_a_server_that_says_goodbye_is_found_again() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(connection.actions) as asking:
            await server.hear(ListActions)
            await server.say(Goodbye("the server is closing the connection"))
            server = await network.accept()
            await server.say(Actions((await server.hear(ListActions)).id, []))
            assert await asking.answer() == []


async def test_a_server_that_lets_the_client_in_no_more_is_left_for_good() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(connection.actions) as asking:
            await server.hear(ListActions)
            await server.say(Goodbye("the token has expired", Why.FORBIDDEN))
            with pytest.raises(AuthenticationFailed, match="the token has expired"):
                await asking.answer()
        text = await fails_at_once(connection, AuthenticationFailed)
        assert text == f"{WHERE}: the token has expired"
    assert network.dialed == 1


async def test_a_goal_is_resumed_behind_the_last_feedback_and_loses_none() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(Feedback(call_id, 1, b"1"), Feedback(call_id, 2, b"2"))
            with anyio.fail_after(5):
                assert (await goal.receive()).number == 1
            server.channel.cut()
            server = await network.accept()
            asked = await server.hear(Follow)
            credit = WINDOW - 1  # one that has arrived has yet to be read
            assert asked == Follow(call_id, "fibonacci", GOAL_ID, 2, True, credit)
            await server.say(
                following(asked, place=2),
                Feedback(call_id, 3, b"3"),
                Ended(call_id, GoalStatus.SUCCEEDED, b"result", "", 3),
            )
            with anyio.fail_after(5):
                assert [(await goal.receive()).number for _ in range(2)] == [2, 3]
                assert await goal.receive() is None
            assert goal.dropped == 0


async def test_a_goal_that_is_only_observed_is_resumed_as_such() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        goal = await observed(connection, server, place=5)
        server.channel.cut()
        server = await network.accept()
        assert await server.hear(Follow) == Follow(goal.id, "fibonacci", GOAL_ID, 5, False, WINDOW)


async def test_who_only_looks_on_is_remembered_for_as_long_as_somebody_does() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        kept, left = [await observed(connection, server) for _ in range(2)]
        await server.say(Feedback(kept.id, 1, b"1"))
        left_id = left.id
        left.close()
        assert await server.hear(Close) == Close(left_id)
        del left
        assert await server.hear(Received) == Received(left_id)
        server.channel.cut()
        server = await network.accept()
        (again,) = await server.hear_all()
        assert again == Follow(kept.id, "fibonacci", GOAL_ID, 1, False, WINDOW - 1)
        await server.say(
            following(again, place=1), Ended(kept.id, GoalStatus.SUCCEEDED, b"result", "", 1)
        )
        assert (await kept.outcome()).result == b"result"
        assert await server.hear_all() == [Received(kept.id)]
        assert list(connection._calls._observed) == []


async def test_who_only_looks_on_is_told_that_the_connection_is_lost() -> None:
    network = Network()
    async with reached(network, ONCE) as (connection, server):
        goal = await observed(connection, server)
        server.channel.cut()
        with anyio.fail_after(5), pytest.raises(ConnectionLost):
            await goal.outcome()


async def test_a_goal_that_is_not_read_any_more_is_resumed_for_its_end() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            network.refusal = AWAY
            server.channel.cut()
            await settled()
            goal.close()
            network.refusal = None
            server = await network.accept()
            asked = await server.hear(Follow)
            assert (asked.own, asked.credit) == (True, None)
            await server.say(
                following(asked), Ended(call_id, GoalStatus.SUCCEEDED, b"result", "", 9)
            )
            with anyio.fail_after(5):
                assert (await goal.outcome()).result == b"result"


async def test_a_goal_that_the_server_has_forgotten_meanwhile_is_unknown() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            server.channel.cut()
            server = await network.accept()
            await server.hear(Follow)
            await server.say(Failed(call_id, Why.UNKNOWN_GOAL, "unknown"))
            with anyio.fail_after(5):
                assert (await goal.outcome()).status is GoalStatus.UNKNOWN


async def test_a_goal_that_was_not_answered_is_sent_again_as_the_same() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")) as sending:
            first = await server.hear(SendGoal)
            for _ in range(3):
                server.channel.cut()
                server = await network.accept()
                assert await server.hear(SendGoal) == first
            await server.say(following(first))
            assert (await sending.answer()).goal_id == GOAL_ID


async def test_what_was_not_answered_may_be_more_than_fits_into_the_queue_of_a_connection() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        network.refusal = AWAY
        server.channel.cut()
        await settled()
        async with AsyncExitStack() as stack:
            for number in range(5 * OVERFULL):
                goal_id = GoalID(bytes([number] * 16))
                send = partial(endpoint_of(connection).send_goal, goal_id, bytes(HIGH_WATER // 2))
                await stack.enter_async_context(Running(send))
            network.refusal = None
            server = await network.accept()
            numbers = [(await server.hear(SendGoal)).goal_id[0] for _ in range(5 * OVERFULL)]
            assert numbers == list(range(5 * OVERFULL))


async def test_a_call_that_is_given_up_before_it_could_be_sent_is_not_sent() -> None:
    async with reached(Network()) as (connection, server):
        server.channel.stop_reading()
        send = endpoint_of(connection).send_goal
        async with Running(lambda: send(GOAL_ID, bytes(HIGH_WATER))):
            async with Running(lambda: send(GoalID(bytes([2] * 16)), b"given up")):
                pass
            async with Running(lambda: send(GoalID(bytes([3] * 16)), b"small")):
                server.channel.go_on_reading()
                heard = await server.hear_all()
                sent = [len(one.goal) for one in heard if isinstance(one, SendGoal)]
                assert sent == [HIGH_WATER, 5]


async def test_a_goal_that_waits_for_room_is_sent_once_on_the_next_connection() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        endpoint = endpoint_of(connection)
        server.channel.stop_reading()
        async with Running(lambda: endpoint.send_goal(GOAL_ID, bytes(HIGH_WATER))):
            async with Running(lambda: endpoint.send_goal(GoalID(bytes([2] * 16)), b"small")):
                server.channel.cut()
                server = await network.accept()
                sent = await server.hear_all()
                assert [(type(one), len(one.goal)) for one in sent] == [
                    (SendGoal, HIGH_WATER),
                    (SendGoal, 5),
                ]


async def test_statuses_are_watched_again() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        statuses = await watched(connection, server)
        server.channel.cut()
        server = await network.accept()
        asked = await server.hear(WatchStatus)
        assert asked == WatchStatus(statuses.id, "fibonacci", WINDOW)
        await server.say(
            Watching(asked.id, 1), GoalChanged(asked.id, GOAL_ID, 5, GoalStatus.EXECUTING, 0)
        )
        with anyio.fail_after(5):
            assert (await statuses.receive()).goal_id == GOAL_ID


async def test_statuses_that_nobody_reads_any_more_are_not_watched_again() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        statuses = await watched(connection, server)
        statuses.close()
        await server.hear(Close)
        server.channel.cut()
        server = await network.accept()
        assert await server.hear_all() == []


async def test_statuses_that_were_closed_before_they_could_be_watched_again_are_not() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, bytes(HIGH_WATER))):
            await server.hear(SendGoal)
            statuses = await watched(connection, server)
            server.channel.cut()
            server = await network.accept()
            server.channel.stop_reading()
            await settled()
            statuses.close()
            server.channel.go_on_reading()
            assert [type(one) for one in await server.hear_all()] == [SendGoal, Close]
            assert statuses.id not in connection._calls._calls


# For how long


@in_virtual_time()
async def test_a_server_that_misses_four_signs_of_life_is_lost() -> None:
    network = Network()
    keeping = ClientSettings(heartbeat=LONG / 100, reconnect=False)
    async with reached(network, keeping, heartbeat=LONG / 10) as (connection, server):
        async with Running(connection.actions) as asking:
            await anyio.sleep(LONG * 0.39)
            assert not asking.is_done
            await server.say(Ping())
            await anyio.sleep(LONG * 0.39)
            assert not asking.is_done
            with pytest.raises(ConnectionLost, match="has been silent for"):
                await asking.answer(within=LONG * 0.03)


@in_virtual_time()
async def test_a_server_that_falls_silent_is_found_again() -> None:
    network = Network()
    keeping = ClientSettings(heartbeat=1)
    async with reached(network, keeping, heartbeat=1) as (connection, server):
        async with Running(connection.actions) as asking:
            await server.hear(ListActions)
            server.channel.mute()
            server = await network.accept(heartbeat=LONG)
            await server.say(Actions((await server.hear(ListActions)).id, []))
            assert await asking.answer() == []


def impatient() -> ConnectionLost:
    return ConnectionLost("the line is dead")


@in_virtual_time()
@every_call
async def test_a_call_waits_for_the_next_connection_so_long_and_no_longer(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        network.refusal = impatient()
        server.channel.cut()
        await settled()
        async with Running(lambda: call(connection)) as calling:
            await anyio.sleep(29)
            assert not calling.is_done
            with pytest.raises(ConnectionLost, match="the line is dead"):
                await calling.answer()
        await fails_at_once(connection, ConnectionLost)
        network.refusal = None
        server = await network.accept()
        await settled()
        await is_used(connection, server)


@in_virtual_time()
@pytest.mark.parametrize("hangs", ["dial", "welcome"])
async def test_a_call_waits_no_longer_for_an_attempt_that_hangs(hangs: str) -> None:
    network = Network()
    keeping = msgspec.structs.replace(PATIENT, reconnect_timeout=OPEN_TIMEOUT + 1)
    async with reached(network, keeping) as (connection, server):
        network.hangs = hangs == "dial"
        server.channel.cut()
        await settled()
        async with Running(connection.actions) as asking:
            await anyio.sleep(OPEN_TIMEOUT + 0.9)
            assert not asking.is_done
            await anyio.sleep(0.2)
            assert asking.is_done
            with pytest.raises(ConnectionLost):
                await asking.answer()
        network.hangs = False
        server = await network.accept()
        await settled()
        await is_used(connection, server)


@in_virtual_time()
async def test_a_connection_that_came_back_in_time_is_not_given_up() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        server.channel.cut()
        server = await network.accept()
        async with Running(connection.actions) as asking:
            asked = await server.hear(ListActions)
            await anyio.sleep(60)
            await server.say(Actions(asked.id, []))
            assert await asking.answer() == []


@in_virtual_time()
async def test_a_connection_that_comes_back_in_the_last_moment_is_not_given_up() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        await connection._reconnector._lose_patience(anyio.CancelScope(), 0)
        await is_used(connection, server)


@in_virtual_time()
async def test_each_loss_has_the_whole_time_again() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        for _ in range(3):
            network.refusal = impatient()
            server.channel.cut()
            async with Running(connection.actions) as asking:
                await anyio.sleep(20)
                network.refusal = None
                server = await network.accept()
                await server.say(Actions((await server.hear(ListActions)).id, []))
                assert await asking.answer() == []


@in_virtual_time()
@pytest.mark.parametrize("wait", ["receive", "outcome"])
async def test_a_goal_whose_server_does_not_come_back_has_lost_its_connection(wait: str) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, _):
            network.refusal = AWAY
            server.channel.cut()
            with anyio.fail_after(60), pytest.raises(ConnectionLost):
                await getattr(goal, wait)()


@in_virtual_time()
async def test_whoever_waits_for_the_server_waits_across_a_long_absence() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            await server.hear(AwaitServer)
            network.refusal = AWAY
            server.channel.cut()
            await anyio.sleep(3600)
            assert not waiting.is_done
            network.refusal = None
            server = await network.accept()
            await server.say(Done((await server.hear(AwaitServer)).id))
            await waiting.answer()


async def test_whoever_waits_for_an_action_that_is_not_served_asks_the_next_server() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            failed = Failed((await server.hear(AwaitServer)).id, Why.SERVER_NOT_FOUND, "no such")
            await server.say(failed)
            await settled()
            assert not waiting.is_done
            server.channel.cut()
            server = await network.accept()
            await server.say(Done((await server.hear(AwaitServer)).id))
            await waiting.answer()


async def test_whoever_waits_for_the_server_sees_one_that_comes_when_it_was_just_given_up() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            await server.hear(AwaitServer)
            server.channel.cut()
            server = await network.answer()
            # In one turn of the event loop: before whoever waits can look, there is a connection.
            connection._reconnector._give_up(impatient())
            connection._handle(encode(Welcome(VERSION, LONG)))
            await server.say(Done((await server.hear(AwaitServer)).id))
            await waiting.answer(within=1)


async def test_without_reconnecting_nobody_waits_for_a_server_that_is_gone() -> None:
    async with reached(Network(), ONCE) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            failed = Failed((await server.hear(AwaitServer)).id, Why.SERVER_NOT_FOUND, "no such")
            await server.say(failed)
            await settled()
            server.channel.cut()
            with pytest.raises(ConnectionLost, match="closed its side"):
                await waiting.answer()


# Leaving


async def test_leaving_writes_what_was_said_and_says_goodbye_last() -> None:
    async with reached(Network()) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            goal.close()
    assert await server.hear(Close) == Close(call_id)
    assert (await server.hear(Goodbye)).why == 0
    await server.hear_the_end()


@every_call
async def test_nobody_waits_any_longer_once_the_connection_was_left(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    network = Network()
    async with Background() as tasks:
        connection = RemoteConnection(network.dial, WHERE, PATIENT)
        tasks.start_soon(connection.run)
        await network.accept()
        await connection.first_attempt()
        async with Running(lambda: call(connection)) as calling:
            assert not calling.is_done
            await connection.leave()
            with pytest.raises(ConnectionLost, match="was closed here"):
                await calling.answer()
    await fails_at_once(connection, ConnectionLost)


async def test_nobody_waits_for_a_server_once_the_connection_was_left() -> None:
    network = Network()
    async with Background() as tasks:
        connection = RemoteConnection(network.dial, WHERE, PATIENT)
        tasks.start_soon(connection.run)
        await network.accept()
        await connection.first_attempt()
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            assert not waiting.is_done
            await connection.leave()
            with pytest.raises(ConnectionLost, match="was closed here"):
                await waiting.answer(within=1)
    with anyio.fail_after(1), pytest.raises(ConnectionLost, match="was closed here"):
        await endpoint_of(connection).wait_for_server()


async def test_nobody_waits_for_a_server_once_a_connection_was_left_that_was_being_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go = anyio.Event()

    async def close_slowly(_: memory.MemoryChannel) -> None:
        with anyio.CancelScope(shield=True):
            await go.wait()

    async def let_go() -> None:
        await settled()
        go.set()

    monkeypatch.setattr(memory.MemoryChannel, "aclose", close_slowly)
    async with anyio.create_task_group() as tasks:
        async with reached(Network()) as (connection, server):
            server.channel.cut()
            await settled()
            tasks.start_soon(let_go)
    with anyio.fail_after(1), pytest.raises(ConnectionLost):
        await endpoint_of(connection).wait_for_server()


async def test_leaving_while_there_is_no_connection_does_not_wait() -> None:
    network = Network()
    network.refusal = AWAY
    async with open_connection(network.dial, WHERE, PATIENT) as connection:
        pass
    assert "was closed here" in await fails_at_once(connection, ConnectionLost)


@in_virtual_time()
async def test_leaving_a_server_that_does_not_read_does_not_take_long() -> None:
    async with reached(Network()) as (_, server):
        server.channel.stop_reading()
        start = anyio.current_time()
    assert anyio.current_time() - start == pytest.approx(LEAVE_TIMEOUT)
    assert server.channel.is_cut


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_nobody_waits_on_where_the_task_that_leaves_is_itself_canceled() -> None:
    apart = Apart(reached(Network()))
    connection, server = await apart.entered()
    async with Running(connection.actions) as asking:
        server.channel.stop_reading()
        await apart.canceled_while_it_leaves()
        with pytest.raises(ConnectionLost, match="was closed here"):
            await asking.answer(within=0.5)


async def test_an_exception_of_the_block_goes_on_as_itself() -> None:
    with pytest.raises(ZeroDivisionError):
        async with reached(Network()) as (_, server):
            raise ZeroDivisionError
    await server.hear(Goodbye)


# With a real server at the other end


class Lines:
    """All connections to one server: a test may spoil them."""

    def __init__(self) -> None:
        self.ends: list[memory.MemoryChannel] = []

    @property
    def end(self) -> memory.MemoryChannel:
        """The server's end of the connection that there is."""
        return self.ends[-1]


@asynccontextmanager
async def real(
    *steps: Any,
    server: ActionServer[Any, Any, Any] | None = None,
    lines: Lines | None = None,
    keeping: ClientSettings = PATIENT,
    limits: Limits | None = None,
) -> AsyncGenerator[Endpoint, None]:
    """A server of such goals, over the wire."""
    server = server or ScriptedServer(FIBONACCI, steps)
    lines = lines or Lines()
    async with server, Background() as tasks:
        terms = ServerSettings(LONG, AccessPolicy(), limits or Limits(), "keep", 10)
        hub = WireServer(tasks, {"fibonacci": server}, terms)

        async def dial() -> memory.MemoryChannel:
            end, other = memory.pair(other=WHERE)
            lines.ends.append(end)
            tasks.start_soon(hub.serve, end)
            await anyio.lowlevel.checkpoint()
            return other

        async with open_connection(dial, WHERE, keeping) as connection:
            yield connection.endpoint(FIBONACCI)


async def test_what_is_sent_is_what_arrives() -> None:
    async with real(*(fib.Feedback([n]) for n in range(20)), fib.Result([9])) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        heard = []
        with anyio.fail_after(5):
            while (item := await goal.receive()) is not None:
                heard.append(FIBONACCI.feedback.decode(item.payload).partial_sequence[0])
            outcome = await goal.outcome()
        assert heard == list(range(20))
        assert FIBONACCI.result.decode(outcome.result or b"") == fib.Result([9])


async def test_the_result_of_a_goal_with_much_feedback_can_be_fetched_meanwhile() -> None:
    go = anyio.Event()
    feedback = [fib.Feedback([n]) for n in range(WINDOW)]
    async with real(go, *feedback, fib.Result([9])) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)), feedback=False)
        async with Running(lambda: endpoint.get_result(GOAL_ID)) as getting:
            go.set()
            with anyio.fail_after(5):
                assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
            assert (await getting.answer(within=0.5)).status is GoalStatus.SUCCEEDED


@in_virtual_time()
async def test_what_no_server_can_read_is_not_asked_for_ever() -> None:
    async with real(anyio.Event()) as endpoint:
        with anyio.fail_after(2), pytest.raises(ProtocolError):
            await endpoint.cancel_goals(cast("GoalID", b"short"))


@pytest.mark.parametrize("stamp", [-(2**70), -1, 1, 2**63, 2**70])
async def test_a_cancel_by_any_time_cancels_the_goals_before_it_and_no_others(stamp: int) -> None:
    async with real(anyio.Event()) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        with anyio.fail_after(5):
            answer = await endpoint.cancel_goals(stamp=stamp)
            assert answer.return_code is CancelCode.NONE
            assert answer.accepted == (stamp > goal.stamp)


@pytest.mark.parametrize(("after", "place"), [(-(2**70), 0), (-1, 0), (2**70, 2)])
async def test_a_goal_can_be_followed_behind_any_number(after: int, place: int) -> None:
    async with real(fib.Feedback([1]), fib.Feedback([2]), anyio.Event()) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        with anyio.fail_after(5):
            for _ in range(2):
                await goal.receive()
            assert (await endpoint.feedback(GOAL_ID, after=after)).cursor == place


@pytest.mark.parametrize(
    "call",
    [
        lambda connection: connection.peers("no text \udcff"),
        lambda connection: endpoint_of(connection).get_result(cast("GoalID", object())),
        lambda connection: endpoint_of(connection).send_goal(cast("GoalID", 2**70), b"goal"),
    ],
)
async def test_what_cannot_be_sent_is_an_error_of_that_call_only(
    call: Callable[[RemoteConnection], Awaitable[Any]],
) -> None:
    async with reached(Network()) as (connection, server):
        with anyio.fail_after(5), pytest.raises(ProtocolError, match="the message cannot be sent"):
            await call(connection)
        assert connection._calls._calls == {}
        await is_used(connection, server)


# What is on its way when the line dies


def in_two_parts(
    *parts: list[fib.Feedback | fib.Result], go: anyio.Event, result_timeout: float
) -> ActionServer[Any, Any, Any]:
    """A server whose goals give the first part, wait, and give the second."""

    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        for number, part in enumerate(parts):
            if number:
                await go.wait()
            for item in part:
                yield item

    return ActionServer(FIBONACCI, executor, result_timeout=result_timeout)


async def heard_of(goal: Any) -> list[int]:
    """The numbers of all feedback to the end."""
    numbers = []
    with anyio.fail_after(5):
        while (item := await goal.receive()) is not None:
            numbers.append(item.number)
    return numbers


FIRST: list[fib.Feedback | fib.Result] = [fib.Feedback([1]), fib.Feedback([2])]


@pytest.mark.parametrize("result_timeout", [10, 0])
@pytest.mark.parametrize("feedback", [True, False])
async def test_an_end_that_got_lost_with_the_line_arrives_on_the_next(
    result_timeout: float, feedback: bool
) -> None:
    go, lines = anyio.Event(), Lines()
    server = in_two_parts(FIRST, [fib.Result([9])], go=go, result_timeout=result_timeout)
    async with real(server=server, lines=lines) as endpoint:
        sent = FIBONACCI.goal.encode(fib.Goal(1))
        goal = await endpoint.send_goal(GOAL_ID, sent, feedback=feedback)
        await settled()
        lines.end.mute()
        go.set()
        await settled()
        assert goal.status is not GoalStatus.SUCCEEDED
        lines.end.cut()
        assert await heard_of(goal) == ([1, 2] if feedback else [])
        with anyio.fail_after(5):
            outcome = await goal.outcome()
        assert outcome.status is GoalStatus.SUCCEEDED
        assert FIBONACCI.result.decode(outcome.result or b"") == fib.Result([9])
        assert len(lines.ends) == 2
        if feedback:
            assert goal.dropped == 0


@pytest.mark.parametrize(
    "result_timeout",
    [
        10,
        0,
    ],
)
async def test_feedback_that_got_lost_with_the_line_arrives_on_the_next(
    result_timeout: float,
) -> None:
    go, lines = anyio.Event(), Lines()
    server = in_two_parts(
        FIRST,
        [fib.Feedback([3]), fib.Feedback([4]), fib.Result([9])],
        go=go,
        result_timeout=result_timeout,
    )
    async with real(server=server, lines=lines) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        await settled()
        lines.end.mute()
        go.set()
        await settled()
        lines.end.cut()
        assert await heard_of(goal) == [1, 2, 3, 4]
        assert goal.dropped == 0
        with anyio.fail_after(5):
            assert (await goal.outcome()).status is GoalStatus.SUCCEEDED


async def test_a_received_that_got_lost_with_the_line_is_no_goal_of_the_next() -> None:
    lines = Lines()
    async with real(*FIRST, fib.Result([9]), lines=lines) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        assert await heard_of(goal) == [1, 2]
        lines.end.cut()
        with anyio.fail_after(5):
            assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
            again = await endpoint.send_goal(
                GoalID(bytes([2] * 16)), FIBONACCI.goal.encode(fib.Goal(1))
            )
            assert await heard_of(again) == [1, 2]


# What is too large


SMALL = ClientSettings(heartbeat=LONG, window=WINDOW, max_frame=500)


async def test_a_goal_over_the_servers_limit_is_refused_here_and_the_connection_lives() -> None:
    lines = Lines()
    async with real(fib.Result([9]), lines=lines, limits=Limits(frame=500)) as endpoint:
        with anyio.fail_after(5):
            with pytest.raises(ProtocolError, match="500 are the server's limit"):
                await endpoint.send_goal(GOAL_ID, bytes(500))
            goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
            assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
        assert len(lines.ends) == 1


async def test_a_result_over_the_clients_limit_is_that_goals_error_and_no_others() -> None:
    go, lines = anyio.Event(), Lines()
    server = ScriptedServer(
        FIBONACCI,
        [fib.Feedback([1]), fib.Result([0] * 1000)],
        [fib.Feedback([1]), go, fib.Feedback([2]), fib.Result([9])],
    )
    async with real(server=server, lines=lines, keeping=SMALL) as endpoint:
        sent = FIBONACCI.goal.encode(fib.Goal(1))
        large = await endpoint.send_goal(GOAL_ID, sent)
        other = await endpoint.send_goal(GoalID(bytes([2] * 16)), sent)
        with anyio.fail_after(5):
            item = await large.receive()
            assert item is not None
            assert item.number == 1
            with pytest.raises(LimitReached, match="500 are the limit") as caught:
                await large.outcome()
            assert type(caught.value) is LimitReached
        go.set()
        assert await heard_of(other) == [1, 2]
        with anyio.fail_after(5):
            assert (await other.outcome()).status is GoalStatus.SUCCEEDED
        assert len(lines.ends) == 1


async def test_feedback_over_the_clients_limit_is_left_out_and_counted() -> None:
    lines = Lines()
    large = fib.Feedback([0] * 1000)
    many = [fib.Feedback([1]), *[large] * (3 * WINDOW), fib.Feedback([2]), large, fib.Result([9])]
    async with real(*many, lines=lines, keeping=SMALL) as endpoint:
        goal = await endpoint.send_goal(GOAL_ID, FIBONACCI.goal.encode(fib.Goal(1)))
        assert await heard_of(goal) == [1, 3 * WINDOW + 2]
        assert goal.dropped == 3 * WINDOW + 1
        with anyio.fail_after(5):
            assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
        assert len(lines.ends) == 1
