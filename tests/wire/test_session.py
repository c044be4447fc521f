"""What the server's half does for its clients: a real server, and messages made by a test."""

from __future__ import annotations

import logging
import math
from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction import GoalInfo, Parent
from fibaction._runtime.text import LENGTH
from fibaction.border.abc import ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.server import ActionServer
from fibaction.testing import ScriptedServer
from fibaction.types.action import Action
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.frames import LEAST_FRAME
from fibaction.wire.messages import (
    VERSION,
    AskLog,
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Following,
    GoalChanged,
    Goodbye,
    Hello,
    ListActions,
    Operate,
    Peers,
    Ping,
    Received,
    Rerun,
    SendGoal,
    Watching,
    WatchStatus,
    Why,
)
from fibaction.wire.server.requests import ChangingEndpoints
from fibaction.wire.settings import Limits, WireSettings
from fibaction.wire.wire_server import open_server
from fibaction.words.errors import (
    ConnectionLost,
    GoalAborted,
    GoalRejected,
    InvalidTransition,
)
from fibaction.words.goals import GoalID
from fibaction.words.intake import IntakeMode
from fibaction.words.statuses import GoalEvent
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.support.virtual_time import in_virtual_time
from tests.wire import memory
from tests.wire.ends import (
    ANN,
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    GOAL_ID,
    SUCCEEDED,
    A,
    B,
    Served,
    Server,
    feedback,
    follow,
    held,
    kinds,
    observed,
    reached,
    running,
    scripted,
    send,
    serving,
    talking,
)
from tests.wire.memory import LONG, Apart, Running, logged, settled

pytestmark = pytest.mark.anyio

CLOSING = Goodbye("the server is closing the connection")
HELLO = Hello(VERSION, LONG, "right")


def texts(lines: list[logging.LogRecord]) -> list[tuple[int, str]]:
    return [(line.levelno, line.getMessage()) for line in lines]


# The handshake


def over(text: str, why: int = Why.PROTOCOL) -> tuple[Goodbye, str]:
    return Goodbye(f"the server has closed the connection: {text}", why), text


def forbidden(text: str) -> tuple[Goodbye, str]:
    return Goodbye(text, Why.FORBIDDEN), text


NO_TOKEN = forbidden("the server asks for a token, and the client gave none")
WRONG_TOKEN = forbidden("the server rejected the client's token")
WRONG: dict[str, tuple[list[Any], tuple[Goodbye, str]]] = {
    **{
        type(message).__name__: (
            [message],
            over(f"its first message was a {type(message).__name__}, not a Hello"),
        )
        for message in (ListActions(1), Ping(), Goodbye("early"))
    },
    "another version": (
        [Hello(2, LONG)],
        over("it speaks version 2 of the protocol, and this is 1"),
    ),
    "a session of another length": (
        [Hello(VERSION, LONG, "right", bytes(17))],
        over("its session has 17 bytes, and not 0, 16 or 32"),
    ),
    "messages too small": (
        [Hello(VERSION, LONG, "right", max_frame=LEAST_FRAME - 1)],
        over("it accepts messages of 1023 bytes, and not 1024 or more"),
    ),
    "two hellos": ([HELLO, HELLO], over("it said hello twice")),
    "no token": ([Hello(VERSION, LONG), ListActions(1)], NO_TOKEN),
    "a wrong token": ([Hello(VERSION, LONG, "wrong"), ListActions(1)], WRONG_TOKEN),
    "a part of the token": ([Hello(VERSION, LONG, "rigt")], WRONG_TOKEN),
    "more than the token": ([Hello(VERSION, LONG, "right ")], WRONG_TOKEN),
}


@pytest.mark.parametrize(("messages", "end"), WRONG.values(), ids=WRONG)
async def test_a_client_that_begins_in_a_wrong_way_is_told_so_and_harms_no_other(
    messages: list[Any], end: tuple[Goodbye, str]
) -> None:
    goodbye, text = end
    async with serving(held(), access=WireSettings(tokens={"right": "ann"})) as served:
        good = await served.greet(token="right")
        with logged() as lines:
            bad = served.connect("the bad one")
            await bad.say(*messages)
            assert await bad.hear(Goodbye) == goodbye
            await bad.hear_the_end()
        assert texts(lines) == [(logging.WARNING, f"the bad one: {text}")]
        assert await good.is_served()


