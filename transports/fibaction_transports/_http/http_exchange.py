"""`HttpExchange`: one request over h11, as ASGI defines it.

h11 reads the request, which is not trusted. The answer is written here: h11 would check and sort
again what this server has made, and take longer for that than for the request.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import unquote

import anyio
import h11
from anyio.abc import ByteStream

from fibaction.border.http_access import Refused, headers_in
from fibaction.wire.channel import CHUNK
from fibaction_transports._http.exchange import WITHOUT_BODY, Message, Scope
from fibaction_transports._socket_lines.sockets import BROKEN

LONGEST_HEAD = 2**14
"""Bytes of a request or an answer, at most: room for the cookies of other servers of this host."""
_ABSOLUTE = re.compile(rb"https?://(?P<host>[^/?#]+)(?P<path>[^#]*)", re.IGNORECASE)
MOST_EARLY = 2**16
"""Bytes of later requests that are read while one is answered; more are left to the socket."""


def http_answer(status: int, text: str, *headers: tuple[str, str]) -> bytes:
    """Return an answer in plain text, after which the connection ends."""
    body = f"{text}\n".encode()
    lines = [
        f"HTTP/1.1 {status} {HTTPStatus(status).phrase}",
        *(f"{name}: {value}" for name, value in headers),
        "Content-Type: text/plain; charset=utf-8",
        f"Content-Length: {len(body)}",
        "Connection: close",
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body


def is_upgrade(request: h11.Request) -> bool:
    """Return whether a request asks for WebSocket."""
    return "websocket" in headers_in(request.headers).get("upgrade", "").lower()


def in_origin_form(request: h11.Request) -> h11.Request:
    """Return a request whose target is a path: as it is, or made of a target in the absolute form,
    whose host counts in place of the header (RFC 9112, 3.2.2).

    Raises:
        Refused: The request is of another version than HTTP/1.
    """
    if not request.http_version.startswith(b"1."):
        version = request.http_version.decode("ascii")
        raise Refused(505, f"this server speaks HTTP/1.1, and not HTTP/{version}")
    found = _ABSOLUTE.fullmatch(request.target)
    if found is None:
        return request
    headers = [(b"host", found["host"])]
    headers += [(name, value) for name, value in request.headers if name != b"host"]
    path = found["path"] if found["path"].startswith(b"/") else b"/" + found["path"]
    http = request.http_version
    return h11.Request(method=request.method, target=path, headers=headers, http_version=http)


class HttpAnswer:
    """The bytes of an answer: its head, and its body, whose end is told by its length, by chunks,
    or by the end of the connection (RFC 9112, 6.3).
    """

    def __init__(self, request: h11.Request) -> None:
        self.has_begun = False
        self.is_complete = False
        """True if the answer has its end."""
        headers = list(request.headers)
        names = {name for name, _ in headers}
        asked = [value.lower() for name, value in headers if name == b"connection"]
        self._is_old = request.http_version < b"1.1"
        # Another server on the way may have seen another end of the body of a request that tells
        # two, and so another request behind it (RFC 9112, 6.1). One that offers another protocol
        # may have begun to speak it.
        is_unclear = {b"content-length", b"transfer-encoding"} <= names or b"upgrade" in names
        is_closing = any(b"close" in value for value in asked)
        self.is_last = self._is_old or is_unclear or is_closing or request.method == b"CONNECT"
        """True if the connection ends after the answer."""
        self._is_head = request.method == b"HEAD"
        self._is_chunked = False
        self._left: int | None = 0
        """The bytes of the body that are still to come; None if its length is not known."""

    def begin(self, status: int, headers: Iterable[tuple[bytes, bytes]]) -> bytes:
        """Return the head of the answer.

        Raises:
            ValueError: A header has a line break.
        """
        lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode()]
        length: int | None = None
        for name, value in headers:
            if name == b"connection":
                self.is_last |= b"close" in value.lower()
            elif name != b"transfer-encoding":
                lines.append(b"%b: %b" % (name, value))
                if name == b"content-length":
                    length = int(value)
        has_body = not self._is_head and status not in WITHOUT_BODY
        if length is None and has_body and self._is_old:
            self.is_last = True
        elif length is None and status not in WITHOUT_BODY and not self._is_old:
            lines.append(b"transfer-encoding: chunked")
            self._is_chunked = has_body
        self._left = length if has_body else 0
        if self.is_last:
            lines.append(b"connection: close")
        head = b"\r\n".join((*lines, b"", b""))
        if any(head.count(end) != len(lines) + 1 for end in (b"\r", b"\n")):
            raise ValueError("a header of the answer has a line break")
        self.has_begun = True
        return head

    def piece(self, body: bytes, *, has_more: bool) -> bytes:
        """Return a piece of the body.

        Raises:
            ValueError: The body is longer or shorter than its head says.
        """
        if self._left is not None:
            self._left -= len(body)
            if self._left < 0 or (self._left and not has_more):
                raise ValueError(f"the length of the answer is wrong by {abs(self._left)} bytes")
        if self._is_chunked and body:
            body = b"%x\r\n%b\r\n" % (len(body), body)
        if not has_more:
            self.is_complete = True
            if self._is_chunked:
                body += b"0\r\n\r\n"
        return body


class HttpExchange:
    """One request, and its answer."""

    def __init__(
        self,
        http: h11.Connection,
        stream: ByteStream,
        send: Callable[[bytes], Awaitable[None]],
        request: h11.Request,
        peer: str,
        scheme: str,
        root: str,
    ) -> None:
        self._http = http
        self._stream = stream
        self._answer = HttpAnswer(request)
        self._head = b""  # of the answer, until its first piece
        self._send_piece = send
        self._has_body = self._is_gone = self._is_cut = False
        self.early = b""
        """The bytes that have arrived behind the request."""
        path, _, query = request.target.partition(b"?")
        host, _, port = peer.rpartition(":")
        self.scope: Scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.4"},
            "http_version": request.http_version.decode("ascii"),
            "method": request.method.decode("ascii"),
            "scheme": scheme,
            "path": unquote(path.decode("ascii")),
            "raw_path": path,
            "query_string": query,
            "root_path": root,
            "headers": list(request.headers),
            "client": (host, int(port)) if host else None,
            "server": None,
        }
        """The request, as ASGI describes it."""

    def can_go_on(self) -> bool:
        """Return whether the answer is complete, and the connection may have another request."""
        http = self._http
        with suppress(h11.RemoteProtocolError):
            if http.their_state is h11.SEND_BODY:
                http.next_event()  # the end of a request without a body, which nobody has read
        is_done = self._answer.is_complete and http.their_state is h11.DONE
        return is_done and not (self._answer.is_last or self._is_gone or self._is_cut)

    async def receive(self) -> Message:
        """Return the next piece of the body; after it, wait until the client has gone.

        Raises:
            Refused: The body is not what its headers say.
        """
        while not self._is_gone:
            try:
                if self._has_body:
                    await self._receive_early()
                    continue
                if self._http.they_are_waiting_for_100_continue and not self._answer.has_begun:
                    more = h11.InformationalResponse(status_code=100, headers=[])
                    await self._send(self._http.send(more) or b"")
                event = self._http.next_event()
                if event is h11.NEED_DATA:
                    self._http.receive_data(await self._stream.receive(CHUNK))
                elif isinstance(event, h11.Data):
                    body = bytes(event.data)
                    return {"type": "http.request", "body": body, "more_body": True}
                else:
                    self._has_body = True
                    return {"type": "http.request", "body": b"", "more_body": False}
            except BROKEN:
                self._is_gone = True
            except h11.RemoteProtocolError as exc:
                self._is_gone = True  # where the next request begins is not known
                raise Refused(400, f"the body cannot be read: {exc}") from exc
        return {"type": "http.disconnect"}

    async def _receive_early(self) -> None:
        if len(self.early) >= MOST_EARLY:
            await anyio.sleep_forever()  # the application cancels it at the end of its answer
        self.early += await self._stream.receive(CHUNK)

    async def send(self, message: Message) -> None:
        """Send the begin of the answer, or a piece of its body.

        Raises:
            OSError: The client has gone.
        """
        if message["type"] == "http.response.start":
            self._head = self._answer.begin(message["status"], message["headers"])
            return
        head, self._head = self._head, b""  # it is sent with the first piece
        body, has_more = message.get("body", b""), message.get("more_body", False)
        await self._send(head + self._answer.piece(body, has_more=has_more))

    async def _send(self, data: bytes) -> None:
        was_cut, self._is_cut = self._is_cut, True  # unless the client takes all of it
        try:
            await self._send_piece(data)
        except BROKEN as exc:
            self._is_gone = True
            raise OSError(str(exc)) from exc
        self._is_cut = was_cut
