"""A client of HTTP for tests, over h11: it sends what it is told to, right or wrong."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncGenerator, Callable, Collection
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import anyio
import h11
from anyio.abc import SocketStream

from fibaction import Endpoint, Peer, Permission, Transport, serve
from fibaction.border.http_access import headers_in
from tests.support.processes import PATIENCE
from tests.transports.hearing import port_of
from tests.transports.tcp.servers import new_server

HTTP = "http://127.0.0.1:0"


class Answer(NamedTuple):
    """What a server has answered."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def events(self) -> list[tuple[str, str, Any]]:
        """The name, the ID and the data of each server-sent event."""
        return events_in(self.body)


def events_in(body: bytes) -> list[tuple[str, str, Any]]:
    found = re.findall(r"(?:id: (.*)\n)?event: (.*)\ndata: (.*)\n\n", body.decode())
    return [(name, event_id, json.loads(data)) for event_id, name, data in found]


class HttpClient:
    """One connection."""

    def __init__(self, stream: SocketStream) -> None:
        self.stream = stream
        self._http = h11.Connection(h11.CLIENT)

    async def ask(
        self, method: str, path: str, data: Any = None, **more: str
    ) -> tuple[int, dict[str, str]]:
        """Send a request, and return the status and the headers of the answer."""
        if self._http.our_state is h11.DONE:
            self._http.start_next_cycle()
        body = data if isinstance(data, bytes) else json.dumps(data).encode()
        headers = {"host": "127.0.0.1"}
        if data is not None:
            headers |= {"content-type": "application/json", "content-length": str(len(body))}
        headers |= {name.replace("_", "-"): value for name, value in more.items()}
        sent_headers = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
        request = h11.Request(method=method, target=path, headers=sent_headers)
        sent = self._http.send(request) or b""
        if data is not None:
            sent += self._http.send(h11.Data(data=body)) or b""
        await self.stream.send(sent + (self._http.send(h11.EndOfMessage()) or b""))
        return await self.head()

    async def head(self) -> tuple[int, dict[str, str]]:
        answer = await self._next()
        assert isinstance(answer, h11.Response)
        return answer.status_code, headers_in(answer.headers)

    async def piece(self) -> bytes:
        """The next piece of the body; empty at its end."""
        event = await self._next()
        return bytes(event.data) if isinstance(event, h11.Data) else b""

    async def rest(self) -> bytes:
        """The body, up to its end."""
        body = b""
        while piece := await self.piece():
            body += piece
        return body

    async def until(self, text: str) -> bytes:
        """The body, up to that text."""
        body = b""
        while text.encode() not in body:
            piece = await self.piece()
            assert piece, f"it ended after {body!r}"
            body += piece
        return body

    async def _next(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        with anyio.fail_after(PATIENCE):
            while (event := self._http.next_event()) is h11.NEED_DATA:
                try:
                    self._http.receive_data(await self.stream.receive())
                except anyio.EndOfStream:
                    self._http.receive_data(b"")
        return event


@asynccontextmanager
async def client_of(url: str) -> AsyncGenerator[HttpClient, None]:
    """Connect to a server."""
    async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        yield HttpClient(stream)


async def fetch(url: str, method: str, path: str, data: Any = None, **headers: str) -> Answer:
    """Send one request over a connection of its own, and return the whole answer."""
    async with client_of(url) as client:
        status, answered = await client.ask(method, path, data, **headers)
        return Answer(status, answered, await client.rest())


async def said_to(url: str, *pieces: bytes, in_turn: bool = False) -> bytes:
    """Everything that a server says until it closes; in turn, each piece comes when it has read the
    one before.
    """
    said = b""
    async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        for piece in pieces:
            await stream.send(piece)
            if in_turn:
                await anyio.wait_all_tasks_blocked()
        with anyio.fail_after(PATIENCE):
            try:
                while True:
                    said += await stream.receive()
            except (anyio.EndOfStream, anyio.BrokenResourceError):
                return said


@asynccontextmanager
async def served(
    *endpoints: Endpoint, where: str | Transport = HTTP, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve endpoints, or else a server of `fibonacci`, for a block that does not last long."""
    with anyio.fail_after(PATIENCE):
        async with serve(endpoints or new_server(), where, **settings) as (url,):
            yield url


def permitting(may: Collection[Permission]) -> Callable[[Peer, str, Permission], bool]:
    """Return the rule that everyone may do what is in a collection, which a test may change."""
    return lambda _peer, _action, permission: permission in may
