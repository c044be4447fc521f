"""`Exchange`: one request of HTTP and its answer, over ASGI."""

from __future__ import annotations

import gzip
import re
from collections.abc import (
    AsyncGenerator,
    Awaitable,
    Callable,
    Generator,
    Iterable,
    MutableMapping,
)
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from hashlib import blake2b
from typing import Any, TypeAlias
from urllib.parse import parse_qs

import anyio
from anyio import CancelScope
from anyio.lowlevel import checkpoint

from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.border.http_access import Refused, headers_in
from fibaction.wire.channel import CHUNK
from fibaction.wire.frames import UNCOUNTED, FrameMemory
from fibaction.words.errors import ConnectionLost
from fibaction_transports._http.problems import PROBLEM_JSON, RETRY, Problem

Scope: TypeAlias = MutableMapping[str, Any]
Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

BODY_TIMEOUT = 30.0
"""Seconds in which the body of a request must have arrived."""
WRITE_TIMEOUT = 30.0
"""Seconds in which a client must take a piece of an answer, if the server has no limit for it."""
WITHOUT_BODY = (204, 304)
"""The statuses of answers that have no body, and so no length of one (RFC 9110, 8.6)."""
EVENT_STREAM = "text/event-stream"
JSON = "application/json"
COMMON_HEADERS = (
    ("Cache-Control", "no-store"),
    ("Content-Security-Policy", "default-src 'none'; frame-ancestors 'none'"),
    ("X-Content-Type-Options", "nosniff"),
)
"""Headers of every answer that does not have its own."""

