"""`fibaction_transports.web.websocket_transport`: over real sockets."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from time import perf_counter
from typing import Any

import anyio
import pytest

from fibaction import (
    AuthenticationFailed,
    ConnectionLost,
    Limits,
    ProtocolError,
    TransportError,
    connect,
    serve,
)
from fibaction.wire import channel
from fibaction.wire.messages import VERSION, Hello, encode
from fibaction_transports._socket_lines import protocol_line
from fibaction_transports.web import WebSocketTransport
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI
from tests.transports.hearing import Hearing, port_of, raw
from tests.transports.tcp.servers import new_server, works
from tests.transports.web.http_client import said_to
from tests.transports.web.upgrade import upgrade

pytestmark = pytest.mark.anyio

WS = "ws://127.0.0.1:0"


def wss() -> str:
    return f"wss://127.0.0.1:0?cert={pems().cert}"


# Addresses


@pytest.mark.parametrize(
    ("url", "shown", "host"),
    [
        ("ws://", "ws://127.0.0.1:80", "127.0.0.1"),
        ("ws://robot:8080/", "ws://robot:8080", "robot:8080"),
        ("wss://robot/arm%20one", "wss://robot:443/arm%20one", "robot"),
        ("ws://[::1]:443", "ws://[::1]:443", "[::1]:443"),
    ],
)
def test_a_url_has_a_host_a_port_and_a_path(url: str, shown: str, host: str) -> None:
    made = WebSocketTransport.from_url(url)
    assert made.url == shown
    assert f"\r\nHost: {host}\r\n".encode() in made._client_framing().encode([])


def test_a_path_begins_with_a_slash() -> None:
    with pytest.raises(ValueError, match="path begins with /, unlike 'arm'"):
        WebSocketTransport(path="arm")


async def test_an_address_of_the_network_needs_tls() -> None:
    with pytest.raises(
        TransportError, match=r"use wss://, or, if the network is your own, append \?insec"
    ):
        async with serve(new_server(), "ws://0.0.0.0:0"):
            pass
    async with serve(new_server(), "ws://0.0.0.0:0?insecure=true") as (url,):
        assert await works(url.replace("0.0.0.0", "127.0.0.1"))


# In good order


async def test_goals_run_over_it_with_and_without_tls_and_at_a_path(
    monkeypatch: pytest.MonkeyPatch, heard: Hearing
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    for where in (WS, wss(), "ws://localhost:0/arm"):
        async with serve(new_server(), where) as (url,):
            assert await works(url)
            assert await works(url)
    assert heard.warnings == []


@pytest.mark.parametrize("where", ["ws", "wss"])
async def test_both_ends_close_without_a_wait_whichever_is_first(
    where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (channel, protocol_line):
        monkeypatch.setattr(module, "LEAVE", 60)
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    stop, urls = anyio.Event(), list[str]()
    is_up = anyio.Event()

    async def serving() -> None:
        async with serve(new_server(), WS if where == "ws" else wss()) as (url,):
            urls.append(url)
            is_up.set()
            await stop.wait()

    with anyio.fail_after(20):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(serving)
            await is_up.wait()
            async with connect(urls[0], FIBONACCI) as client:
                await client.wait_for_server()
            async with connect(urls[0], FIBONACCI, reconnect=False) as client:
                await client.wait_for_server()
                stop.set()
                with pytest.raises(ConnectionLost):
                    while True:
                        await client.wait_for_server()


async def test_a_peer_that_does_not_close_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (channel, protocol_line):
        monkeypatch.setattr(module, "LEAVE", 0.05)
    begun = perf_counter()
    async with serve(new_server(), WS) as (url,), raw(url) as peer:
        await peer.say(encode(Hello(VERSION, 60)))
        await peer.hear()
        await peer.say(encode(Hello(VERSION, 60)))
        with anyio.fail_after(5):
            with pytest.raises((anyio.EndOfStream, anyio.BrokenResourceError)):
                while True:
                    await peer.stream.receive()
    assert perf_counter() - begun < 5


async def test_a_ping_is_answered_while_nothing_else_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serve(new_server(), WS) as (url,):
        async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
            await stream.send(upgrade() + b"\x89\x82\0\0\0\0hi")
            said = b""
            with anyio.fail_after(30):
                while not said.endswith(b"\x8a\x02hi"):
                    said += await stream.receive()


async def test_a_page_that_is_closed_leaves_one_line_in_the_log(heard: Hearing) -> None:
    async with serve(new_server(), WS) as (url,):
        async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
            await stream.send(upgrade())
            assert (await stream.receive()).startswith(b"HTTP/1.1 101 ")
            await stream.send(b"\x88\x82\0\0\0\0\x03\xe9")
            assert await stream.receive() == b"\x88\x02\x03\xe9"
        record = await heard.until("the client closed: 1001")
        assert record.levelno == logging.INFO


# Bad input


@asynccontextmanager
async def scene(heard: Hearing, **settings: Any) -> AsyncGenerator[str, None]:
    """A server, and a client that must not notice anything."""
    async with serve(new_server(), WS, **settings) as (url,):
        async with connect(url, FIBONACCI) as client:
            yield url
            with anyio.fail_after(30):
                await client.wait_for_server()
    assert len(heard.warnings) == 1


@pytest.mark.parametrize("data", [b"", b"G", upgrade()[:-1], upgrade()], ids=len)
async def test_a_request_that_trickles_is_not_waited_for(data: bytes, heard: Hearing) -> None:
    async with scene(heard, limits=Limits(handshake=0.2)) as url:
        said = await said_to(url, data[:1], data[1:])
        if data != upgrade():
            assert said.startswith(b"HTTP/1.1 503 ")
        assert b"it has not said hello within 0.2 s" in said
        await heard.until("it has not said hello")


async def test_pages_of_others_may_be_let_in(heard: Hearing) -> None:
    settings = "origins=https://console.example&hosts=robot.example"
    async with serve(new_server(), f"{WS}?{settings}") as (url,):
        request = upgrade({b"Origin": b"https://console.example", b"Host": b"robot.example"})
        async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
            await stream.send(request)
            assert (await stream.receive()).startswith(b"HTTP/1.1 101 ")


# Others at the other end


async def test_the_wrong_scheme_is_told_to_both_ends(heard: Hearing) -> None:
    settings: dict[str, Any] = {"reconnect": False}
    for where, scheme, problem in (
        (WS, "tcp", "this looks like HTTP: use http:// at both ends, or check the port"),
        ("tcp://127.0.0.1:0", "ws", "it does not speak HTTP: check the port and the scheme"),
        (wss(), "ws", "HTTP 400: this server speaks TLS: use wss://"),
        (WS, "wss", "does not speak TLS: check the port, or use ws://"),
    ):
        async with serve(new_server(), where) as (url,):
            with pytest.raises((ProtocolError, AuthenticationFailed), match=problem):
                async with connect(f"{scheme}://127.0.0.1:{port_of(url)}", FIBONACCI, **settings):
                    pass
