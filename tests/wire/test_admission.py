"""The admission of clients: their sessions, the heartbeats that are accepted, and a full server."""

from __future__ import annotations

import logging
from itertools import pairwise
from typing import Any

import anyio
import pytest

from fibaction.border.abc import GoalRequest
from fibaction.testing import ScriptedServer
from fibaction.wire.codec import encode
from fibaction.wire.messages import (
    VERSION,
    Following,
    Goodbye,
    Hello,
    Ping,
    Welcome,
    Why,
)
from fibaction.wire.settings import ClientSettings, Limits, WireSettings
from fibaction.words.goals import Sender
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.support.virtual_time import in_virtual_time
from tests.wire.ends import ANN, BOB, Network, follow, held, reached, serving
from tests.wire.memory import LONG, logged, settled

pytestmark = pytest.mark.anyio

SESSION = bytes(range(32))


# Sessions


async def test_the_same_session_with_another_token_is_another_client() -> None:
    access = WireSettings(tokens={"sesame": "ann", "open": "bob", "too": "ann"})
    async with serving(held(), access=access) as served:
        ann = await served.greet(SESSION, "sesame")
        await ann.send(1)
        bob = await served.greet(SESSION, "open")
        for client in (ann, bob):
            assert await client.is_served()  # neither has ended the other
        ann.channel.cut()
        await settled()
        # It does not own the goal, so it follows it as an observer does.
        await bob.ask(follow(0, request=1), Following)
        again = await served.greet(SESSION, "too")  # another token of the same name
        await again.ask(follow(0, request=1), Following)
        assert await bob.is_served()


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
