"""`fibaction_transports.web.http_transport`: an address of its own, over real sockets."""

from __future__ import annotations

import ssl
from contextlib import AsyncExitStack, suppress
from typing import Any

import anyio
import pytest
from anyio.streams.tls import TLSStream

from fibaction import LimitReached, Limits, connect, serve
from fibaction_transports._http import exchange, http_exchange
from fibaction_transports._http import server as server_module
from fibaction_transports._socket_lines import sockets
from fibaction_transports.web import HttpTransport
from fibaction_transports.web.http.application import WebApplication
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Goal, Result
from tests.transports.hearing import Hearing, hearing, port_of
from tests.transports.tcp.servers import new_server, works
from tests.transports.web.http_client import client_of, fetch, said_to, served
from tests.transports.web.test_rest import Held
from tests.transports.web.upgrade import UPGRADE, upgrade

pytestmark = pytest.mark.anyio

GOALS = "/actions/fibonacci/goals"
MANY = b"GET /fibaction.js HTTP/1.1\r\nHost: [::1]\r\n\r\n" * 1500
"""Requests whose answers are more than a socket holds."""


async def let_in(url: str) -> None:
    """Ask until a full server has a place for this client."""
    with anyio.fail_after(10):
        while (await fetch(url, "GET", "/actions")).status != 200:  # noqa: ASYNC110  # as a client
            await anyio.sleep(0.01)


# Addresses


async def test_it_speaks_tls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    async with served(where=f"https://127.0.0.1:0?cert={pems().cert}") as url:
        assert await works(url)
        assert await works(url.replace("https", "wss"))
        context = ssl.create_default_context(cafile=pems().ca)
        plain = await anyio.connect_tcp("127.0.0.1", port_of(url))
        async with await TLSStream.wrap(plain, hostname="127.0.0.1", ssl_context=context) as tls:
            await tls.send(b"GET /actions HTTP/1.1\r\nHost: any.example\r\n\r\n")
            assert (await tls.receive()).startswith(b"HTTP/1.1 200 OK\r\n")
            await tls.send(b"?\r\n\r\n")
            assert (await tls.receive()).startswith(b"HTTP/1.1 400 ")
        assert b"this server speaks TLS: use https://" in await said_to(url, b"GET / HTTP/1.1\r\n")


async def test_everything_is_below_the_path() -> None:
    async with served(where="http://127.0.0.1:0/arm") as url:
        at = url.removesuffix("/arm")
        answer = await fetch(at, "POST", f"/arm{GOALS}?wait=5", {"order": 1})
        assert answer.headers["location"].startswith(f"/arm{GOALS}/")
        assert (await fetch(at, "GET", GOALS)).status == 404
        assert (await fetch(at, "GET", "/army/actions")).status == 404
        assert await works(url)
        assert await works(f"{url}/")
        described = (await fetch(at, "GET", "/arm/openapi.json")).json
        assert described["servers"] == [{"url": "/arm"}]


# Requests, right and wrong


SHAKEN = ["a body", "an old version", "no key", "another subprotocol", "no host", "TLS"]
"""Requests that are rejected, at each of the places that may do so."""


@pytest.mark.parametrize(("data", "status", "reason"), [UPGRADE[name] for name in SHAKEN])
async def test_a_wrong_request_gets_its_status_and_leaves_one_line_in_the_log(
    data: bytes, status: int, reason: str, log: Hearing
) -> None:
    with hearing() as wire:
        async with served() as url, connect(url, FIBONACCI) as client:
            assert (await said_to(url, data)).startswith(b"HTTP/1.1 %d " % status)
            assert await client.call(Goal(1)) == Result([0, 1])
            await (wire if "HTTP" in "".join(wire.warnings) else log).until(f"HTTP {status}: ")
    assert len(log.warnings) + len(wire.warnings) == 1


