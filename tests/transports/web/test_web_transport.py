"""`fibaction_transports.web.web_transport`: the application, as an ASGI server calls it."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any
from unittest.mock import ANY

import anyio
import pytest

from fibaction import InvalidURL, Limits, TransportError, connect, serve
from fibaction.wire.frames import FrameReader, framed
from fibaction.wire.messages import VERSION, Hello, Welcome, decode_from_server, encode
from fibaction_transports._http import application
from fibaction_transports.web import WebTransport
from fibaction_transports.web.http.application import NOT_SERVING
from tests.transports.hearing import Hearing, hearing
from tests.transports.tcp.servers import new_server
from tests.transports.web.test_rest import Held

pytestmark = pytest.mark.anyio

GOALS = "/actions/fibonacci/goals"
HELLO = framed([encode(Hello(VERSION, 60))])


class Call:
    """One call of an application, with what it says and hears."""

    def __init__(self, scope: dict[str, Any]) -> None:
        self.scope = {"headers": [(b"host", b"127.0.0.1")], "client": None, **scope}
        self.said: list[dict[str, Any]] = []
        self.broken: Exception | None = None
        """The error of an ASGI server whose client has gone."""
        self.stuck: anyio.Event | None = None
        """Set when a client that reads nothing goes on; None for one that reads."""
        self.has_returned = False
        self._to_app, self._in_app = anyio.create_memory_object_stream[dict[str, Any]](1000)
        self._spoken = anyio.Event()

    def tell(self, **message: Any) -> None:
        """Send a message to the application; `_` in its type is a dot."""
        self._to_app.send_nowait(message)

    async def next(self, *kinds: str) -> dict[str, Any]:
        """Wait for the next message of one of these types."""
        with anyio.fail_after(30):
            while not any(message["type"] in kinds for message in self.said):
                self._spoken = anyio.Event()
                await self._spoken.wait()
        index = next(at for at, message in enumerate(self.said) if message["type"] in kinds)
        return self.said.pop(index)

    async def _send(self, message: Any) -> None:
        await anyio.lowlevel.checkpoint()
        if self.stuck is not None:
            await self.stuck.wait()
        if self.broken is not None:
            raise self.broken
        self.said.append(dict(message))
        self._spoken.set()

    async def run(self, app: WebTransport) -> None:
        with self._to_app, self._in_app:
            await app(self.scope, self._in_app.receive, self._send)
        self.has_returned = True
        self._spoken.set()

    async def until_returned(self) -> None:
        """Wait until the application has returned."""
        with anyio.fail_after(10):
            while not self.has_returned:
                self._spoken = anyio.Event()
                await self._spoken.wait()


def http(method: str = "GET", path: str = "/actions", **more: Any) -> Call:
    scope = {"type": "http", "method": method, "path": path, "query_string": b"", **more}
    return Call(scope)


def websocket(*subprotocols: str, path: str = "/", **more: Any) -> Call:
    scope = {"type": "websocket", "path": path, "subprotocols": list(subprotocols), **more}
    call = Call(scope)
    call.tell(type="websocket.connect")
    return call


@asynccontextmanager
async def served(web: WebTransport, server: Any = None) -> AsyncGenerator[str, None]:
    with anyio.fail_after(20):
        async with serve(server or new_server(), web) as (url,):
            yield url


async def answer_of(app: WebTransport, call: Call) -> tuple[int, Any]:
    """The status and the JSON of an answer."""
    await call.run(app)
    start = await call.next("http.response.start")
    body = b"".join(message.get("body", b"") for message in call.said)
    return start["status"], json.loads(body) if body else None


# As a transport


def test_it_has_no_url() -> None:
    with pytest.raises(InvalidURL, match="an application has no URL"):
        WebTransport.from_url("asgi://")
    with pytest.raises(TypeError, match="has no setting 'port'"):
        WebTransport(port=80)  # type: ignore[call-arg]  # that is the mistake


async def test_it_only_serves() -> None:
    with pytest.raises(TransportError, match="connect to the address of its program"):
        async with connect(WebTransport()):
            pass
    with pytest.raises(TransportError, match="connect to the address of its program"):
        await WebTransport().open_line()


async def test_it_serves_once_at_a_time() -> None:
    web = WebTransport()
    for _ in range(2):
        async with served(web) as url:
            assert url == web.url == "asgi://"
            with pytest.raises(TransportError, match="serves already"):
                async with serve(new_server(), web):
                    pass


async def test_it_answers_while_it_serves() -> None:
    web = WebTransport()
    status, problem = await answer_of(web, http())
    assert (status, problem["detail"]) == (503, NOT_SERVING)
    async with served(web):
        assert (await answer_of(web, http()))[0] == 200
    assert (await answer_of(web, http()))[0] == 503


async def test_it_leaves_the_lifespan_to_the_program() -> None:
    with pytest.raises(TransportError, match="serve"):
        await Call({"type": "lifespan"}).run(WebTransport())


@pytest.mark.parametrize("path", ["/robot/actions", "/actions"])
async def test_it_may_be_mounted_at_a_path(path: str) -> None:
    web = WebTransport()
    async with served(web):
        assert (await answer_of(web, http(path=path, root_path="/robot")))[0] == 200
        assert (await answer_of(web, http(path="/robots/actions", root_path="/robot")))[0] == 404


async def test_the_host_is_checked_unless_there_is_tls(log: Hearing) -> None:
    web = WebTransport(hosts=["robot.example"])
    headers = [(b"host", b"evil.example")]
    async with served(web):
        assert (await answer_of(web, http(headers=headers)))[0] == 421
        assert (await answer_of(web, http(headers=headers, scheme="https")))[0] == 200
        named = [(b"host", b"robot.example")]
        assert (await answer_of(web, http(headers=named)))[0] == 200
    assert len(log.warnings) == 1


async def test_too_many_requests_at_once_are_refused(log: Hearing) -> None:
    web = WebTransport(limits=Limits(connections=1))
    async with served(web, Held().server), anyio.create_task_group() as tasks:
        waiting = http("POST", GOALS, headers=[(b"host", b"[::1]")])
        waiting.scope["headers"] += [(b"content-type", b"application/json")]
        tasks.start_soon(waiting.run, web)
        await anyio.wait_all_tasks_blocked()
        status, problem = await answer_of(web, http())
        assert (status, problem["detail"]) == (503, "the server is full: it answers 1 requests")
        waiting.tell(type="http.disconnect")


async def test_a_client_that_has_gone_is_no_error(log: Hearing) -> None:
    web = WebTransport()
    async with served(web):
        for path in ("/actions", "/nothing"):
            call = http(path=path)
            call.broken = OSError("gone")
            await call.run(web)
    assert len(log.warnings) == 1


async def test_streams_that_are_open_at_the_end_are_cut_and_no_others_begin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(application, "LEAVE_TIMEOUT", 0.2)
    web, held = WebTransport(), Held()
    headers = [(b"host", b"[::1]"), (b"content-type", b"application/json")]
    headers.append((b"accept", b"text/event-stream"))

    async def be_late() -> None:
        assert web._application is not None
        while not web._application.is_closing:
            await anyio.lowlevel.checkpoint()
        assert await answer_of(web, http()) == (503, ANY)
        late = websocket("fibaction.1")
        await late.run(web)
        assert late.said == [{"type": "websocket.close"}]

    async with held.server as server, anyio.create_task_group() as tasks:
        async with served(web, server):
            call = http("POST", GOALS, headers=headers)
            call.tell(type="http.request", body=b'{"order": 1}')
            tasks.start_soon(call.run, web)
            await call.next("http.response.body")
            tasks.start_soon(be_late)
        # The server of the action runs on, so the stream has no end.
        assert not held.canceled.is_set()
        assert call.has_returned
        held.go_on.set()


# WebSocket


async def test_the_wire_protocol_is_spoken_with_its_subprotocol() -> None:
    web = WebTransport()
    async with served(web), anyio.create_task_group() as tasks:
        call = websocket("chat", "fibaction.1", client=("10.0.0.1", 7))
        tasks.start_soon(call.run, web)
        assert (await call.next("websocket.accept"))["subprotocol"] == "fibaction.1"
        call.tell(type="websocket.receive", bytes=HELLO)
        (frame,) = FrameReader().feed((await call.next("websocket.send"))["bytes"])
        assert isinstance(decode_from_server(frame), Welcome)
        call.tell(type="websocket.disconnect", code=1001)
    assert call.said == []


@pytest.mark.parametrize("can_answer", [True, False])
@pytest.mark.parametrize(
    ("more", "status"),
    [
        ({"path": "/actions"}, 404),
        ({"subprotocols": ["fibaction.2"]}, 400),
        ({"headers": [(b"host", b"a"), (b"origin", b"http://b")]}, 421),
        ({"headers": [(b"host", b"[::1]"), (b"origin", b"http://b")]}, 403),
    ],
)
async def test_a_wrong_websocket_is_refused(
    more: dict[str, Any], status: int, can_answer: bool, log: Hearing
) -> None:
    web = WebTransport()
    extensions: dict[str, Any] = {"websocket.http.response": {}} if can_answer else {}
    async with served(web):
        call = websocket("fibaction.1", extensions=extensions)
        call.scope |= more
        await call.run(web)
    if can_answer:
        assert (await call.next("websocket.http.response.start"))["status"] == status
        assert (await call.next("websocket.http.response.body"))["body"]
    else:
        assert call.said == [{"type": "websocket.close"}]
    assert len(log.warnings) == 1


async def test_a_websocket_before_the_server_is_refused() -> None:
    call = websocket("fibaction.1")
    await call.run(WebTransport())
    assert call.said == [{"type": "websocket.close"}]


@pytest.mark.parametrize(
    ("message", "code", "reason"),
    [
        ({"bytes": (2**20).to_bytes(4, "big") + bytes(2**17)}, 1013, "busy"),
        ({"text": "{}"}, 1003, "text message"),
        ({"bytes": (2**20 + 1).to_bytes(4, "big")}, 1009, "exceeds the limit"),
        ({"bytes": b"\0\0"}, 1007, "ended within a frame"),
        ({"bytes": None, "text": "x"}, 1003, "text message"),
        ({}, 1003, "text message"),
    ],
)
async def test_a_wrong_message_ends_the_connection_with_a_code(
    message: dict[str, Any], code: int, reason: str
) -> None:
    web = WebTransport(limits=Limits(total_memory=2**16))
    with hearing() as wire:
        async with served(web):
            call = websocket("fibaction.1")
            call.tell(type="websocket.receive", bytes=HELLO)
            call.tell(type="websocket.receive", **message)
            await call.run(web)
        assert (await call.next("websocket.close"))["code"] == code
        (line,) = wire.warnings
        assert reason in line


@pytest.mark.parametrize("error", [OSError("gone"), RuntimeError("closed")])
async def test_a_websocket_that_breaks_while_writing_is_lost(error: Exception) -> None:
    web = WebTransport()
    async with served(web), anyio.create_task_group() as tasks:
        call = websocket("fibaction.1")
        tasks.start_soon(call.run, web)
        await call.next("websocket.accept")
        call.broken = error
        call.tell(type="websocket.receive", bytes=HELLO)
