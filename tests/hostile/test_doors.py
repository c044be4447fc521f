"""Clients that ask for much and read nothing, at each door of a server.

The server is as full of them as it may be. Honest clients get in all the same, as many as the
server has places; and it stops in its own time while others of the kind are connected.
"""

from __future__ import annotations

import json
import ssl
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import pytest
from anyio.abc import ByteStream
from wsproto.connection import Connection, ConnectionType
from wsproto.events import BytesMessage, Ping, TextMessage

from fibaction import ConnectionLost, LimitReached, ServerNotFound, connect
from fibaction.wire.messages import VERSION, Hello
from tests.hostile.arena import PATIENCE, SHUTDOWN, Server, started
from tests.hostile.attack import sending
from tests.hostile.goal_attacks import ticking
from tests.hostile.raw_client import packed
from tests.hostile.victim import Settings
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Goal
from tests.transports.web.upgrade import upgrade

PLACES = 6
"""Connections that the server has."""
LINES = 200
"""Lines of the log, at most: more than one for each connection, and far fewer than for each
request."""


def requests(path: str) -> bytes:
    """Return many requests, whose answers are more than sockets hold."""
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode() * 1500


def events() -> bytes:
    """Return a request for the events of a goal that has much feedback."""
    goal = json.dumps({"interval": 0, "size": 50_000}).encode()
    return (
        b"POST /actions/ticker/goals HTTP/1.1\r\nHost: 127.0.0.1\r\nAccept: text/event-stream\r\n"
        b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(goal)
    ) + goal


def goal() -> bytes:
    """Return the messages of a client that wants all feedback of such a goal."""
    return packed(Hello(VERSION, 60.0), sending(1, "ticker", ticking(0.0, 50_000)))


def websocket(*messages: Any, subprotocol: bytes | None = b"fibaction.1") -> bytes:
    """Return a request for WebSocket, and messages behind it."""
    client = Connection(ConnectionType.CLIENT)
    request = upgrade({b"Sec-WebSocket-Protocol": subprotocol})
    return request + b"".join(map(client.send, messages))


def rosbridge(operation: dict[str, Any], times: int = 1) -> bytes:
    text = TextMessage(data=json.dumps(operation))
    return websocket(*[text] * times, subprotocol=None)


class Door(NamedTuple):
    """A door, and what a client says there before it reads nothing."""

    url: str
    said: Callable[[], bytes]
    repeats: bytes = b""
    """What it says again and again, so that it does not count as silent."""


SEND_GOAL = {
    "op": "send_action_goal",
    "action": "ticker",
    "args": {"interval": 0.0, "size": 50_000},
    "feedback": True,
}
NOT_SERVED = {"op": "call_service", "service": "/" + "x" * 150}
DOORS = {
    "http": Door("http://127.0.0.1:0", lambda: requests("/openapi.json")),
    "https": Door("https://127.0.0.1:0", lambda: requests("/openapi.json")),
    "console": Door("http://127.0.0.1:0", lambda: requests("/fibaction.js")),
    "events": Door("http://127.0.0.1:0", events),
    "websocket": Door("ws://127.0.0.1:0", lambda: websocket(BytesMessage(data=goal()))),
    "websocket, pings": Door(
        "http://127.0.0.1:0",
        lambda: websocket(BytesMessage(data=goal())),
        Connection(ConnectionType.CLIENT).send(Ping(payload=b"x" * 100)),
    ),
    "rosbridge": Door("http://127.0.0.1:0", lambda: rosbridge(SEND_GOAL)),
    "rosbridge, errors": Door(
        "http://127.0.0.1:0",
        lambda: rosbridge(NOT_SERVED),
        Connection(ConnectionType.CLIENT).send(TextMessage(data=json.dumps(NOT_SERVED))) * 50,
    ),
    "tcp": Door("tcp://127.0.0.1:0", goal),
    "tls": Door("tls://127.0.0.1:0", goal),
    "unix": Door("unix://", goal),
}
"""Each door that moves bytes."""


