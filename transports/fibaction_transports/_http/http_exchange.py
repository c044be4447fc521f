"""`HttpExchange`: one request over h11, as ASGI defines it."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import unquote

import anyio
import h11
from anyio.abc import ByteStream

from fibaction.border.http_access import Refused, headers_in
from fibaction.wire.channel import CHUNK
from fibaction_transports._http.exchange import Message, Scope
from fibaction_transports._socket_lines.on_anyio import BROKEN

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
        self._begin: h11.Response | None = None
        self._send_piece = send
        self._has_body = self._is_gone = self._is_cut = False
        # Another server on the way may have seen another end of the body, and so another request
        # behind it (RFC 9112, 6.1).
        names = {name for name, _ in request.headers}
        self._is_ambiguous = {b"content-length", b"transfer-encoding"} <= names
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
        is_done = http.our_state is h11.DONE and http.their_state is h11.DONE
        return is_done and not (self._is_gone or self._is_cut)

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
                if self._http.they_are_waiting_for_100_continue:
                    await self._send(h11.InformationalResponse(status_code=100, headers=[]))
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
            # It is sent with the first piece.
            status, headers = HTTPStatus(message["status"]), list(message["headers"])
            if self._is_ambiguous:
                headers.append((b"connection", b"close"))
            self._begin = h11.Response(
                status_code=status, headers=headers, reason=status.phrase.encode()
            )
            return
        events: list[h11.Event] = []
        if self._begin is not None:
            events.append(self._begin)
            self._begin = None
        if body := message.get("body", b""):
            events.append(h11.Data(data=body))
        if not message.get("more_body", False):
            events.append(h11.EndOfMessage())
        await self._send(*events)

    async def _send(self, *events: h11.Event) -> None:
        data = b"".join(self._http.send(event) or b"" for event in events)
        was_cut, self._is_cut = self._is_cut, True  # unless the client takes all of it
        try:
            await self._send_piece(data)
        except BROKEN as exc:
            self._is_gone = True
            raise OSError(str(exc)) from exc
        self._is_cut = was_cut