async def test_a_client_that_leaves_is_not_answered_and_its_reason_is_one_line_of_the_log() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        with logged() as lines:
            last = Goodbye("done\nWARNING:fibaction.wire:10.0.0.1:80: all is lost" + "!" * 1000)
            await client.say(last, ListActions(1))
            await client.hear_the_end()
        ((level, text),) = texts(lines)
        assert (level, "\n" in text) == (logging.INFO, False)
        assert text.startswith("the client left: done\\x0aWARNING")
        assert len(text) < LENGTH + 100


# Goals


# As `os.fsdecode` makes it of a file name that is not UTF-8.
@pytest.mark.parametrize("error", [GoalRejected, GoalAborted])
async def test_a_reason_that_is_not_unicode_is_told_as_far_as_it_is(error: type[Exception]) -> None:
    async with serving(scripted(error("no file \udcff"))) as served:
        client = await served.greet()
        await client.say(send(1, credit=None))
        last = (await client.hear_all())[-1]
        assert last.reason.endswith("no file ?")
        assert await client.is_served()


async def test_a_client_that_wants_the_end_only_is_told_no_more() -> None:
    decide = anyio.Event()

    async def on_goal(goal: fib.Goal) -> None:
        await decide.wait()

    server = ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)
    async with serving(server) as served:
        client = await served.greet()
        # One says so with its goal, and one before the answer.
        await client.say(send(1, credit=None), send(2, B), Close(2))
        assert await client.hear_all() == []
        decide.set()
        heard = await client.hear_by_id()
        assert [kinds(heard[request]) for request in (1, 2)] == [[Following, Ended]] * 2


async def test_a_goal_that_is_sent_with_a_goodbye_is_decided_anew_when_it_is_sent_again() -> None:
    """The session is over before a task of it could wait for the answer."""
    asked = 0
    decide = anyio.Event()

    async def on_goal(goal: fib.Goal) -> None:
        nonlocal asked
        asked += 1
        await decide.wait()

    async with serving(ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)) as served:
        client = await served.greet()
        await client.say(send(1), Goodbye("never mind"))
        await client.hear_the_end()
        again = await served.greet()
        await again.say(send(1))
        await settled()
        assert asked == 2
        decide.set()
        await again.hear(Following)


# The end, and the answer to it


async def test_an_observed_goal_is_not_kept_for_the_observer() -> None:
    go = anyio.Event()
    async with serving(scripted(go, fib.Result([])), limits=Limits(goals=2)) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        for own in (False, True):  # whatever it says of itself
            await other.ask(follow(0, own=own, request=5 + own), Following)
        go.set()
        assert [kinds(heard)[-1] for heard in (await other.hear_by_id()).values()] == [Ended] * 2
        await other.say(Received(5), Received(6))
        await other.send(7, B)
        assert kinds(await client.hear_all()) == [Ended]


async def test_an_observer_may_leave_before_the_end() -> None:
    async with serving(scripted(anyio.Event()), limits=Limits(goals=2)) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        for request in (5, 6):
            await other.ask(follow(0, own=False, request=request), Following)
        await other.say(Close(5), Received(5))
        await other.ask(follow(0, own=False, request=5), Following)  # the ID can be used again
        assert (await other.ask(follow(0, own=False, request=7), Failed)).why == Why.LIMIT


async def test_an_observer_may_leave_before_the_answer() -> None:
    decided = anyio.Event()

    async def authorize(_peer: Peer, _action: str, verb: Permission) -> bool:
        if verb is Permission.OBSERVE:
            await decided.wait()
        return True

    access, limits = WireSettings(authorize=authorize), Limits(goals=1)
    async with serving(held(), access=access, limits=limits) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        await other.say(follow(0, own=False, request=5), Received(5))
        assert await other.is_served()
        decided.set()
        assert await other.hear_all() == []
        await other.send(5, B)


# Other requests


async def test_statuses_are_told_as_far_as_there_is_credit() -> None:
    async with serving(held(), access=WireSettings(tokens={"right": "ann"})) as served:
        client = await served.greet(token="right")
        stamp = (await client.send(1)).stamp
        assert await client.ask(WatchStatus(2, "fibonacci", 1), Watching) == Watching(2, 1)
        changed = await client.hear(GoalChanged)
        began_at = changed.began_at
        assert began_at is not None
        assert stamp < began_at
        ann = "ann at the client"
        assert changed == GoalChanged(2, A, stamp, EXECUTING, 0, 0, ann, began_at=began_at)
        await client.say(CancelGoals(3, "fibonacci", A, None))
        assert 2 not in await client.hear_by_id()
        await client.say(Credit(2, 0))
        assert await client.hear_all() == []
        await client.say(Credit(2, 5))
        assert [message.status for message in await client.hear_all()] == [3, 5]