async def dialed(url: str, address: str = "127.0.0.1") -> ByteStream:
    """Connect from an address of this machine without a client library; nothing is read unless it
    is asked for.
    """
    scheme, _, rest = url.partition("://")
    if scheme == "unix":
        return await anyio.connect_unix(rest)
    host, _, port = rest.rpartition(":")
    if scheme not in ("tls", "https"):
        return await anyio.connect_tcp(host, int(port), local_host=address)
    context = ssl.create_default_context(cafile=pems().ca)
    return await anyio.connect_tcp(host, int(port), local_host=address, ssl_context=context)


@asynccontextmanager
async def deaf_clients(door: Door, url: str) -> AsyncGenerator[None, None]:
    """Fill the server with clients that read nothing."""

    async def be_deaf() -> None:
        try:
            async with await dialed(url) as stream:
                with anyio.move_on_after(1):  # the server may stop reading, too
                    await stream.send(door.said())
                connected.append(stream)
                while door.repeats:
                    await stream.send(door.repeats)
                    await anyio.sleep(0.01)
                await anyio.sleep_forever()
        except (OSError, anyio.BrokenResourceError, anyio.EndOfStream):
            connected.append(None)  # it was ended

    connected: list[object] = []
    async with anyio.create_task_group() as tasks:
        for _ in range(PLACES):
            tasks.start_soon(be_deaf)
        while len(connected) < PLACES:  # noqa: ASYNC110  # a number
            await anyio.sleep(0.01)
        yield
        tasks.cancel_scope.cancel()


async def get_in(server: Server, stack: AsyncExitStack) -> None:
    """Have a goal done on a connection of its own, which stays open."""
    tls: Any = (
        {"tls": ssl.create_default_context(cafile=pems().ca)}
        if server.url.startswith(("tls", "https"))
        else {}
    )
    while True:
        try:
            client = await stack.enter_async_context(
                connect(server.url, FIBONACCI, heartbeat=15.0, reconnect=False, **tls)
            )
            assert (await client.call(Goal(2))).sequence == [0, 1, 1]
        except (LimitReached, ConnectionLost, ServerNotFound):
            await anyio.sleep(0.05)  # as the answer 503 asks for: later
        else:
            return


def with_certificate(url: str) -> str:
    return f"{url}?cert={pems().cert}" if url.startswith(("tls", "https")) else url


@pytest.mark.asyncio
@pytest.mark.parametrize("name", DOORS)
async def test_clients_that_do_not_read_keep_no_client_out_and_no_server_from_stopping(
    name: str, tmp_path: Path
) -> None:
    door = DOORS[name]
    url = f"{door.url}{tmp_path}/door" if name == "unix" else door.url
    limits = {"connections": PLACES, "write": 0.5}
    settings = Settings(limits, url=with_certificate(url), wire={"heartbeat": 0.1})
    with started(settings) as server, anyio.fail_after(2 * PATIENCE):
        async with deaf_clients(door, server.url), AsyncExitStack() as honest:
            for _ in range(PLACES):
                await get_in(server, honest)
        async with deaf_clients(door, server.url):
            _, code = await server.stop(SHUTDOWN + 10)
        assert code == 0
        assert len(server.log.splitlines()) < LINES


FLOOD = "127.0.0.9"
"""The address of a flood; every address that begins with 127 is this machine."""
DOORS_WITH_ADDRESSES = [name for name in DOORS if name != "unix"]


async def is_served(stream: ByteStream, door: Door) -> bool:
    """Return whether a client that begins to speak now gets an answer."""
    try:
        await stream.send(door.said())
        answer = await stream.receive()
    except (OSError, anyio.BrokenResourceError, anyio.EndOfStream):
        return False
    return not (b"needs its place" in answer or b"its address" in answer)