@pytest.mark.parametrize("data", [b"", b"G", b"GET / HTTP/1.1\r\nHost:"], ids=len)
async def test_a_request_that_trickles_is_not_waited_for(data: bytes, log: Hearing) -> None:
    async with served(limits=Limits(handshake=0.1)) as url:
        said = await said_to(url, data[:1], data[1:])
        assert said.startswith(b"HTTP/1.1 408 ") is bool(data)
    assert len(log.warnings) == bool(data)


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"\r\n\r\nGET /actions HTTP/1.1\r\nHost: [::1]", 200),
        (b"GET http://127.0.0.1/actions HTTP/1.1\r\nHost: evil.example", 200),
        (b"GET HTTPS://[::1]:80/actions?x=1 HTTP/1.1\r\nHost: [::1]", 400),
        (b"GET http://127.0.0.1 HTTP/1.1\r\nHost: [::1]", 200),
        (b"GET http://127.0.0.1?x HTTP/1.1\r\nHost: [::1]", 200),
        (b"GET http://evil.example/actions HTTP/1.1\r\nHost: 127.0.0.1", 421),
        (b"GET /actions HTTP/2.0\r\nHost: [::1]", 505),
        (b"GET /actions HTTP/3.1\r\nHost: [::1]", 505),
        (b"OPTIONS * HTTP/1.1\r\nHost: [::1]", 204),
    ],
    ids=str,
)
async def test_a_request_is_read_as_its_standard_has_it(head: bytes, status: int) -> None:
    async with served() as url:
        said = await said_to(url, head + b"\r\nConnection: close\r\n\r\n")
    assert said.startswith(b"HTTP/1.1 %d " % status)


async def test_a_request_that_comes_in_pieces_is_answered() -> None:
    async with served() as url:
        pieces = b"\r\n", b"GET /actions HTTP/1.1\r", b"\nHost: [::1]\r\nConnection: close\r\n\r\n"
        assert (await said_to(url, *pieces, in_turn=True)).startswith(b"HTTP/1.1 200 ")


async def test_an_empty_line_between_two_requests_is_no_request() -> None:
    body = b'{"order": 1}'
    post = f"{POST}Content-Length: {len(body)}\r\n\r\n".encode() + body
    last = b"GET /actions HTTP/1.1\r\nHost: [::1]\r\nConnection: close\r\n\r\n"
    async with served() as url:
        assert (await said_to(url, post + b"\r\n" + last)).count(b"HTTP/1.1 20") == 2
        assert (await said_to(url, post, b"\r", b"\n", last)).count(b"HTTP/1.1 20") == 2
        async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
            await stream.send(post + last[:4])
            await stream.send_eof()
            said = b""
            with anyio.fail_after(20), suppress(anyio.EndOfStream):
                while True:
                    said += await stream.receive()
    assert said.startswith(b"HTTP/1.1 201 ")


POST = f"POST {GOALS} HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/json\r\n"


@pytest.mark.parametrize(
    ("length", "body", "status", "told"),
    [
        ("Content-Length: 100", b"{", 408, "the body has not arrived within 0.1 s"),
        ("Content-Length: 99999999", b"{", 413, "the body is larger than the limit"),
        ("Transfer-Encoding: chunked", b"fff\r\n" + bytes(0xFFF), 413, "is larger than the limit"),
        ("Transfer-Encoding: chunked", b"xyz\r\n", 400, "the body cannot be read"),
    ],
)
async def test_a_body_that_cannot_be_taken_is_told(
    length: str, body: bytes, status: int, told: str, monkeypatch: pytest.MonkeyPatch, log: Hearing
) -> None:
    monkeypatch.setattr(exchange, "BODY_TIMEOUT", 0.1)
    async with served(limits=Limits(frame=1024)) as url:
        said = await said_to(url, f"{POST}{length}\r\n\r\n".encode(), body)
        assert said.startswith(b"HTTP/1.1 %d " % status)
        assert told.encode() in said
        assert await works(url)
    assert len(log.warnings) == 1


