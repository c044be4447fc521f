"""The HTTP half of WebSocket: a request and its answer, for each side.

Sans-I/O, over h11, which is strict about what a request or an answer is, and limits its length.
wsproto has a handshake too; it is not used, because its server answers every wrong request with
400.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from http import HTTPStatus

import h11
from wsproto.utilities import generate_accept_token, generate_nonce

from fibaction.border.http_access import HttpRules, Refused, headers_in
from fibaction.border.peer_text import excerpt
from fibaction.wire.messages import Goodbye, decode_from_server
from fibaction.words.errors import (
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    LimitReached,
    ProtocolError,
)
from fibaction_transports._http.http_exchange import LONGEST_HEAD, http_answer

SUBPROTOCOL = "fibaction.1"
"""The name of the wire protocol among WebSocket's subprotocols."""
WEBSOCKET_VERSION = "13"
"""The version of WebSocket, of RFC 6455."""
FULL = frozenset({429, 503})
"""Statuses of a server that has no room for this client now."""
AWAY = frozenset({408, 500, 502, 504})
"""Statuses of a proxy that does not reach the server now."""
REJECTED = frozenset({401, 403, 407})
"""Statuses that say that this client is not let in."""


class ServerHandshake:
    """Reads a request, and answers it."""

    def __init__(self, rules: HttpRules, subprotocol: str = SUBPROTOCOL) -> None:
        """Speak that subprotocol; none if it is empty."""
        self.answer = b""
        """The answer, once the request has arrived or is known to be wrong."""
        self._rules = rules
        self._subprotocol = subprotocol
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=LONGEST_HEAD)

    def feed(self, data: bytes) -> bytes | None:
        """Add received bytes; return those behind the request, or None if it is not complete.

        Raises:
            ProtocolError: The request is rejected, by `answer`.
        """
        if self.answer:
            return None  # it was rejected, and the peer still sends
        self._http.receive_data(data)
        try:
            request = self._http.next_event()
            if request is h11.NEED_DATA:
                return None
            assert isinstance(request, h11.Request)
            key = self._key_of(request)
            if not isinstance(self._http.next_event(), h11.EndOfMessage):
                raise Refused(400, "a WebSocket request has no body")
        except h11.RemoteProtocolError as exc:
            raise self._rejected(Refused(exc.error_status_hint, str(exc))) from exc
        except Refused as exc:
            raise self._rejected(exc) from exc
        headers = [
            (b"Upgrade", b"websocket"),
            (b"Connection", b"Upgrade"),
            (b"Sec-WebSocket-Accept", generate_accept_token(key)),
        ]
        if self._subprotocol:
            headers.append((b"Sec-WebSocket-Protocol", self._subprotocol.encode()))
        self.answer = (
            self._http.send(
                h11.InformationalResponse(
                    status_code=101, headers=headers, reason=b"Switching Protocols"
                )
            )
            or b""
        )
        return self._http.trailing_data[0]

    def give_up(self, waiting: Iterable[bytes]) -> bytes:
        """Return the answer to a request that has not arrived in time, or cannot be served now.

        The reason is in the `Goodbye` among the messages that wait, if there is one.
        """
        reason = "the server is closing the connection"
        for frame in waiting:
            message = decode_from_server(frame)
            if isinstance(message, Goodbye):
                reason = message.reason
        return http_answer(503, reason)

    def _key_of(self, request: h11.Request) -> bytes:
        """Return the key of a request that asks for WebSocket.

        Raises:
            Refused: It asks for something else.
        """
        headers = headers_in(request.headers)
        if request.method != b"GET":
            raise Refused(405, "WebSocket requests are GET requests", ("Allow", "GET"))
        self._rules.check(request.target.decode("ascii"), headers)
        if not (
            "websocket" in _items(headers.get("upgrade", "").lower())
            and "upgrade" in _items(headers.get("connection", "").lower())
            and request.http_version == b"1.1"
        ):
            raise Refused(
                426,
                f"this is a fibaction server: connect by WebSocket, subprotocol {SUBPROTOCOL}",
                ("Upgrade", "websocket"),
            )
        if headers.get("sec-websocket-version") != WEBSOCKET_VERSION:
            raise Refused(
                426,
                f"the version of WebSocket is {WEBSOCKET_VERSION}",
                ("Upgrade", "websocket"),
                ("Sec-WebSocket-Version", WEBSOCKET_VERSION),
            )
        offered = _items(headers.get("sec-websocket-protocol", ""))
        if self._subprotocol and self._subprotocol not in offered:
            raise Refused(400, f"the request must offer the subprotocol {self._subprotocol}")
        key = headers.get("sec-websocket-key", "")
        if not key:
            raise Refused(400, "the request has no Sec-WebSocket-Key")
        return key.encode("latin-1")

    def _rejected(self, refused: Refused) -> ProtocolError:
        reason = excerpt(str(refused))
        self.answer = http_answer(refused.status, reason, *refused.headers)
        return ProtocolError(f"HTTP {refused.status}: {reason}")