_PREFERS_WAIT = re.compile(r"(?:^|,)\s*wait\s*=\s*\"?(\d{1,9})\"?\s*(?:;|,|$)", re.IGNORECASE)
_TAKES_GZIP = re.compile(r"(?:^|,)\s*gzip\s*(?:;(?!\s*q=0(?:\.0*)?\s*(?:,|$))|,|$)", re.IGNORECASE)
SMALLEST_PACKED = 1024
"""Bytes of an answer that is compressed for clients that take it."""
VARY = (("Vary", "Accept-Encoding"),)
"""The header of an answer that is compressed for some clients."""
PACKING = 5
"""The level of the compression."""
LARGE = 2**16
"""Bytes of an answer that is compressed in a thread."""
_NUMBER = re.compile(r"-?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def tag_of(body: bytes) -> str:
    """Return the `ETag` of a body: another one for each content."""
    return f'"{blake2b(body, digest_size=12).hexdigest()}"'


def peer_of(scope: Scope) -> str:
    """Return the address of the client, for logs."""
    client = scope.get("client")
    return f"{client[0]}:{client[1]}" if client else "a web client"


def path_of(scope: Scope) -> str:
    """Return the path below the root of the application."""
    path: str = scope["path"]
    root: str = scope.get("root_path", "").rstrip("/")
    return path[len(root) :] if root and f"{path}/".startswith(f"{root}/") else path


class Exchange:
    """One request and its answer."""

    def __init__(
        self,
        scope: Scope,
        receive: Receive,
        send: Send,
        write_timeout: float = WRITE_TIMEOUT,
        answers: FrameMemory | None = None,
    ) -> None:
        """Let a client take that long for a piece of the answer; count a large one while it is
        written, if there is a memory for that.
        """
        self.scope = scope
        self.method: str = scope["method"]
        self.path = path_of(scope)
        self.root: str = scope.get("root_path", "").rstrip("/")
        self.headers = headers_in(scope["headers"])
        self.peer = peer_of(scope)
        self.has_tls: bool = scope.get("scheme") == "https"
        self.has_begun = False
        """True if the answer has begun."""
        self.more_headers: list[tuple[str, str]] = []
        """Headers that the answer has next to its own."""
        query: str = scope.get("query_string", b"").decode("latin-1")
        self.query = parse_qs(query, keep_blank_values=True)
        """The parameters after the `?`, each with its values."""
        self._receive = receive
        self._send = send
        self._write_timeout = write_timeout
        self._answers = answers
        self._start: Message | None = None  # of the answer, until its first piece
        self._held: CountedBytes | None = None
        self._writing: CancelScope | None = None  # of a large answer

    # The request

    def parameter(self, name: str) -> str | None:
        """Return a parameter after the `?`, the last one of several; None if it is not there."""
        return self.query.get(name, [None])[-1]

    def seconds(self, name: str, most: float) -> float | None:
        """Return a parameter that is a number of seconds; None if it is not there.

        Raises:
            Refused: It is not a number, or out of range.
        """
        text = self.parameter(name)
        if text is None:
            return None
        if _NUMBER.fullmatch(text) and 0 <= (seconds := float(text)) <= most:
            return seconds
        raise Refused(400, f"{name} is a number of seconds between 0 and {most:g}")

    def wait_wanted(self, most: float) -> float | None:
        """Return the seconds that the answer may wait: the parameter `wait`, or that preference
        (RFC 7240), which the answer then tells; None if neither is there.

        Raises:
            Refused: The parameter is wrong.
        """
        seconds = self.seconds("wait", most)
        found = _PREFERS_WAIT.search(self.headers.get("prefer", ""))
        if seconds is None and found:
            seconds = min(float(found[1]), most)
            self.more_headers.append(("Preference-Applied", f"wait={seconds:g}"))
        return seconds

    @property
    def wants_events(self) -> bool:
        """True if the client asks for a stream of events."""
        return EVENT_STREAM in self.headers.get("accept", "").lower()

    async def json_body(self, limit: int, memory: ByteBudget) -> bytes:
        """Return the body, as `body` does. An empty one may have any type.

        Raises:
            Refused: It is not JSON by its type; or as for `body`.
            ConnectionLost: The client has gone.
        """
        kind = self.headers.get("content-type", "").partition(";")[0].strip().lower()
        is_announced = self.headers.get("content-length", "0") != "0"
        if kind != JSON and (is_announced or await self.body(limit, memory)):
            raise Refused(415, f"the body must be {JSON}: set the header Content-Type")
        if self.headers.get("content-encoding", "identity").strip().lower() != "identity":
            text = "the body must not be compressed: leave out the header Content-Encoding"
            raise Refused(415, text, ("Accept-Encoding", "identity"))
        return await self.body(limit, memory) if kind == JSON else b""

    async def body(self, limit: int, memory: ByteBudget) -> bytes:
        """Return the body, whose bytes count in the memory for as long as this exchange lasts.

        Raises:
            Refused: It is larger than the limit, or slow; or the memory is used up.
            ConnectionLost: The client has gone.
        """
        length = self.headers.get("content-length", "")
        if length.isdecimal() and int(length[:20]) > limit:
            raise _too_large(limit)
        self._held = CountedBytes(memory, 0)
        with anyio.move_on_after(BODY_TIMEOUT):
            return await self._body(limit, memory, self._held)
        raise Refused(408, f"the body has not arrived within {BODY_TIMEOUT:g} s")

    async def _body(self, limit: int, memory: ByteBudget, held: CountedBytes) -> bytes:
        body = bytearray()
        while True:
            message = await self._receive()
            if message["type"] == "http.disconnect":
                raise ConnectionLost(f"{self.peer} has gone")
            body += message.get("body", b"")
            if len(body) > limit:
                raise _too_large(limit)
            held.resize(len(body))
            if not memory.has_room():
                raise Refused(503, "the server is busy: it has no room for the body", RETRY)
            if not message.get("more_body", False):
                return bytes(body)

    async def _gone(self) -> None:
        """Wait until the client has gone."""
        with suppress(Refused):  # the rest of a body that nobody has asked for
            while (await self._receive())["type"] != "http.disconnect":
                pass

    @asynccontextmanager
    async def until_gone(self) -> AsyncGenerator[CancelScope, None]:
        """Cancel the block if the client goes; the scope says so afterwards."""
        with CancelScope() as scope:
            async with anyio.create_task_group() as tasks:

                async def watch() -> None:
                    await self._gone()
                    scope.cancel()

                tasks.start_soon(watch)
                yield scope
                tasks.cancel_scope.cancel()

    async def hand_to(
        self, app: App, state: dict[str, Any], limit: int, memory: ByteBudget
    ) -> None:
        """Let an application of others answer, which has that state in its scope.

        Its client may take as long as for any other answer, and what it writes for a client that
        has gone is nothing: then it receives the end, and may finish what it has begun.

        Raises:
            Refused, ConnectionLost: There is no body for it, see `body`.
        """
        pieces = [{"type": "http.request", "body": await self.body(limit, memory)}]
        listening = CancelScope()

        async def receive() -> Message:
            if pieces:
                return pieces.pop()
            with listening:
                await self._gone()
            return {"type": "http.disconnect"}

        async def write(body: bytes, *, has_more: bool) -> None:
            try:
                await self._write(body, has_more=has_more)
            except ConnectionLost:
                listening.cancel()

        async def send(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.has_begun, self._start = True, message
                more = [(name.encode(), value.encode()) for name, value in self.more_headers]
                message["headers"] = headers = [*message["headers"], *more]
                if any(value.startswith(b"text/event-stream") for _, value in headers):
                    await write(b"", has_more=True)  # the client waits for the head
            elif not listening.cancel_called:
                body = message.get("body", b"") if self.method != "HEAD" else b""
                await write(body, has_more=message.get("more_body", False))

        scope = {**self.scope, "state": {**self.scope.get("state", {}), **state}}
        await app(scope, receive, send)

    # The answer

    async def answer(
        self, status: int, body: bytes, *headers: tuple[str, str], kind: str = JSON
    ) -> None:
        """Answer with a body of that media type; if it is empty, without one."""
        if body:
            headers = (*headers, ("Content-Type", kind))
        if len(body) >= SMALLEST_PACKED:
            body, headers = await self._packed(body, headers)
        if status not in WITHOUT_BODY:
            headers = (*headers, ("Content-Length", str(len(body))))
        self._begin(status, headers)
        if self.method == "HEAD":  # whose answer has no body, whatever its length says
            body = b""
        with self._counted(max(0, len(body) - UNCOUNTED)):
            for start in range(0, len(body) or 1, CHUNK):
                piece, has_more = body[start : start + CHUNK], start + CHUNK < len(body)
                await self._write(piece, has_more=has_more)

    async def answer_unless_known(
        self, body: bytes, tag: str, *headers: tuple[str, str], kind: str = JSON
    ) -> None:
        """Answer with a body that has that `ETag`, or say that the client's copy is up to date."""
        known = self.headers.get("if-none-match", "").replace("W/", "")
        headers = (("ETag", tag), ("Cache-Control", "no-cache"), *headers)
        if known == "*" or tag in (one.strip() for one in known.split(",")):
            vary = VARY if len(body) >= SMALLEST_PACKED else ()  # RFC 9110, 15.4.5
            await self.answer(304, b"", *headers, *vary)
        else:
            await self.answer(200, body, *headers, kind=kind)

    async def _packed(
        self, body: bytes, headers: tuple[tuple[str, str], ...]
    ) -> tuple[bytes, tuple[tuple[str, str], ...]]:
        """Return the body, compressed if the client takes that, and its headers."""
        headers = (*headers, *VARY)
        if not _TAKES_GZIP.search(self.headers.get("accept-encoding", "")):
            return body, headers
        pack = partial(gzip.compress, body, PACKING, mtime=0)
        body = pack() if len(body) < LARGE else await anyio.to_thread.run_sync(pack)
        # It has other bytes now, which a strong tag does not have (RFC 9110, 8.8.1).
        weak = [(name, f"W/{value}" if name == "ETag" else value) for name, value in headers]
        return body, (*weak, ("Content-Encoding", "gzip"))

    @contextmanager
    def _counted(self, size: int) -> Generator[None, None, None]:
        """Count so many bytes of an answer that is being written.

        Raises:
            ConnectionLost: Their memory is needed, and the client does not take them.
        """
        if not size or self._answers is None:
            yield
            return
        with CancelScope() as self._writing:
            self._answers.hold(self, size)
            try:
                yield
            finally:
                self._answers.hold(self, 0)
        if self._writing.cancelled_caught:
            raise ConnectionLost(f"{self.peer} takes too long for a large answer at a busy server")

    def give_up(self) -> None:
        """End the answer, whose memory is needed."""
        assert self._answers is not None
        assert self._writing is not None
        self._answers.hold(self, 0)
        self._writing.cancel()

    async def tell(self, problem: Problem) -> None:
        """Answer with a problem."""
        await self.answer(problem.status, problem.body, *problem.headers, kind=PROBLEM_JSON)

    def begin_events(self, status: int, *headers: tuple[str, str]) -> None:
        """Begin to answer with a stream of events."""
        self.begin_stream(status, EVENT_STREAM, *headers, ("X-Accel-Buffering", "no"))

    def begin_stream(self, status: int, kind: str, *headers: tuple[str, str]) -> None:
        """Begin to answer with a body of that media type, which is written piece by piece."""
        self._begin(status, [*headers, ("Content-Type", kind)])

    async def write(self, data: bytes) -> None:
        """Write a piece of a stream.

        Raises:
            ConnectionLost: The client has gone, or takes too long.
        """
        await self._write(data, has_more=True)

    async def end(self) -> None:
        """End a stream."""
        await self._write(b"", has_more=False)

    def _begin(self, status: int, headers: Iterable[tuple[str, str]]) -> None:
        self.has_begun = True
        own = [*headers, *self.more_headers]
        names = {name for name, _ in own}
        sent = [*own, *(header for header in COMMON_HEADERS if header[0] not in names)]
        raw = [(name.lower().encode(), value.encode("latin-1")) for name, value in sent]
        self._start = {"type": "http.response.start", "status": status, "headers": raw}

    async def _write(self, body: bytes, *, has_more: bool) -> None:
        """Write a piece of the body, the begin of the answer before the first one."""
        start, self._start = self._start, None
        piece = {"type": "http.response.body", "body": body, "more_body": has_more}
        try:
            with anyio.move_on_after(self._write_timeout) as limit:
                if start is not None:
                    await self._send(start)
                await self._send(piece)
        except OSError as exc:  # ASGI raises it for a client that has gone
            raise ConnectionLost(f"{self.peer} has gone") from exc
        if limit.cancelled_caught:
            raise ConnectionLost(f"{self.peer} does not read")
        if has_more:
            await checkpoint()  # the client may take all at once


def _too_large(limit: int) -> Refused:
    return Refused(413, f"the body is larger than the limit of {limit} bytes")