async def test_a_body_that_nobody_asks_for_may_be_wrong() -> None:
    head = b"GET /actions HTTP/1.1\r\nHost: [::1]\r\nTransfer-Encoding: chunked\r\n\r\n"
    async with served() as url:
        assert (await said_to(url, head, b"xyz\r\n")).startswith(b"HTTP/1.1 200 ")


async def test_nothing_behind_a_request_with_two_lengths_is_answered() -> None:
    """RFC 9112, 6.1: another server on the way may have seen another end of the request."""
    first = (
        f"POST {GOALS}?wait=5 HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/json\r\n"
        "Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n"
    )
    body = b'c\r\n{"order": 3}\r\n0\r\n\r\n'
    second = b"GET /actions HTTP/1.1\r\nHost: [::1]\r\n\r\n"
    async with served() as url:
        said = await said_to(url, first.encode() + body + second)
        assert said.startswith(b"HTTP/1.1 201 ")
        assert b"connection: close" in said.lower()
        assert said.count(b"HTTP/1.1 ") == 1


async def test_bodies_count_in_the_memory_of_the_server(log: Hearing) -> None:
    async with served(limits=Limits(total_memory=100)) as url:
        answer = await fetch(url, "POST", GOALS, b" " * 1000)
        assert (answer.status, answer.headers["retry-after"]) == (503, "1")
        assert (await fetch(url, "POST", f"{GOALS}?wait=5", {"order": 1})).status == 201


async def test_a_client_that_asks_whether_to_go_on_is_told() -> None:
    head = (
        f"POST {GOALS}?wait=5 HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/json\r\n"
        f"Expect: 100-continue\r\nConnection: close\r\nContent-Length: 12\r\n\r\n"
    )
    async with served() as url, await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        await stream.send(head.encode())
        assert (await stream.receive()).startswith(b"HTTP/1.1 100 ")
        await stream.send(b'{"order": 3}')
        assert (await stream.receive()).startswith(b"HTTP/1.1 201 Created\r\n")


async def test_requests_that_come_together_are_answered_in_turn() -> None:
    request = b"GET /actions HTTP/1.1\r\nHost: [::1]\r\n\r\n"
    last = b"GET /openapi.json HTTP/1.1\r\nHost: [::1]\r\nConnection: close\r\n\r\n"
    async with served() as url:
        said = await said_to(url, request + request, last)
        assert said.count(b"HTTP/1.1 200 OK\r\n") == 3


async def test_what_comes_behind_a_request_is_kept_for_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(http_exchange, "MOST_EARLY", 1)
    body = b'{"order": 3}'
    post = (
        f"POST {GOALS}?wait=0.2 HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    ).encode() + body
    last = b"GET /actions HTTP/1.1\r\nHost: [::1]\r\nConnection: close\r\n\r\n"
    async with served(Held().server) as url:
        assert (await said_to(url, post, last, in_turn=True)).count(b"HTTP/1.1 20") == 2


# Limits, and the end


@pytest.mark.parametrize("newcomer", [b"", upgrade()])
async def test_newcomers_push_each_other_out_and_no_client_that_is_known(newcomer: bytes) -> None:
    async with served(limits=Limits(connections=2)) as url, client_of(url) as known:
        assert (await known.ask("GET", "/actions"))[0] == 200
        await known.rest()
        async with client_of(url) as second, client_of(url) as third, client_of(url) as fourth:
            for one in (second, third, fourth):
                await one.stream.send(newcomer or b"GET")
                await anyio.wait_all_tasks_blocked()
            with anyio.fail_after(5), suppress(anyio.EndOfStream, anyio.BrokenResourceError):
                while True:
                    await second.stream.receive()
            assert (await known.ask("GET", "/actions"))[0] == 200


@pytest.mark.parametrize(
    "limits", [Limits(connections=1), Limits(per_address=1)], ids=["all", "one"]
)
async def test_a_client_that_is_rejected_takes_no_place_while_it_reads_why(
    limits: Limits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "LEAVE", 60.0)
    async with served(limits=limits) as url, AsyncExitStack() as stack:
        async with connect(url, FIBONACCI) as client:
            await client.wait_for_server()
            rejected = await stack.enter_async_context(client_of(url))
            assert (await rejected.stream.receive(4)).startswith(b"HTTP")
        await let_in(url)


async def test_a_client_that_does_not_read_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "UNREAD", 0.0)
    async with served(limits=Limits(connections=1)) as url, client_of(url) as deaf:
        await deaf.stream.send(MANY)
        await deaf.stream.receive(1)
        await anyio.wait_all_tasks_blocked()
        await let_in(url)


