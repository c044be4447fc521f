"""`fibaction.wire.wire_server`: real sessions of a real server, side by side."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio.abc import TaskGroup

from fibaction.goals import GoalID
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.messages import (
    VERSION,
    Actions,
    AskPeers,
    Credit,
    Ended,
    Feedback,
    Following,
    Goodbye,
    Hello,
    ListActions,
    Peers,
    SendGoal,
    StatusChanged,
    Welcome,
    Why,
    decode_from_server,
)
from fibaction.wire.settings import Limits, ServerSettings
from fibaction.wire.wire_server import LEAVE_TIMEOUT, WireServer, open_server
from tests import fibonacci as fib
from tests.fibonacci import FIBONACCI
from tests.virtual_time import in_virtual_time
from tests.wire import memory
from tests.wire.memory import LONG, Apart, Peer, logged, settled

pytestmark = pytest.mark.anyio

A = bytes([1] * 16)
CLOSING = Goodbye("the server is closing the connection")


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


class Server(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
    """Its goals give two feedback messages, and wait."""

    def __init__(self) -> None:
        feedback = [fib.Feedback([1]), fib.Feedback([2])]
        super().__init__(FIBONACCI, [*feedback, anyio.Event()])


class Bench:
    """A hub, and its clients."""

    def __init__(self, hub: WireServer, tasks: TaskGroup) -> None:
        self.hub = hub
        self.tasks = tasks

    def connect(self, name: str = "the client") -> Peer:
        """A client that has said nothing yet."""
        end, other = memory.pair(name)
        self.tasks.start_soon(self.hub.serve, end)
        return Peer(other, decode_from_server)

    async def greet(self, name: str = "the client") -> Peer:
        client = self.connect(name)
        await client.say(Hello(VERSION, LONG))
        await client.hear(Welcome)
        return client


@asynccontextmanager
async def serving(
    server: ScriptedServer[Any, Any, Any] | None = None,
    *,
    access: AccessPolicy | None = None,
    limits: Limits | None = None,
) -> AsyncGenerator[Bench, None]:
    terms = ServerSettings(LONG, access or AccessPolicy(), limits or Limits(), "keep", LONG)
    async with open_server({"fibonacci": server or Server()}, terms) as connections:
        yield Bench(connections, connections.tasks)


async def send(client: Peer, goal_id: bytes, credit: int) -> None:
    await client.say(SendGoal(1, "fibonacci", goal_id, FIBONACCI.goal.encode(fib.Goal(1)), credit))
    await client.hear(Following)
    await client.hear(StatusChanged)


async def is_served(client: Peer) -> bool:
    await client.say(ListActions(9))
    return (await client.hear(Actions)).actions == [FIBONACCI.info]


async def test_clients_are_served_side_by_side() -> None:
    async with serving() as bench:
        clients = [await bench.greet() for _ in range(3)]
        for client in clients:
            assert await is_served(client)


async def test_a_newer_connection_of_a_client_ends_the_one_before_and_no_other() -> None:
    with logged() as records:
        async with serving() as bench:
            other, nameless = await bench.greet(), await bench.greet()
            clients = []
            for name in ("the first", "the second"):
                client = bench.connect(name)
                await client.say(Hello(VERSION, LONG, "", bytes([7] * 16)))
                await client.hear(Welcome)
                clients.append(client)
            await clients[0].hear_the_end()
            for client in (clients[1], other, nameless):
                assert await is_served(client)
        assert "the first: its client has a newer connection" in [
            record.getMessage() for record in records
        ]


async def test_who_uses_an_action_is_told_of_all_connections() -> None:
    async with serving() as bench:
        ann, bob = await bench.greet("10.0.0.7:1"), await bench.greet("10.0.0.8:2")
        await bench.greet("10.0.0.9:3")
        with anyio.fail_after(5):
            await bob.say(AskPeers(2, "fibonacci"))
            assert await bob.hear(Peers) == Peers(2, ["10.0.0.8:2"])
            await ann.say(AskPeers(2, "fibonacci"))
            assert await ann.hear(Peers) == Peers(2, ["10.0.0.7:1", "10.0.0.8:2"])


async def test_a_client_too_many_is_told_so_and_another_is_taken_once_there_is_room() -> None:
    async with serving(limits=Limits(connections=2)) as bench:
        first, second = await bench.greet(), await bench.greet()
        with logged() as lines:
            third = bench.connect("the third")
            goodbye = await third.hear(Goodbye)
            await third.hear_the_end()
        reason = "the server is full: it has 2 connections"
        assert goodbye == Goodbye(reason, Why.LIMIT)
        assert [(line.levelno, line.getMessage()) for line in lines] == [
            (logging.WARNING, f"the third is rejected: {reason}")
        ]
        assert await is_served(first)
        second.channel.cut()
        await settled()
        assert await is_served(await bench.greet())


async def test_a_client_too_many_that_does_not_read_holds_nobody_up() -> None:
    async with serving(limits=Limits(connections=1)) as bench:
        first = await bench.greet()
        second = bench.connect()
        second.channel.stop_reading()
        await settled()
        assert await is_served(first)
        second.channel.cut()


@pytest.mark.parametrize(
    ("messages", "level", "text"),
    [
        (
            [ListActions(1)],
            logging.WARNING,
            "the bad one: its first message was a ListActions, not a Hello",
        ),
        (
            [Hello(VERSION, LONG, "x")],
            logging.WARNING,
            "the bad one: the server rejected the client's token",
        ),
        (
            [Hello(VERSION, LONG)],
            logging.WARNING,
            "the bad one: the server asks for a token, and the client gave none",
        ),
        ([Hello(VERSION, LONG, "right"), Goodbye("done")], logging.INFO, "the bad one left: done"),
    ],
    ids=["a wrong message", "a wrong token", "no token", "a goodbye"],
)
async def test_the_end_of_a_session_is_one_line_that_names_its_peer_once_and_harms_nobody_else(
    messages: list[Any], level: int, text: str
) -> None:
    async with serving(access=AccessPolicy({"right": "ann"})) as bench:
        good = bench.connect()
        await good.say(Hello(VERSION, LONG, "right"))
        await good.hear(Welcome)
        with logged() as lines:
            await bench.connect("the bad one").say(*messages)
            await settled()
        assert [(line.levelno, line.getMessage()) for line in lines] == [(level, text)]
        assert await is_served(good)


async def test_a_token_is_in_no_line_of_the_log() -> None:
    async with serving(access=AccessPolicy({"right": "ann"})) as bench:
        with logged(logging.DEBUG) as lines:
            await bench.connect().say(Hello(VERSION, LONG, "s3cret"))
            await bench.connect().say(Hello(2, LONG, "s3cret"))
            await settled()
        assert len(lines) == 2
        assert not any("s3cret" in line.getMessage() for line in lines)


async def test_a_goodbye_of_several_lines_is_one_line_of_the_log() -> None:
    async with serving() as bench:
        client = await bench.greet()
        with logged() as lines:
            await client.say(Goodbye("done\nWARNING:fibaction.wire:10.0.0.1:80: all is lost"))
            await settled()
        (line,) = lines
        assert "\n" not in line.getMessage()


async def test_a_fault_of_the_package_ends_one_session_and_is_logged_with_its_peer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serving() as bench:
        good, bad = await bench.greet(), await bench.greet("the bad one")

        def fails(frame: bytes) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr("fibaction.wire.session.decode_from_client", fails)
        with logged() as lines:
            await bad.say(ListActions(1))
            await bad.hear_the_end()
        monkeypatch.undo()
        (line,) = lines
        assert (line.levelno, line.getMessage()) == (
            logging.ERROR,
            "the bad one: the connection failed",
        )
        assert line.exc_info is not None
        assert await is_served(good)


async def test_a_hub_that_closes_tells_each_end_before_its_goodbye() -> None:
    server = Server()
    async with server, serving(server) as bench:
        clients = [await bench.greet(), await bench.greet(), await bench.greet()]
        for number, client in enumerate(clients[:2], 1):
            await send(client, bytes([number] * 16), credit=5)
        await server.stop()
        await bench.hub.drain()
        for client in clients[:2]:
            heard = await client.hear_all()
            assert [type(message) for message in heard] == [Feedback, Feedback, Ended, Goodbye]
            assert heard[2].status == GoalStatus.ABORTED
            assert heard[2].reason == "server stopped"
            assert heard[3] == CLOSING
        assert await clients[2].hear_all() == [CLOSING]


async def test_a_hub_that_closes_waits_for_those_who_still_read() -> None:
    server = Server()
    async with server, serving(server) as bench:
        client = await bench.greet()
        await send(client, A, credit=1)
        await client.hear(Feedback)
        await server.stop()
        async with memory.Running(bench.hub.drain) as draining:
            assert not draining.is_done
            await client.say(Credit(1, 5))
            await draining.answer()
        assert [type(message) for message in await client.hear_all()] == [Feedback, Ended, Goodbye]


@in_virtual_time()
async def test_a_hub_that_closes_does_not_wait_long_for_those_who_do_not_read() -> None:
    server = Server()
    async with server:
        async with serving(server) as bench:
            client, silent = await bench.greet(), await bench.greet()
            await send(silent, A, credit=1)
            silent.channel.stop_reading()
            await server.stop()
            start = anyio.current_time()
        assert anyio.current_time() - start == pytest.approx(LEAVE_TIMEOUT)
        assert await client.hear_all() == [CLOSING]
        assert silent.channel.is_cut


async def test_every_connection_is_closed_when_the_hub_is() -> None:
    async with serving() as bench:
        clients = [await bench.greet(), bench.connect()]
        await settled()
    for client in clients:
        assert await client.hear(Goodbye) == CLOSING
        await client.hear_the_end()


async def test_an_exception_of_the_block_goes_on_as_itself() -> None:
    client: Peer | None = None
    with pytest.raises(ZeroDivisionError):
        async with serving() as bench:
            client = await bench.greet()
            raise ZeroDivisionError
    assert client is not None
    assert await client.hear(Goodbye) == CLOSING


def talking() -> ScriptedServer[Any, Any, Any]:
    """A server whose goals give more feedback than their client takes, and succeed."""
    feedback = [fib.Feedback([number]) for number in range(100)]
    return ScriptedServer(FIBONACCI, [*feedback, fib.Result([])])


async def has_succeeded(server: ScriptedServer[Any, Any, Any]) -> None:
    """Its goal has, as soon as nothing moves any more."""
    observer = await server.feedback(GoalID(A), after=0)
    await settled()
    assert observer.status is GoalStatus.SUCCEEDED


async def test_a_hub_that_has_closed_holds_no_executor_up() -> None:
    async with talking() as server:
        async with serving(server) as bench:
            await send(await bench.greet(), A, credit=1)
        await has_succeeded(server)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_hub_whose_task_is_itself_canceled_while_it_closes_holds_no_executor_up() -> None:
    async with talking() as server:
        apart = Apart(serving(server))
        client = await (await apart.entered()).greet()
        await send(client, A, credit=1)
        client.channel.stop_reading()
        await apart.canceled_while_it_leaves()
        await has_succeeded(server)