class ClientHandshake:
    """Makes a request, and reads its answer."""

    def __init__(
        self, host: str, target: str, subprotocol: str = SUBPROTOCOL, token: str = ""
    ) -> None:
        """Ask for a target at a host, which has the port if it is not the scheme's own.

        Speak that subprotocol; none if it is empty. A token goes into the header `Authorization`.

        Raises:
            InvalidURL, UnicodeError: The host cannot be part of a request.
        """
        self._subprotocol = subprotocol
        self._missing = f"there is nothing at {target}, or this client may not use it"
        """The meaning of an answer without words."""
        if not target.endswith("/"):
            self._missing += f"; an action that is mounted is at {target}/, with a slash"
        self._http = h11.Connection(h11.CLIENT, max_incomplete_event_size=LONGEST_HEAD)
        self._key = generate_nonce()
        headers = [
            (b"Host", _ascii(host)),
            (b"Upgrade", b"websocket"),
            (b"Connection", b"Upgrade"),
            (b"Sec-WebSocket-Key", self._key),
            (b"Sec-WebSocket-Version", WEBSOCKET_VERSION.encode()),
        ]
        if subprotocol:
            headers.append((b"Sec-WebSocket-Protocol", subprotocol.encode()))
        if token:
            headers.append((b"Authorization", b"Bearer " + token.encode()))
        try:
            request = h11.Request(method="GET", target=target, headers=headers)
        except h11.LocalProtocolError as exc:
            raise InvalidURL(f"invalid host {host!r}: {exc}") from exc
        self.answer = (self._http.send(request) or b"") + (
            self._http.send(h11.EndOfMessage()) or b""
        )
        """The request."""

    def feed(self, data: bytes) -> bytes | None:
        """Add received bytes; return those behind the answer, or None if it is not complete.

        Raises:
            AuthenticationFailed: The server does not let this client in.
            ConnectionLost: A proxy does not reach the server.
            LimitReached: The server is full.
            ProtocolError: There is no server of the wire protocol over WebSocket.
        """
        self._http.receive_data(data)
        try:
            answer = self._http.next_event()
        except h11.RemoteProtocolError as exc:
            raise ProtocolError(
                f"it does not speak HTTP: check the port and the scheme ({excerpt(str(exc))})"
            ) from exc
        if answer is h11.NEED_DATA:
            return None
        assert isinstance(answer, h11.Response | h11.InformationalResponse)
        if answer.status_code != HTTPStatus.SWITCHING_PROTOCOLS:
            raise self._error_of(answer)
        headers = dict(answer.headers)
        accept = generate_accept_token(self._key)
        if headers.get(b"sec-websocket-accept") != accept:
            raise ProtocolError("it does not speak WebSocket: its Sec-WebSocket-Accept is wrong")
        if headers.get(b"sec-websocket-protocol", b"") != self._subprotocol.encode():
            spoken = f"the subprotocol {self._subprotocol}" if self._subprotocol else "rosbridge"
            raise ProtocolError(f"it does not speak {spoken}")
        return self._http.trailing_data[0]

    def give_up(self, waiting: Iterable[bytes]) -> bytes:
        """Return what is left to say: nothing."""
        return b""

    def _error_of(
        self, answer: h11.Response | h11.InformationalResponse
    ) -> AuthenticationFailed | ConnectionLost | LimitReached | ProtocolError:
        status = answer.status_code
        # A page of another server says nothing to a user of this one.
        is_text = dict(answer.headers).get(b"content-type", b"").startswith(b"text/plain")
        text = excerpt((is_text and self._text()) or answer.reason.decode("latin-1"))
        said = f"HTTP {status}: {text or self._missing}"
        if status in FULL:
            return LimitReached(said)
        if status in AWAY:
            return ConnectionLost(said)
        if status in REJECTED:
            return AuthenticationFailed(said)
        return ProtocolError(f"{said}; this may be another web server: check the port and the path")

    def _text(self) -> str:
        """Return as much of the body as has arrived with the status."""
        body = b""
        with suppress(h11.RemoteProtocolError):
            while isinstance(event := self._http.next_event(), h11.Data):
                body += event.data
        return body.decode(errors="replace").strip()


def _ascii(host: str) -> bytes:
    """Return a host, and its port if it has one, as a request names them."""
    if host.isascii():
        return host.encode()
    name, colon, port = host.partition(":")
    return name.encode("idna") + f"{colon}{port}".encode()


def _items(value: str) -> list[str]:
    """Return the items of a header that is a list."""
    return [item.strip() for item in value.split(",")]
