"""`ws://host:port/path` and `wss://host:port/path`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Unpack
from urllib.parse import SplitResult, quote, unquote

from fibaction.border.http_access import HttpRules, rules
from fibaction.border.settings import TransportSettings
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.transport import without_user
from fibaction_transports._http.http_exchange import http_answer
from fibaction_transports._socket_lines.stream_transport import (
    HostSettings,
    HostTransport,
    port_in,
)
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer
    from fibaction_transports.keywords import WebSocketKeywords

HOST = "127.0.0.1"
"""The default host: this machine only."""
PORT, TLS_PORT = 80, 443
"""The ports of HTTP, which are those of WebSocket."""


class WebSocketSettings(HostSettings, frozen=True, kw_only=True):
    """The settings of a `WebSocketTransport`."""

    only_for_servers: ClassVar[tuple[str, ...]] = (
        *HostSettings.only_for_servers,
        "hosts",
        "origins",
    )

    hosts: Sequence[str] = ()
    """Names of a server, in addition to its addresses and the names of its machine; `*` permits
    all."""
    origins: Sequence[str] = ()
    """Pages that may use a server, for example `https://robot.example`, besides those that come
    from its own address; `*` permits all."""


class WebSocketLineTransport(HostTransport):
    """The part that the transports at a path of HTTP have in common."""

    plain_scheme = "ws"
    speaks_tls = http_answer(400, "this server speaks TLS: use wss://")
    own_ports: ClassVar[tuple[int, int]] = PORT, TLS_PORT
    """The ports of URLs without one: without TLS, and with it."""

    def __init__(self, host: str, port: int | None, path: str, settings: WebSocketSettings) -> None:
        self._own_port = self.own_ports[settings.tls is not None]
        super().__init__(host, self._own_port if port is None else port, settings)
        if not path.startswith("/"):
            raise ValueError(f"path begins with /, unlike {path!r}")
        self._path = quote(path, safe="/:@!$&'()*+,;=~-._")
        self._hosts = tuple(settings.hosts)
        self._origins = tuple(settings.origins)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host, the port and the path in a URL."""
        own = cls.own_ports[parts.scheme in cls.tls_schemes]
        host = without_user(parts) or HOST
        return {"host": host, "port": port_in(parts, own), "path": unquote(parts.path) or "/"}

    def _url(self, port: int) -> str:
        return f"{self._scheme}://{self._netloc(port)}{self._path if self._path != '/' else ''}"

    def _client_framing(self) -> Framing:
        host = self._netloc(self._port).removesuffix(f":{self._own_port}")
        handshake = ClientHandshake(host, self._path)
        messages = BinaryMessages(FrameReader(self.settings.max_frame))
        return WebSocketFraming(self.url, messages, handshake)

    def _rules(self) -> HttpRules:
        return rules(
            self._host,
            self._path,
            hosts=self._hosts,
            origins=self._origins,
            has_tls=self._tls is not None,
        )

    def _new_framing(self, server: WireServer) -> Callable[[], Framing]:
        admitted = self._rules()

        def new_framing() -> Framing:
            messages = BinaryMessages(server.new_reader())
            return WebSocketFraming("the client", messages, ServerHandshake(admitted))

        return new_framing


class WebSocketTransport(WebSocketLineTransport):
    """WebSocket, with or without TLS."""

    settings_type: ClassVar[type[TransportSettings]] = WebSocketSettings
    tls_schemes: ClassVar[tuple[str, ...]] = ("wss",)

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        path: str = "/",
        **settings: Unpack[WebSocketKeywords],
    ) -> None:
        """Take an address and settings.

        Args:
            host: The host to connect to, or to listen at.
            port: The port: 80, or 443 with TLS, if it is None; a server at port 0 gets a free one,
                which its URL shows.
            path: The path of the server; it begins with `/`.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, the path does not
                begin with `/`, or a token is not valid text.
        """
        super().__init__(host, port, path, WebSocketSettings.of(self, settings))
