"""What a peer may send that no client would: each costs it its connection, and nobody else's."""

from __future__ import annotations

import logging
import socket
import struct
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest
from anyio.abc import SocketAttribute

from fibaction import (
    ActionClient,
    ActionServer,
    connect,
    serve,
)
from fibaction.wire.frames import FIRST_FRAME, framed, header
from fibaction.wire.messages import VERSION, Goodbye, Hello, Why, encode
from fibaction.wire.settings import Limits
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.transports.hearing import Hearing, Raw, hearing, port_of, raw

pytestmark = pytest.mark.asyncio

Client = ActionClient[Goal, Feedback, Result]
HELLO = encode(Hello(VERSION, 3600))


def pack(*values: Any) -> bytes:
    """A message that the library's own encoder would not make."""
    return msgspec.msgpack.encode(values)


class Scene:
    """A server, and a good client that must not notice anything."""

    def __init__(self, url: str, heard: Hearing, client: Client) -> None:
        self.url = url
        self.heard = heard
        self.client = client

    async def is_well(self) -> bool:
        with anyio.fail_after(30):
            return await self.client.call(Goal(3)) == Result([0, 1, 1, 2])

    async def ends(self, peer: Raw, problem: str, why: int = Why.PROTOCOL) -> list[Any]:
        """Wait until the server closes; check what it tells the peer, and what it logs."""
        messages: list[Any] = await peer.hear_all()
        assert messages[-1] == Goodbye(f"the server has closed the connection: {problem}", why)
        self.logged_once(peer, f"{peer.name}: {problem}", logging.WARNING)
        assert await self.is_well()
        return messages

    def logged_once(self, peer: Raw, text: str, level: int) -> None:
        (record,) = [one for one in self.heard.records if peer.name in one.getMessage()]
        assert record.getMessage() == text
        assert (record.levelno, record.exc_info) == (level, None)


USED = {"scheme": "tcp"}
"""The transport of this test."""


@pytest.fixture(autouse=True, params=["tcp", "ws"])
def scheme(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setitem(USED, "scheme", request.param)
    return request.param


def address() -> str:
    return f"{USED['scheme']}://127.0.0.1:0"


@asynccontextmanager
async def scene(
    server: ActionServer[Goal, Feedback, Result] | None = None, **settings: Any
) -> AsyncGenerator[Scene, None]:
    server = server or ActionServer(FIBONACCI, fibonacci)
    with hearing() as heard:
        async with serve(server, address(), **settings) as (url,):
            async with connect(url, FIBONACCI) as client:
                yield Scene(url, heard, client)


TOO_LONG = f"exceeds the limit of {FIRST_FRAME} bytes"


@pytest.mark.parametrize("length", [FIRST_FRAME + 1, 2**32 - 1])
async def test_a_length_beyond_the_limit_is_not_waited_for(length: int) -> None:
    async with scene() as here, raw(here.url) as peer:
        await peer.send(header(length))
        await here.ends(peer, f"frame of {length} bytes {TOO_LONG}")


NO_MESSAGE = "invalid client message: "
WRONG = {
    "nothing": (b"", "Input data was truncated"),
    "an unknown tag": (pack(99), "Invalid value 99 - at `$[0]`"),
    "a message of a server": (pack(32, VERSION, 1.0), "Invalid value 32 - at `$[0]`"),
    "a wrong type": (pack(24, "x"), "Expected `int`, got `str` - at `$[1]`"),
    "bad UTF-8": (b"\x93\x15\x01\xa2\xff\xff", ""),
    # More than the limit of recursion of any Python.
    "deep nesting in a field": (b"\x93\x15\x01" + b"\x91" * 100_000, ""),
}


@pytest.mark.parametrize("first", [True, False], ids=["at once", "after the hello"])
@pytest.mark.parametrize(("frame", "problem"), WRONG.values(), ids=WRONG)
async def test_a_frame_that_is_no_message_ends_the_connection(
    frame: bytes, problem: str, first: bool
) -> None:
    async with scene() as here, raw(here.url) as peer:
        await peer.say(*([] if first else [HELLO]), frame)
        messages: list[Any] = await peer.hear_all()
        assert messages[-1].why == Why.PROTOCOL
        said = messages[-1].reason.removeprefix("the server has closed the connection: ")
        if first and len(frame) > FIRST_FRAME:
            assert said.endswith(TOO_LONG)
        else:
            assert said.startswith(NO_MESSAGE + problem)
        here.logged_once(peer, f"{peer.name}: {said}", logging.WARNING)
        assert await here.is_well()


async def test_a_truncated_frame_is_told_from_a_connection_that_was_closed() -> None:
    async with scene() as here:
        for data, how in (
            (b"\x00\x00\x00\x09\x93", "in the middle of a message"),
            (b"", "its side"),
        ):
            async with raw(here.url) as peer:
                await peer.send(framed([HELLO]) + data)
                await peer.hear()
                await peer.stream.send_eof()
                await peer.hear_all()
                here.logged_once(peer, f"{peer.name} closed {how}", logging.INFO)
        assert await here.is_well()


@pytest.mark.parametrize("data", [b"", b"\x00", framed([HELLO])[:-1]], ids=["none", "one", "most"])
async def test_a_peer_that_does_not_finish_its_hello_is_not_waited_for(data: bytes) -> None:
    async with scene(limits=Limits(handshake=0.05)) as here, raw(here.url) as peer:
        await peer.send(data)
        await here.ends(peer, "it has not said hello within 0.05 s", Why.LIMIT)


@pytest.mark.load
async def test_500_connections_that_are_opened_and_closed_leave_nothing_behind() -> None:
    abort = struct.pack("ii", 1, 0)
    async with scene() as here:
        assert await here.is_well()
        before = len(anyio.get_running_tasks())
        with anyio.fail_after(50):
            for number in range(500):
                async with raw(here.url) as peer:
                    if number % 3 == 1:
                        await peer.say(HELLO)
                    elif number % 3 == 2:
                        made = peer.stream.extra(SocketAttribute.raw_socket)
                        made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, abort)
            assert await here.is_well()
            await here.heard.lines(500)
            await anyio.wait_all_tasks_blocked()
            assert len(anyio.get_running_tasks()) <= before
        assert here.heard.warnings == []
        assert len(here.heard.records) == 500


async def test_a_peer_that_is_gone_before_it_is_looked_at_is_no_local_process() -> None:
    async with scene() as here:
        with socket.create_connection(("127.0.0.1", port_of(here.url))) as peer:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        await here.heard.lines(1)
        assert "a local process" not in here.heard.records[0].getMessage()