async def test_where_actions_come_and_go_a_client_is_told_when_its_own_has_come() -> None:
    server, endpoints = held(), ChangingEndpoints()
    other = ScriptedServer(Action("swim", goal=int, feedback=int, result=str), ())
    settings = WireSettings(heartbeat=LONG, limits=Limits(heartbeat=LONG))
    async with server, other, open_server(endpoints, settings) as wire:
        client = await Served(wire, endpoints, settings.limits.frame).greet()
        await client.say(AwaitServer(1, "fibonacci"), AwaitServer(2, "fibonacci"), Close(1))
        assert await client.hear_all() == []
        endpoints.add(other)
        assert await client.hear_all() == []
        endpoints.add(server)
        assert await client.hear(Done) == Done(2)
        assert await client.hear_all() == []


async def test_the_clients_of_an_action_are_told_by_token_and_address_of_all_connections() -> None:
    access = WireSettings(tokens={"sesame": "ann", "open": "bob"})
    async with serving(held(), access=access) as served:
        ann = await served.greet(ANN, "sesame", name="10.0.0.7:1")
        bob = await served.greet(BOB, "open", name="10.0.0.8:2")
        await served.greet(b"", "open", name="10.0.0.9:3")
        ask = AskPeers(2, "fibonacci")
        assert await bob.ask(ask, Peers) == Peers(2, ["bob at 10.0.0.8:2"])
        both = Peers(2, ["ann at 10.0.0.7:1", "bob at 10.0.0.8:2"])
        assert await ann.ask(ask, Peers) == both


# Permissions

REQUESTS: dict[Permission, list[Any]] = {
    Permission.SEND: [send(1)],
    Permission.CANCEL: [CancelGoals(1, "fibonacci", A, None)],
    Permission.OBSERVE: [
        follow(None, own=False),
        follow(None),
        WatchStatus(1, "fibonacci", 1),
        AwaitServer(1, "fibonacci"),
        AskPeers(1, "fibonacci"),
        AskPlaces(1, "fibonacci", 1),
        Operate(1, "fibonacci"),
        AskLog(1, "fibonacci", A),
    ],
    Permission.OPERATE: [
        Operate(1, "fibonacci", IntakeMode.HOLD),
        Rerun(1, "fibonacci", A),
    ],
}


class Unasked:
    """An endpoint that can only be asked whose a goal is, which decides on the permission."""

    def owner_of(self, goal_id: GoalID) -> bytes:
        return b"of another"


@pytest.mark.parametrize(
    ("verb", "message"),
    [(verb, message) for verb, messages in REQUESTS.items() for message in messages],
    ids=lambda value: getattr(value, "name", None) or type(value).__name__,
)
async def test_a_request_that_is_not_allowed_fails_and_the_endpoint_is_not_asked(
    verb: Permission, message: Any
) -> None:
    asked = []

    def authorize(peer: Peer, action: str, wanted: Permission) -> bool:
        asked.append((peer, action, wanted))
        return wanted is not verb

    access = WireSettings(tokens={"secret": "ann"}, authorize=authorize)
    async with serving(access=access) as served:
        served.endpoints["fibonacci"] = Unasked()  # type: ignore[assignment]  # other uses fail
        client = await served.greet(token="secret")
        failed = await client.ask(message, Failed)
        text = f"this client may not {verb.value} at the action 'fibonacci'"
        assert failed == Failed(1, Why.FORBIDDEN, text)
        assert asked == [(Peer("the client", "ann"), "fibonacci", verb)]


async def test_nobody_waits_for_an_action_where_the_actions_cannot_change() -> None:
    async with serving() as served:
        client = await served.greet()
        failed = await client.ask(AwaitServer(1, "swim"), Failed)
        assert failed.why == Why.SERVER_NOT_FOUND


async def test_a_client_without_permissions_is_not_told_what_there_is() -> None:
    async with serving(access=WireSettings(authorize=lambda *_: False)) as served:
        client = await served.greet()
        assert (await client.ask(WatchStatus(1, "swim", 1), Failed)).why == Why.FORBIDDEN


