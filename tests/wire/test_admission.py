"""What a server admits: clients, their heartbeats, and how much a connection may ask at once."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import anyio
import pytest

from fibaction import Action, RejectionCode
from fibaction.border.abc import GoalRequest
from fibaction.border.event_loop import SLICE
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import Permission
from fibaction.wire.messages import (
    VERSION,
    Actions,
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    Following,
    Goodbye,
    Hello,
    ListActions,
    Peers,
    Ping,
    Places,
    Received,
    Rejected,
    SendGoal,
    Watching,
    WatchStatus,
    Welcome,
    Why,
    encode,
)
from fibaction.wire.settings import ClientSettings, Limits, WireSettings
from fibaction.words.goals import Sender
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.support.slices import SliceClock
from tests.support.virtual_time import in_virtual_time
from tests.wire.ends import (
    ANN,
    ANY,
    BOB,
    GOAL,
    A,
    B,
    C,
    Network,
    feedback,
    follow,
    held,
    kinds,
    reached,
    real,
    running,
    send,
    serving,
)
from tests.wire.memory import LONG, logged, settled

pytestmark = pytest.mark.anyio

SESSION = bytes(range(32))


# Sessions


async def test_each_client_is_told_from_the_others_by_its_owner() -> None:
    senders: list[Sender] = []

    class Noting(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        def offer_goal(self, request: GoalRequest) -> Any:
            senders.append(request.sender)
            return super().offer_goal(request)

    access = WireSettings(tokens={"sesame": "ann", "open": "bob"})
    async with serving(Noting(FIBONACCI, [anyio.Event()]), access=access) as served:
        for number, (session, token) in enumerate(
            ((ANN, "sesame"), (ANN, "sesame"), (ANN, "open"), (BOB, "sesame"), *[(b"", "open")] * 2)
        ):
            client = await served.greet(session, token)
            await client.send(1, bytes([number + 1] * 16))
    owners = [sender.owner for sender in senders]
    assert owners[0] == owners[1]
    assert len(set(owners)) == 5
    assert {len(owner) for owner in owners} == {16}
    assert not any(ANN in owner for owner in owners)
    assert [sender.name for sender in senders] == ["ann", "ann", "bob", "ann", "bob", "bob"]
    assert {sender.address for sender in senders} == {"the client"}


# A full server


async def test_the_oldest_connection_without_a_hello_makes_room_at_a_full_server() -> None:
    async with serving(held(), limits=Limits(connections=3)) as served:
        first = await served.greet(ANN)
        silent = []
        for number in range(2):
            silent.append(served.connect(f"silent {number}"))
            await settled()
        with logged() as lines:
            second = await served.greet(BOB)
            goodbye = await silent[0].hear(Goodbye)
            assert goodbye.why == Why.LIMIT
            reason = "another client needs its place, and it has not said hello"
            assert goodbye.reason.endswith(reason)
            await silent[0].hear_the_end()
        assert [(line.levelno, line.getMessage()) for line in lines] == [
            (logging.WARNING, f"silent 0: {reason}")
        ]
        await silent[1].ask(Hello(VERSION, LONG), Welcome)
        rejected = await served.connect().hear(Goodbye)
        assert rejected.reason == "the server is full: it has 3 connections"
        for client in (first, second, silent[1]):
            assert await client.is_served()


async def test_an_address_at_its_limit_has_its_own_silent_connections_ended_and_then_none() -> None:
    async with serving(held(), limits=Limits(per_address=2)) as served:
        honest, silent = served.connect("10.0.0.1:1"), served.connect("10.0.0.2:1")
        await settled()
        for port in (2, 3):
            client = served.connect(f"10.0.0.2:{port}")
            await client.ask(Hello(VERSION, LONG), Welcome)
        assert (await silent.hear(Goodbye)).why == Why.LIMIT
        rejected = await served.connect("10.0.0.2:4").hear(Goodbye)
        assert rejected.why == Why.LIMIT
        assert rejected.reason == "its address 10.0.0.2 has 2 connections, which are the most"
        await honest.ask(Hello(VERSION, LONG), Welcome)


@in_virtual_time()
async def test_silent_connections_keep_no_client_out() -> None:
    async with serving(held(), limits=Limits(connections=5)) as served:
        for _ in range(3):
            silent = [served.connect(f"silent {number}") for number in range(20)]
            for one in silent:
                one.channel.stop_reading()
            await anyio.sleep(0.1)
            client = await served.greet(b"")
            assert await client.is_served()
            await anyio.sleep(10)
            assert all(one.channel.is_cut for one in silent)
        assert len(served.wire._sessions) == 3
        assert not served.wire._unknown


# The heartbeats that a server accepts


@in_virtual_time()
async def test_a_server_limits_the_heartbeat_of_its_clients() -> None:
    async with serving(held(), limits=Limits(heartbeat=15)) as served:
        client = served.connect()
        welcome = await client.ask(Hello(VERSION, LONG), Welcome)
        assert welcome.max_heartbeat == 15
        before = anyio.current_time()
        await client.channel.cut_off()
        assert 60 < anyio.current_time() - before <= 75


@in_virtual_time()
async def test_a_client_sends_something_as_often_as_its_server_wants() -> None:
    network = Network()
    async with reached(network, ClientSettings(heartbeat=LONG)) as (_, server):
        server.channel.cut()
        server, _ = await network.reached()
        await anyio.sleep(0.2)
        await server.say(Welcome(VERSION, LONG, max_heartbeat=2.0))
        await anyio.sleep(20)
        pings = [at for at, frames in server.channel.writes if encode(Ping()) in frames]
        assert len(pings) >= 10
        assert all(after - at < 2.1 for at, after in pairwise(pings))


@in_virtual_time()
async def test_a_client_sends_a_blank_line_to_what_does_not_answer_as_a_server_would() -> None:
    network = Network()
    async with reached(network, ClientSettings(heartbeat=1.0)) as (_, server):
        server.channel.cut()
        server, _ = await network.reached()
        await anyio.sleep(2)
        sent = [frame for _, frames in server.channel.writes for frame in frames]
        assert any(b"\r\n\r\n" in frame for frame in sent)
        assert await server.hear_all() == []  # it is a `Ping` like any other
        await server.say(Welcome(VERSION, 1.0))
        await anyio.sleep(1)
        before = len(server.channel.writes)
        await anyio.sleep(2)
        later = [frame for _, frames in server.channel.writes[before:] for frame in frames]
        assert later
        assert set(later) == {encode(Ping())}


OFTEN = (
    f"too much at once: this connection follows goal {A.hex()} already 2 times, which is the limit"
)


# How often one connection may follow one goal


async def test_a_connection_follows_one_goal_so_often_and_no_more() -> None:
    async with serving(held(), limits=Limits(follows=2)) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        assert kinds(await client.ask_all(follow(None, own=False, request=2))) == [Following]
        again = follow(None, own=False, request=3)
        assert await client.ask(again, Failed) == Failed(3, Why.LIMIT, OFTEN)
        assert await client.ask(send(4), Rejected) == Rejected(4, OFTEN, RejectionCode.BUSY)
        await client.send(5, B)
        assert kinds(await other.ask_all(follow(None, own=False))) == [Following]


@pytest.mark.parametrize("own", [True, False])
async def test_a_goal_can_be_followed_again_once_a_call_has_ended(own: bool) -> None:
    async with serving(held(), limits=Limits(follows=2)) as served:
        client = await served.greet()
        await client.send(1)
        for request in range(2, 9):
            assert kinds(await client.ask_all(follow(None, own=False, request=request)))
            await client.say(Received(request))
        failed = await client.ask(Follow(9, "fibonacci", B, None, own, 1), Failed)
        assert failed.why == Why.UNKNOWN_GOAL
        await client.ask_all(CancelGoals(10, "fibonacci", A, None))
        await client.say(Received(1))
        for request in range(11, 20):
            heard = await client.ask_all(follow(None, own=own, request=request))
            assert kinds(heard) == [Following, Ended]
            await client.say(Received(request))


# The bytes of goals that wait for an answer


class Deciding:
    """Callbacks that decide on goals, and on the permission to send them, when the test says so."""

    def __init__(self) -> None:
        self.go = anyio.Event()

    async def on_goal(self, _goal: Any) -> None:
        await self.go.wait()

    async def authorize(self, *_: Any) -> bool:
        await self.go.wait()
        return True


@pytest.mark.parametrize("by", ["on_goal", "authorize"])
async def test_goals_of_one_client_wait_within_its_limit_of_memory(by: str) -> None:
    """A permission that is waited for counts as well as a decision."""
    deciding = Deciding()
    server = running(fib.Result([]), on_goal=deciding.on_goal)
    access = WireSettings(authorize=deciding.authorize) if by == "authorize" else None
    async with serving(server, access=access, limits=Limits(memory=2 * len(GOAL))) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        rejected = Rejected(
            3, f"too many bytes at once: the limit is {2 * len(GOAL)}", RejectionCode.BUSY
        )
        messages = [send(1, A, None), send(2, B, None), send(3, C, None)]
        assert await client.ask_all(*messages) == [rejected]
        assert await other.ask_all(send(3, C, None)) == []
        deciding.go.set()
        heard = await client.hear_by_id()
        assert [kinds(heard[request]) for request in (1, 2)] == [[Following, Ended]] * 2
        await client.send(3, C, None)


@pytest.mark.parametrize("by", ["on_goal", "authorize"])
async def test_goals_of_all_clients_wait_within_one_limit_of_memory(
    by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction.wire.server.session_goals.UNCOUNTED", 0)
    deciding = Deciding()
    server = running(fib.Result([]), on_goal=deciding.on_goal)
    access = WireSettings(authorize=deciding.authorize) if by == "authorize" else None
    limits = Limits(total_memory=2 * len(GOAL))
    async with serving(server, access=access, limits=limits) as served:
        clients = [await served.greet(session) for session in (ANN, BOB, b"cem" * 5 + b"!")]
        for client, goal_id in zip(clients[:2], (A, B), strict=True):
            assert await client.ask_all(send(1, goal_id, None)) == []
        text = f"too many bytes at once: the limit of all clients is {2 * len(GOAL)}"
        assert await clients[2].ask_all(send(1, C, None)) == [Rejected(1, text, RejectionCode.BUSY)]
        clients[0].channel.cut()  # what it sent is given up
        await settled()
        assert await clients[2].ask_all(send(2, C, None)) == []
        deciding.go.set()
        assert kinds(await clients[2].hear_all()) == [Following, Ended]
        assert served.wire.memory.used == 0


async def test_small_goals_of_a_client_wait_also_if_others_use_up_the_memory_of_all() -> None:
    deciding = Deciding()
    server = running(fib.Result([]), on_goal=deciding.on_goal)
    async with serving(server, limits=Limits(total_memory=1)) as served:
        served.wire.memory.take(2)
        client = await served.greet(ANN)
        assert await client.ask_all(send(1, A, None)) == []
        deciding.go.set()
        assert kinds(await client.hear_all()) == [Following, Ended]


# A goal that another client has sent


def only(*permissions: Permission, is_async: bool) -> WireSettings:
    """Return an access policy that permits these requests only."""

    async def authorize(_peer: Any, _action: str, permission: Permission) -> bool:
        await anyio.lowlevel.checkpoint()
        return permission in permissions

    if is_async:
        return WireSettings(authorize=authorize)
    return WireSettings(authorize=lambda _, __, permission: permission in permissions)


@pytest.mark.parametrize("is_async", [False, True])
@pytest.mark.parametrize("decides", [False, True])
async def test_a_goal_of_another_client_is_told_to_its_sender_only_if_it_may_observe(
    is_async: bool, decides: bool
) -> None:
    async def on_goal(_goal: Any) -> None:
        await anyio.lowlevel.checkpoint()

    server = running(
        *feedback(1), anyio.Event(), fib.Result([]), on_goal=on_goal if decides else None
    )
    access = only(Permission.SEND, is_async=is_async)
    async with serving(server, access=access) as served:
        ann, bob = await served.greet(ANN), await served.greet(BOB)
        assert kinds(await ann.ask_all(send(1))) == [Following, Feedback]
        text = "this client may not observe at the action 'fibonacci'"
        assert await bob.ask_all(send(1)) == [Failed(1, Why.FORBIDDEN, text)]
        assert kinds(await ann.ask_all(send(2))) == [Following, Feedback]


@pytest.mark.parametrize("is_behind_a_gateway", [False, True])
async def test_a_goal_that_another_client_sends_too_waits_for_its_own_client_only(
    is_behind_a_gateway: bool,
) -> None:
    steps = (*feedback(*range(50)), fib.Result([]))
    server = running(*steps, feedback_window=4, stall_timeout=1000)
    async with real(server=server) as remote, serving() as served:
        served.endpoints["fibonacci"] = remote if is_behind_a_gateway else server
        ann, bob = await served.greet(ANN), await served.greet(BOB)
        await ann.say(send(1, credit=1))
        await ann.hear_all()
        await bob.ask_all(send(1, credit=0))
        await ann.say(Credit(1, ANY))
        *told, end = await ann.hear_all()
        assert [message.number for message in told] == list(range(2, 51))
        assert isinstance(end, Ended)


async def test_a_request_with_a_long_name_does_not_wait() -> None:
    """It could wait for a permission, with as many bytes as a message may have."""
    deciding = Deciding()
    access = WireSettings(authorize=deciding.authorize)
    text = "the name of an action has at most 1000 characters"
    async with serving(held(), access=access) as served:
        client = await served.greet()
        for name, answers in (("a" * 1000, []), ("a" * 1001, [text] * 3)):
            heard = await client.ask_all(
                SendGoal(1, name, A, GOAL, 1),
                Follow(2, name, A, None, False, 1),
                CancelGoals(3, name, None, None),
            )
            assert [getattr(one, "reason", "") or one.text for one in heard] == answers
            client = await served.greet(BOB)


# Requests that concern all goals, and the statuses


WATCHED = (
    "this connection follows the statuses of the action 'fibonacci' already; close that request"
    " first"
)


async def test_a_connection_follows_the_statuses_of_an_action_once_at_a_time() -> None:
    async with serving(held()) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.ask(WatchStatus(1, "fibonacci", 1), Watching)
        again = WatchStatus(2, "fibonacci", 1)
        assert await client.ask(again, Failed) == Failed(2, Why.LIMIT, WATCHED)
        await other.ask(WatchStatus(1, "fibonacci", 1), Watching)
        # One that was closed does not count, also if its end is still to come.
        await client.say(Close(1), WatchStatus(3, "fibonacci", 1), WatchStatus(4, "fibonacci", 1))
        heard = await client.hear_by_id()
        assert {request: kinds(messages) for request, messages in heard.items()} == {
            1: [Finished],
            3: [Watching],
            4: [Failed],
        }
        await client.say(Close(3))
        await client.hear(Finished)
        await client.ask(WatchStatus(5, "fibonacci", 1), Watching)


class Counting(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
    """A server that counts what is asked of it at the same time, and answers when told to."""

    def __init__(self, name: str = "fibonacci") -> None:
        action = Action(name, goal=fib.Goal, feedback=fib.Feedback, result=fib.Result)
        super().__init__(action, [anyio.Event()])
        self.now = {"cancel": 0, "status": 0}
        self.most = dict(self.now)
        self.go = anyio.Event()

    @asynccontextmanager
    async def counted(self, kind: str) -> AsyncGenerator[None, None]:
        self.now[kind] += 1
        self.most[kind] = max(self.most[kind], self.now[kind])
        await self.go.wait()
        yield
        self.now[kind] -= 1

    async def cancel_goals(self, *args: Any, **kwargs: Any) -> Any:
        async with self.counted("cancel"):
            return await super().cancel_goals(*args, **kwargs)

    async def status(self) -> Any:
        async with self.counted("status"):
            return await super().status()


async def test_a_client_has_one_cancel_of_several_goals_and_one_list_at_work() -> None:
    server = Counting()
    async with serving(server) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        several = [(None, None), (A, 7), (bytes(16), None)]
        await client.ask_all(
            *(CancelGoals(i, "fibonacci", *which) for i, which in enumerate(several * 3)),
            *(
                message
                for i in range(10, 20)
                for message in (WatchStatus(i, "fibonacci", 1), Close(i))
            ),
        )
        places = [AskPlaces(i, "fibonacci", 1) for i in (32, 33)]
        assert await client.ask_all(AskPeers(31, "fibonacci"), *places) == []
        assert server.now == {"cancel": 1, "status": 1}
        await other.say(CancelGoals(1, "fibonacci", None, None))
        await client.say(*(CancelGoals(i, "fibonacci", A, 0) for i in range(40, 43)))
        await settled()
        assert server.now == {"cancel": 5, "status": 1}  # those of another, and of one goal each
        server.go.set()
        heard = await client.hear_by_id()
        assert kinds(await other.hear_all()) == [CancelAnswered]
        assert server.most == {"cancel": 5, "status": 1}
        told = {request: kinds(messages) for request, messages in heard.items()}
        assert told == {
            **{request: [CancelAnswered] for request in (*range(9), *range(40, 43))},
            **{request: [Watching, Finished] for request in range(10, 20)},
            31: [Peers],
            **{request: [Places] for request in (32, 33)},
        }


async def test_an_action_whose_server_does_not_answer_delays_those_of_other_actions_not() -> None:
    away, other = Counting("away"), Counting()
    other.go.set()
    async with serving(away, other) as served:
        client = await served.greet()
        await client.ask_all(CancelGoals(1, "away", None, None), WatchStatus(2, "away", 1))
        asked = CancelGoals(4, "fibonacci", None, None), WatchStatus(5, "fibonacci", 1)
        heard = await client.ask_all(ListActions(3), *asked)
        assert {*kinds(heard)} == {Actions, CancelAnswered, Watching}


async def test_statuses_that_wait_for_room_go_with_their_connection() -> None:
    server = held()
    async with serving(server, limits=Limits(queue=1)) as served:
        client = await served.greet()
        client.channel.stop_reading()
        await client.say(AwaitServer(1, "fibonacci"), AwaitServer(2, "fibonacci"))
        await settled()
        await client.say(WatchStatus(3, "fibonacci", 1))
        await settled()
        assert server._parts.logs._statuses.is_followed
        client.channel.cut()
        await settled()
        assert not server._parts.logs._statuses.is_followed


async def test_a_write_ends_when_it_has_taken_a_slice(slice_clock: SliceClock) -> None:
    """So that the goals of one connection leave the others their turns."""
    slice_clock.step = SLICE / 2  # each look at the clock takes half a slice
    async with serving(held()) as served:
        client = await served.greet()
        before = len(client.channel.writes)
        await client.say(*(send(i, bytes([i] * 16), None) for i in range(1, 41)))
        assert kinds(await client.hear_all()) == [Following] * 40
        assert max(len(frames) for _, frames in client.channel.writes[before:]) <= 4
