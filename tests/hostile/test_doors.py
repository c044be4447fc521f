"""Clients that ask for much and read nothing, at each door of a server.

The server is as full of them as it may be. Honest clients get in all the same, as many as the
server has places; and it stops in its own time while others of the kind are connected.
"""

from __future__ import annotations

import json
import ssl
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
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


async def dialed(url: str) -> ByteStream:
    """Connect without a client library; nothing is read unless it is asked for."""
    scheme, _, rest = url.partition("://")
    if scheme == "unix":
        return await anyio.connect_unix(rest)
    host, _, port = rest.rpartition(":")
    if scheme not in ("tls", "https"):
        return await anyio.connect_tcp(host, int(port))
    context = ssl.create_default_context(cafile=pems().ca)
    return await anyio.connect_tcp(host, int(port), ssl_context=context)


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


@pytest.mark.asyncio
@pytest.mark.parametrize("name", DOORS)
async def test_clients_that_do_not_read_keep_no_client_out_and_no_server_from_stopping(
    name: str, tmp_path: Path
) -> None:
    door = DOORS[name]
    url = f"{door.url}{tmp_path}/door" if name == "unix" else door.url
    if url.startswith(("tls", "https")):
        url += f"?cert={pems().cert}"
    limits = {"connections": PLACES, "write": 0.5}
    settings = Settings(limits, url=url, wire={"heartbeat": 0.1})
    with started(settings) as server, anyio.fail_after(2 * PATIENCE):
        async with deaf_clients(door, server.url), AsyncExitStack() as honest:
            for _ in range(PLACES):
                await get_in(server, honest)
        async with deaf_clients(door, server.url):
            stopped, code = await server.stop(SHUTDOWN + 10)
        assert (code, stopped <= SHUTDOWN) == (0, True), stopped
        assert len(server.log.splitlines()) < LINES