@in_virtual_time()
@pytest.mark.parametrize("waits", [False, True], ids=["at once", "later"])
async def test_the_timeout_of_a_goal_begins_when_the_goal_arrives(waits: bool) -> None:
    timeouts: list[float] = []

    class Noting(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        def offer_goal(self, request: GoalRequest) -> Any:
            timeouts.append(request.deadline - anyio.current_time())
            return super().offer_goal(request)

    async def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        await anyio.sleep(2)
        return True

    access = WireSettings(authorize=authorize) if waits else WireSettings()
    async with serving(Noting(FIBONACCI, [anyio.Event()]), access=access) as served:
        client = await served.greet()
        for number, timeout in enumerate((5.0, None), 1):
            goal = SendGoal(number, "fibonacci", bytes([number] * 16), GOAL, None, timeout)
            await client.ask(goal, Following)
    assert timeouts == [pytest.approx(3 if waits else 5), math.inf]


# Errors behind the session


def raising(error: BaseException) -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server that raises that when it is asked for statuses."""

    class Raising(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        async def status(self) -> Any:
            raise error

    return Raising(FIBONACCI, [anyio.Event()])


async def test_an_error_without_a_number_is_told_as_one_of_the_server() -> None:
    error = InvalidTransition(EXECUTING, GoalEvent.EXECUTE)
    async with serving(raising(error)) as served:
        client = await served.greet()
        failed = await client.ask(WatchStatus(1, "fibonacci", 1), Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, str(error))


async def test_an_error_that_is_a_bug_fails_that_request_and_is_told_by_its_kind_only() -> None:
    async with serving(raising(ValueError("a secret"))) as served:
        client = await served.greet()
        with logged() as lines:
            failed = await client.ask(WatchStatus(1, "fibonacci", 1), Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, "the server failed: ValueError")
        assert texts(lines) == [(logging.ERROR, "the client: its WatchStatus failed")]
        assert lines[0].exc_info is not None
        await client.send(1)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # trio's cannot be raised by hand
async def test_a_permission_that_awaits_a_canceled_task_fails_that_request_only() -> None:
    async def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        await anyio.lowlevel.checkpoint()
        if verb is Permission.OBSERVE:
            raise anyio.get_cancelled_exc_class()
        return True

    async with serving(held(), access=WireSettings(authorize=authorize)) as served:
        client = await served.greet()
        failed = await client.ask(WatchStatus(1, "fibonacci", ANY), Failed)
        assert failed == Failed(1, Why.SERVER_FAILED, "the server failed: CancelledError")
        await client.send(1)


@pytest.mark.parametrize(
    ("error", "why", "text", "logs"),
    [
        (ConnectionLost("the robot is away"), Why.CONNECTION_LOST, "the robot is away", []),
        (
            ValueError("a secret"),
            Why.SERVER_FAILED,
            "the server failed: ValueError",
            [(logging.ERROR, "the stream of a goal failed")],
        ),
    ],
    ids=["an error", "a bug"],
)
async def test_a_stream_that_fails_is_told_and_the_session_goes_on(
    error: Exception, why: int, text: str, logs: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        """The streams of its goals fail from now on."""

        fails = False

        def offer_goal(self, request: GoalRequest) -> Any:
            stream: Any = super().offer_goal(request)
            take = type(stream).take

            def failing(stream: Any, limit: int = 1) -> Any:
                if self.fails:
                    raise error
                return take(stream, limit)

            monkeypatch.setattr(type(stream), "take", failing)
            return stream

    server = Failing(FIBONACCI, [anyio.Event()])
    async with serving(server, limits=Limits(goals=1)) as served:
        client = await served.greet()
        await client.send(1)
        server.fails = True
        with logged() as lines:
            failed = await client.ask(Credit(1, 1), Failed)
        assert (failed, texts(lines)) == (Failed(1, why, text), logs)
        server.fails = False
        await client.send(1, B)


async def test_a_fault_of_the_package_ends_one_session_and_is_logged_with_its_peer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serving(held()) as served:
        good, bad = await served.greet(ANN), await served.greet(BOB, name="the bad one")

        def fails(frame: bytes) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr("fibaction.wire.server.session.decode_from_client", fails)
        with logged() as lines:
            await bad.say(ListActions(1))
            await bad.hear_the_end()
        monkeypatch.undo()
        assert texts(lines) == [(logging.ERROR, "the bad one: the connection failed")]
        assert lines[0].exc_info is not None
        assert await good.is_served()


@pytest.mark.parametrize("fails", ["closing", "logging"])
async def test_what_fails_at_the_end_of_one_connection_ends_no_other(
    fails: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise OSError("the disk is full")

    async def cannot_close(_: memory.MemoryChannel) -> None:
        raise OSError(107, "not connected")

    logger = logging.getLogger("fibaction.wire")
    async with serving(held()) as served:
        good, bad = await served.greet(ANN), await served.greet(BOB)
        with monkeypatch.context() as patch:
            if fails == "closing":
                patch.setattr(memory.MemoryChannel, "aclose", cannot_close)
            else:
                patch.setattr(logger, "handlers", [Full()])
                patch.setattr(logger, "level", logging.INFO)
            bad.channel.cut()
            await settled()
        assert await good.is_served()


async def test_a_stream_that_cannot_be_left_or_drained_harms_no_other_client(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(_: FeedbackCursor) -> Any:
        raise ZeroDivisionError

    server = held()
    async with serving(server) as served:
        good, bad, worse = [await served.greet(session) for session in (b"", ANN, BOB)]
        await bad.send(1, A)
        await worse.send(1, B)
        with logged() as lines:
            with monkeypatch.context() as patch:
                patch.setattr(FeedbackCursor, "close", fails)
                await bad.say(Goodbye("done"))
                await settled()
            assert await good.is_served()
            with monkeypatch.context() as patch:
                patch.setattr(FeedbackCursor, "status", property(fails))
                await served.wire.drain()
            assert await good.hear_all() == [CLOSING]
        assert [text for level, text in texts(lines) if level == logging.ERROR] == [
            "the goals of a lost client could not be released",
            "the client: its goals could not be told",
        ]


# Several connections, and the end of the server


async def test_a_newer_connection_of_a_client_ends_the_one_before_and_no_other() -> None:
    async with serving(held(), access=WireSettings(tokens={"right": "ann"})) as served:
        other, nameless = await served.greet(BOB, "right"), await served.greet(b"", "right")
        first = await served.greet(ANN, "right", name="the first")
        stranger = served.connect()
        await stranger.say(Hello(VERSION, LONG, "guess", ANN))
        await stranger.hear(Goodbye)
        assert await first.is_served()
        await served.greet(b"", "right")
        with logged() as lines:
            second = await served.greet(ANN, "right", name="the second")
            goodbye, text = over("its client has a newer connection", Why.CONNECTION_LOST)
            assert await first.hear(Goodbye) == goodbye
            await first.hear_the_end()
        assert texts(lines) == [(logging.INFO, f"the first: {text}")]
        for client in (second, other, nameless):
            assert await client.is_served()


def waiting() -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server whose goals give two feedback messages, and wait."""
    return scripted(*feedback(1, 2), anyio.Event())


async def test_a_server_that_closes_waits_for_the_clients_that_still_read() -> None:
    server = waiting()
    async with serving(server) as served:
        client, lost = await served.greet(ANN), await served.greet(BOB)
        for number, one in enumerate((client, lost), 1):
            await one.send(1, bytes([number] * 16), credit=1)
            await one.hear(Feedback)
        await server.stop()
        async with Running(served.wire.drain) as draining:
            lost.channel.cut()
            assert await client.hear_all() == []
            assert not draining.is_done
            await client.say(Credit(1, 5))
            await draining.answer(within=0.5)
        assert kinds(await client.hear_all()) == [Feedback, Ended, Goodbye]


@in_virtual_time()
async def test_a_server_that_closes_waits_neither_for_goals_nor_long_for_clients() -> None:
    server = waiting()
    async with server:
        async with serving() as served:
            served.endpoints["fibonacci"] = server
            client, silent = await served.greet(ANN), await served.greet(BOB)
            connecting = served.connect()
            await client.send(1, B)
            await client.hear_all()
            await silent.send(1, credit=1)
            silent.channel.stop_reading()
            start = anyio.current_time()
        assert anyio.current_time() - start == pytest.approx(1)
        assert await client.hear_all() == await connecting.hear_all() == [CLOSING]
        await client.hear_the_end()
        assert silent.channel.is_cut


async def has_succeeded(server: Server) -> None:
    observer = await server.feedback(GoalID(A), after=0)
    await settled()
    assert observer.status is SUCCEEDED


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_server_whose_task_is_canceled_while_it_closes_holds_no_executor_up() -> None:
    async with talking() as server:
        apart = Apart(serving())
        served = await apart.entered()
        served.endpoints["fibonacci"] = server
        client = await served.greet()
        await client.send(1, credit=1)
        client.channel.stop_reading()
        await apart.canceled_while_it_leaves()
        await has_succeeded(server)


# What a client is told of a goal that it did not send


async def test_a_client_that_goes_on_with_its_own_goal_is_not_told_it_again() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        await client.send(1)
        client.channel.cut()
        client = await served.greet()
        assert (await client.ask(follow(0), Following)).goal is None


async def test_a_goal_over_the_clients_limit_is_left_out() -> None:
    padded = msgspec.msgpack.encode({"order": 3, "unknown": bytes(4096)})
    async with serving(held()) as served:
        sender = await served.greet()
        await sender.ask(SendGoal(1, "fibonacci", A, padded, ANY, checked=True), Following)
        small, large_enough = await served.greet(BOB, max_frame=LEAST_FRAME), await served.greet()
        assert (await small.ask(follow(None, own=False), Following)).goal is None
        assert (await large_enough.ask(follow(None, own=False), Following)).goal == padded


@pytest.mark.parametrize(("after", "told"), [(0, GOAL), (None, None)])
async def test_who_reads_an_ended_goal_of_another_one_is_told_what_was_sent(
    after: int | None, told: bytes | None
) -> None:
    async with serving(running(fib.Result([0]))) as served:
        sender, reader = await served.greet(), await served.greet(BOB)
        await sender.send(1)
        await sender.hear(Ended)
        following = await reader.ask(follow(after, own=False), Following)
        assert (following.status, following.goal) == (SUCCEEDED, told)


class GivenUp(ForwardingEndpoint):
    """A server that has given up each goal at a checkpoint."""

    checkpoint = b"\x04"

    async def feedback(self, *arguments: Any, **more: Any) -> GoalStream:
        stream: Any = await super().feedback(*arguments, **more)
        stream.checkpoint = self.checkpoint
        return cast("GoalStream", stream)


@pytest.mark.parametrize(("size", "told"), [(1, bytes(1)), (0, b""), (4096, b"")])
async def test_an_observer_is_told_the_checkpoint_of_a_goal_that_was_given_up_if_it_fits(
    size: int, told: bytes
) -> None:
    server = GivenUp(held())
    server.checkpoint = bytes(size)
    async with serving(server) as served:
        sender, observer = await served.greet(), await served.greet(BOB, max_frame=LEAST_FRAME)
        own = await sender.ask(SendGoal(1, "fibonacci", A, GOAL, ANY), Following)
        assert own.checkpoint is None
        following = await observer.ask(follow(None, own=False), Following)
        assert (following.checkpoint, following.goal) == (told, GOAL)


async def test_a_client_that_follows_a_goal_of_another_one_is_told_its_labels() -> None:
    labeled = SendGoal(1, "fibonacci", A, GOAL, ANY, None, {"order": "17", "traceparent": "00-1"})
    async with serving(held()) as served:
        sender, observer = await served.greet(), await served.greet(BOB)
        assert (await sender.ask(labeled, Following)).labels is None
        assert (await observer.ask(follow(None, own=False), Following)).labels == {"order": "17"}


async def test_a_stream_of_a_client_knows_what_it_was_told_of_the_goal() -> None:
    labels = {str(number): "" for number in range(9)}
    told = {"parent": (bytes([7] * 16), "x" * 200), "labels": labels, "checkpoint": b"4"}
    async with reached() as (connection, server):
        stream, _ = await observed(connection, server, place=3, **told)
    assert stream.checkpoint == b"4"
    parent = Parent(GoalID(bytes([7] * 16)), "x" * 99 + "…")
    fits = {str(number): "" for number in range(8)}
    info = GoalInfo(GOAL_ID, 7, EXECUTING, feedback_count=3, parent=parent, labels=fits)
    assert stream.info == info
    stream.told_info = GoalInfo(GOAL_ID, 7, EXECUTING, worker="a")
    assert stream.info == stream.told_info