async def test_a_client_that_may_still_read_its_answer_keeps_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server_module, "UNREAD", 1e9)
    async with served(limits=Limits(connections=1)) as url, client_of(url) as slow:
        await slow.stream.send(MANY)
        await slow.stream.receive(1)
        await anyio.wait_all_tasks_blocked()
        assert (await fetch(url, "GET", "/actions")).status == 503


async def test_a_client_that_asks_before_it_has_its_answer_makes_room() -> None:
    servers: list[Any] = []

    class Known(HttpTransport):
        def accept_lines(self, server: Any) -> Any:
            servers.append(server)
            return super().accept_lines(server)

    transport = Known(port=0, limits=Limits(connections=1))
    async with serve(new_server(), transport) as (url,), client_of(url) as hasty:
        async with servers[0].turn:
            await hasty.stream.send(b"GET /actions HTTP/1.1\r\nHost: [::1]\r\n\r\n" * 2)
            await let_in(url)


async def test_a_full_server_says_so(log: Hearing) -> None:
    async with served(limits=Limits(connections=1)) as url, connect(url, FIBONACCI) as client:
        await client.wait_for_server()
        answer = await fetch(url, "GET", "/actions")
        assert (answer.status, answer.headers["retry-after"]) == (503, "1")
        with pytest.raises(LimitReached, match="HTTP 503: the server is full: it has 1 conn"):
            async with connect(url, FIBONACCI, reconnect=False):
                pass
    assert len(log.warnings) == 2


async def test_a_client_that_is_rejected_and_reads_nothing_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sockets, "LEAVE", 0.05)
    async with served() as url:
        async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
            await stream.send(b"?\r\n\r\n")
            with pytest.raises((anyio.EndOfStream, anyio.BrokenResourceError)):
                while True:
                    await stream.receive()


async def test_a_peer_that_resets_the_connection_leaves_nothing(log: Hearing) -> None:
    import socket
    import struct

    async with served() as url:
        peer = socket.create_connection(("127.0.0.1", port_of(url)))
        peer.sendall(b"GET /actions HTTP/1.1\r\nHost: [::1]\r\n\r\n")
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        peer.close()
        assert await works(url)
    assert log.warnings == []


async def test_a_bug_ends_its_connection_only(
    monkeypatch: pytest.MonkeyPatch, log: Hearing
) -> None:
    async def broken(*_: Any) -> None:
        raise ValueError("a bug")

    async with served() as url, connect(url, FIBONACCI) as client:
        await client.wait_for_server()
        with monkeypatch.context() as patch:
            patch.setattr(WebApplication, "__call__", broken)
            assert await said_to(url, b"GET / HTTP/1.1\r\nHost: [::1]\r\n\r\n") == b""
        await log.until("the connection failed")
        await client.wait_for_server()


async def test_the_end_does_not_wait_for_clients_that_read_no_answer(log: Hearing) -> None:
    begun = anyio.current_time()
    async with served() as url, client_of(url) as deaf:
        await deaf.stream.send(MANY)
        assert (await fetch(url, "GET", "/actions")).status == 200
    assert anyio.current_time() - begun < 10
    assert len(log.warnings) <= 1
