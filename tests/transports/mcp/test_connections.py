"""The connections of MCP over HTTP."""

from __future__ import annotations

from contextlib import AsyncExitStack, suppress
from typing import Any

import anyio
import pytest
from anyio.abc import ByteStream

from fibaction import Limits, serve
from fibaction_transports.mcp import McpHttpTransport
from tests.transports.hearing import hearing
from tests.transports.mcp.robot import PATIENCE, Robot

pytestmark = pytest.mark.asyncio

TOKEN = "tW4x9c-tW4x9c"
FLOOD = "127.0.0.9"
"""The address of a flood; every address that begins with 127 is this machine."""
HEAD = "POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\n"
WHOLE = f"{HEAD}Content-Length: 0\r\n\r\n".encode()
"""A request without a token, which is answered at once."""
BEGUN = (
    f"{HEAD}Authorization: Bearer {TOKEN}\r\nAccept: application/json, text/event-stream\r\n"
    "Content-Type: application/json\r\nExpect: 100-continue\r\nContent-Length: 100\r\n\r\n"
).encode()
"""A request whose body does not come, and is asked for: its connection is in use."""


class Clients(AsyncExitStack):
    """Connections to one server, which the block closes."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._port = int(url.rpartition(":")[2].partition("/")[0])

    async def come(self, said: bytes = b"", address: str = FLOOD) -> tuple[ByteStream, bytes]:
        """Connect from an address, say something, and return the answer, if there was one."""
        stream = await anyio.connect_tcp("127.0.0.1", self._port, local_host=address)
        self.push_async_callback(anyio.aclose_forcefully, stream)
        answer = b""
        with suppress(anyio.EndOfStream, anyio.BrokenResourceError):
            if said:
                await stream.send(said)
                answer = await stream.receive()
        return stream, answer

    async def get_in(self, said: bytes, begins: bytes) -> None:
        """Come again until the server has a place."""
        while not (await self.come(said))[1].startswith(begins):
            pass


async def ended(stream: ByteStream) -> bytes:
    """Return what the server says until it closes the connection."""
    rest = b""
    with suppress(anyio.EndOfStream, anyio.BrokenResourceError):
        while True:
            rest += await stream.receive()
    return rest


def limited(**limits: Any) -> Any:
    return serve(Robot().drive, McpHttpTransport(port=0, token=TOKEN, limits=Limits(**limits)))


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"per_address": 2}, b"its address 127.0.0.9 has 2 connections, which are the most"),
        ({"connections": 2}, b"the server is full: it has 2 connections"),
    ],
    ids=["one", "all"],
)
async def test_one_connection_too_many_is_told_so_until_another_one_ends(
    limits: dict[str, int], told: bytes
) -> None:
    with anyio.fail_after(PATIENCE), hearing("fibaction.web") as log:
        async with limited(**limits) as (url,), Clients(url) as rejected:
            async with Clients(url) as greedy:
                for _ in range(2):
                    assert (await greedy.come(BEGUN))[1].startswith(b"HTTP/1.1 100 ")
                stream, answer = await rejected.come(BEGUN)
                assert answer.startswith(b"HTTP/1.1 503 ")
                assert told in answer + await ended(stream)
            await rejected.get_in(BEGUN, b"HTTP/1.1 100 ")
    assert told.decode() in log.warnings[0]


async def test_a_flood_from_one_address_leaves_the_others_in() -> None:
    with anyio.fail_after(PATIENCE):
        async with limited(per_address=2) as (url,), Clients(url) as clients:
            for _ in range(2):
                assert (await clients.come(BEGUN))[1].startswith(b"HTTP/1.1 100 ")
            assert (await clients.come(BEGUN, "127.0.0.1"))[1].startswith(b"HTTP/1.1 100 ")


async def test_connections_that_wait_for_a_request_make_room_the_silent_ones_first() -> None:
    with anyio.fail_after(PATIENCE):
        async with limited(connections=2) as (url,), Clients(url) as clients:
            idle, answer = await clients.come(WHOLE)
            assert answer.startswith(b"HTTP/1.1 401 ")
            silent, _ = await clients.come()
            assert (await clients.come(BEGUN))[1].startswith(b"HTTP/1.1 100 ")
            assert await ended(silent) == b""
            assert (await clients.come(BEGUN))[1].startswith(b"HTTP/1.1 100 ")
            await ended(idle)


async def test_a_connection_that_asks_nothing_in_time_is_closed_and_one_that_asks_is_not() -> None:
    with anyio.fail_after(PATIENCE):
        async with limited(handshake=0.05) as (url,), Clients(url) as clients:
            asks, _ = await clients.come(BEGUN)
            silent, _ = await clients.come()
            assert await ended(silent) == b""
            with anyio.move_on_after(0.2) as waiting:
                await ended(asks)
            assert waiting.cancelled_caught


async def test_a_rejected_client_may_still_be_sending_and_reads_the_answer() -> None:
    with anyio.fail_after(PATIENCE):
        async with limited(connections=1) as (url,), Clients(url) as clients:
            assert (await clients.come(BEGUN))[1].startswith(b"HTTP/1.1 100 ")
            stream, answer = await clients.come(BEGUN)
            assert answer.startswith(b"HTTP/1.1 503 ")
            with suppress(anyio.BrokenResourceError):
                await stream.send(b"x" * 100)
            await ended(stream)
