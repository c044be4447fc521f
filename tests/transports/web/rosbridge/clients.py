"""rosbridge clients that say whatever a test wants: over a socket, and over ASGI."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any, TypeAlias

import anyio
from anyio.abc import SocketStream
from wsproto.connection import Connection, ConnectionType
from wsproto.events import BytesMessage, CloseConnection, Event, Message, Ping, Pong, TextMessage

from fibaction import serve
from fibaction.border.abc import Endpoint
from fibaction_transports.web import HttpTransport, WebTransport
from tests.support.processes import PATIENCE
from tests.transports.hearing import port_of
from tests.transports.web.test_web_transport import Call
from tests.transports.web.upgrade import upgrade


class RosbridgeClient(ABC):
    """One connection."""

    closed: tuple[int, str] | None = None
    """The code and the reason of the close by the server."""

    async def say(self, message: Any = None, **members: Any) -> None:
        """Send an operation; text and bytes as they are."""
        if isinstance(message, str | bytes):
            await self.send(message)
        else:
            await self.send(json.dumps(members if message is None else message))

    async def hear(self) -> Any:
        """The next message of the server."""
        with anyio.fail_after(PATIENCE):
            return json.loads(await self.receive())

    async def hear_until(self, op: str) -> list[Any]:
        """The messages of the server up to the next one with that operation."""
        heard = [await self.hear()]
        while heard[-1]["op"] != op:
            heard.append(await self.hear())
        return heard

    async def end(self) -> tuple[int, str]:
        """Wait until the server closes; return the code and the reason."""
        with anyio.fail_after(PATIENCE):
            while self.closed is None:
                try:
                    await self.receive()
                except anyio.EndOfStream:
                    break
        assert self.closed is not None
        return self.closed

    @abstractmethod
    async def send(self, data: str | bytes) -> None: ...

    @abstractmethod
    async def receive(self) -> str: ...

    @abstractmethod
    async def leave(self) -> None:
        """Close the connection."""


class SocketClient(RosbridgeClient):
    """A client of the server of `http://`."""

    def __init__(self, stream: SocketStream) -> None:
        self.stream = stream
        self.answers_pings = True
        self.pings = 0
        self.pongs = 0
        self._socket = Connection(ConnectionType.CLIENT)
        self._texts: deque[str] = deque()
        self._text = ""

    async def shake_hands(self, headers: dict[bytes, bytes | None]) -> bytes:
        """Send the request; return the head of the answer."""
        head = b""
        await self.stream.send(upgrade({b"Sec-WebSocket-Protocol": None, **headers}))
        while b"\r\n\r\n" not in head:
            head += await self.stream.receive()
        head, _, rest = head.partition(b"\r\n\r\n")
        await self._feed(rest)
        return head

    async def send(self, data: str | bytes) -> None:
        await self.send_events(
            TextMessage(data=data) if isinstance(data, str) else BytesMessage(data=data)
        )

    async def send_events(self, *events: Event) -> None:
        await self.stream.send(b"".join(map(self._socket.send, events)))

    async def is_heard(self) -> None:
        """Wait until the server has read everything."""
        pongs = self.pongs
        await self.send_events(Ping())
        with anyio.fail_after(PATIENCE):
            while self.pongs == pongs:
                await self._feed(await self.stream.receive())

    async def receive(self) -> str:
        while not self._texts:
            if self.closed is not None:
                raise anyio.EndOfStream
            await self._feed(await self.stream.receive())
        return self._texts.popleft()

    async def _feed(self, data: bytes) -> None:
        if data:
            self._socket.receive_data(data)
        for event in self._socket.events():
            if isinstance(event, Message):
                self._text += str(event.data)
                if event.message_finished:
                    self._texts.append(self._text)
                    self._text = ""
            elif isinstance(event, Ping):
                self.pings += 1
                if self.answers_pings:
                    await self.stream.send(self._socket.send(event.response()))
            elif isinstance(event, Pong):
                self.pongs += 1
            elif isinstance(event, CloseConnection):
                self.closed = int(event.code), event.reason or ""
                await self.stream.send(self._socket.send(event.response()))

    async def leave(self) -> None:
        await self.stream.aclose()


class AsgiClient(RosbridgeClient):
    """A client of an application, as an ASGI server calls it."""

    def __init__(self, call: Call) -> None:
        self.call = call

    async def send(self, data: str | bytes) -> None:
        kind = "text" if isinstance(data, str) else "bytes"
        self.call.tell(type="websocket.receive", **{kind: data})

    async def receive(self) -> str:
        message = await self.call.next("websocket.send", "websocket.close")
        if message["type"] == "websocket.close":
            self.closed = message["code"], message.get("reason", "")
            raise anyio.EndOfStream
        return str(message["text"])

    async def leave(self) -> None:
        self.call.tell(type="websocket.disconnect", code=1001)


Connect: TypeAlias = Callable[..., AbstractAsyncContextManager[Any]]


class Served:
    """A server, and the way to connect clients; `authorization` is the header of that name."""

    def __init__(self, connect: Connect, block: AsyncExitStack) -> None:
        self.connect = connect
        self._block = block

    async def stop(self) -> None:
        """End the server."""
        await self._block.aclose()


Serving: TypeAlias = Callable[..., AbstractAsyncContextManager[Served]]


@asynccontextmanager
async def socket_client(url: str, authorization: str = "") -> AsyncGenerator[SocketClient, None]:
    async with await anyio.connect_tcp("127.0.0.1", port_of(url)) as stream:
        client = SocketClient(stream)
        header = {b"Authorization": authorization.encode()} if authorization else {}
        head = await client.shake_hands({**header})
        assert head.startswith(b"HTTP/1.1 101 "), head
        assert b"sec-websocket-protocol" not in head.lower()
        yield client


@asynccontextmanager
async def over_sockets(*endpoints: Endpoint, **settings: Any) -> AsyncGenerator[Served, None]:
    with anyio.fail_after(30):
        async with AsyncExitStack() as block:
            transport = HttpTransport(port=0, **settings)
            (url,) = await block.enter_async_context(serve(list(endpoints), transport))
            yield Served(lambda **more: socket_client(url, **more), block)


@asynccontextmanager
async def over_asgi(*endpoints: Endpoint, **settings: Any) -> AsyncGenerator[Served, None]:
    web = WebTransport(**settings)

    @asynccontextmanager
    async def connect(authorization: str = "") -> AsyncGenerator[AsgiClient, None]:
        call = Call({"type": "websocket", "path": "/", "subprotocols": []})
        if authorization:
            call.scope["headers"].append((b"authorization", authorization.encode()))
        call.tell(type="websocket.connect")
        tasks.start_soon(call.run, web)
        assert "subprotocol" not in await call.next("websocket.accept")
        client = AsgiClient(call)
        yield client
        if not call.has_returned:
            await client.leave()

    with anyio.fail_after(30):
        async with anyio.create_task_group() as tasks, AsyncExitStack() as block:
            await block.enter_async_context(serve(list(endpoints), web))
            yield Served(connect, block)