async def connection_from(
    stack: AsyncExitStack, url: str, address: str = "127.0.0.1"
) -> ByteStream:
    """Return a connection from that address, which the block closes."""
    stream = await dialed(url, address)
    stack.push_async_callback(anyio.aclose_forcefully, stream)
    return stream


async def rest_of(stream: ByteStream) -> bytes:
    """Return what the server still sends, when it has ended the connection."""
    rest = b""
    with suppress(OSError, anyio.BrokenResourceError, anyio.EndOfStream):
        while True:
            rest += await stream.receive()
    return rest


@pytest.mark.asyncio
@pytest.mark.parametrize("name", DOORS_WITH_ADDRESSES)
async def test_a_flood_from_one_address_pushes_out_no_connection_of_another(name: str) -> None:
    door = DOORS[name]
    settings = Settings({"connections": PLACES}, url=with_certificate(door.url))
    with started(settings) as server, anyio.fail_after(PATIENCE):
        async with AsyncExitStack() as stack:
            honest = await connection_from(stack, server.url)
            for _ in range(3 * PLACES):
                await connection_from(stack, server.url, FLOOD)
            assert await is_served(honest, door)


@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["tcp", "tls", "websocket", "rosbridge"])
async def test_an_address_has_no_more_connections_in_use_than_its_limit(name: str) -> None:
    door = DOORS[name]
    settings = Settings({"per_address": 2}, url=with_certificate(door.url))
    with started(settings) as server, anyio.fail_after(PATIENCE):
        async with AsyncExitStack() as stack, AsyncExitStack() as greedy:
            for _ in range(2):
                assert await is_served(await connection_from(greedy, server.url, FLOOD), door)
            refused = await rest_of(await connection_from(stack, server.url, FLOOD))
            assert b"its address 127.0.0.9 has 2 connections, which are the most" in refused
            assert await is_served(await connection_from(stack, server.url), door)
            await greedy.aclose()
            while not await is_served(await connection_from(stack, server.url, FLOOD), door):
                pass


@pytest.mark.asyncio
@pytest.mark.parametrize("scheme", ["http", "https"])
async def test_an_address_at_its_limit_takes_the_place_of_its_own_idle_connection(
    scheme: str,
) -> None:
    door = Door(f"{scheme}://127.0.0.1:0", lambda: b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    settings = Settings({"per_address": 2}, url=with_certificate(door.url))
    with started(settings) as server, anyio.fail_after(PATIENCE):
        async with AsyncExitStack() as stack:
            honest = await connection_from(stack, server.url)
            assert await is_served(honest, door)
            flood = [await connection_from(stack, server.url, FLOOD) for _ in range(2)]
            for stream in flood:
                assert await is_served(stream, door)
            assert await is_served(await connection_from(stack, server.url, FLOOD), door)
            await rest_of(flood[0])
            assert await is_served(honest, door)


NONSENSE = 100
"""Clients that say nonsense: each is a line or more, if all are written."""


async def say_nonsense(url: str) -> None:
    """Say something that no door understands, and wait until the server ends the connection."""
    async with AsyncExitStack() as stack:
        stream = await connection_from(stack, url)
        with suppress(OSError, anyio.BrokenResourceError):
            await stream.send(b"\0 nonsense\r\n\r\n")
        await rest_of(stream)


@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["http", "https", "websocket", "tcp", "tls", "unix"])
async def test_a_flood_of_nonsense_is_few_lines_of_the_log_and_their_number(
    name: str, tmp_path: Path
) -> None:
    door = DOORS[name]
    url = f"{door.url}{tmp_path}/door" if name == "unix" else door.url
    with started(Settings(url=with_certificate(url))) as server, anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            for _ in range(NONSENSE):
                tasks.start_soon(say_nonsense, server.url)
        await server.stop(SHUTDOWN + 10)
        lines = server.log.splitlines()
        assert len(lines) < NONSENSE / 2
        assert sum("more lines like this one in" in line for line in lines) == 1
