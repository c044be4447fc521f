"""`ws://host:port/path` and `wss://host:port/path`."""

from __future__ import annotations

import ssl
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, ClassVar, Unpack
from urllib.parse import SplitResult, quote, unquote

from fibaction.border.http_access import HttpRules, rules
from fibaction.wire.frames import FrameReader, Framing
from fibaction.wire.settings import WireKeywords
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import boolean, without_user
from fibaction_transports._socket_lines.host_transport import HostTransport, port_in
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake, http_answer
from fibaction_transports.web.http.websocket_frames import WebSocketFraming

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

HOST = "127.0.0.1"
"""The default host: this machine only."""
PORT, TLS_PORT = 80, 443
"""The ports of HTTP, which are those of WebSocket."""


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name)


class WebSocketKeywords(WireKeywords, total=False):
    """The keyword arguments of a `WebSocketTransport`."""

    tls: TlsFiles | ssl.SSLContext | None
    insecure: bool
    hosts: Iterable[str]
    origins: Iterable[str]


class WebSocketTransport(HostTransport):
    """WebSocket, with or without TLS."""

    own_settings: ClassVar[tuple[str, ...]] = ("tls", "insecure", "hosts", "origins")
    own_url_settings: ClassVar = {"insecure": boolean, "hosts": _names, "origins": _names}
    plain_scheme = "ws"
    tls_schemes: ClassVar[tuple[str, ...]] = ("wss",)
    speaks_tls = http_answer(400, "this server speaks TLS: use wss://")
    own_ports: ClassVar[tuple[int, int]] = PORT, TLS_PORT
    """The ports of URLs without one: without TLS, and with it."""

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        path: str = "/",
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        hosts: Iterable[str] = (),
        origins: Iterable[str] = (),
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take an address, and the settings of every transport over the wire protocol.

        A URL has `insecure`, `hosts` and `origins`, with commas between their items, and the text,
        number and boolean settings after its `?`. With `wss://` it has the paths `ca`, `cert` and
        `key` as well.

        Args:
            host: The host to connect to, or to listen at.
            port: The port: 80, or 443 with TLS, if it is None; a server at port 0 gets a free one,
                which its URL shows.
            path: The path of the server; it begins with `/`.
            tls: The files to make TLS from, or a context for the half that is used.
            insecure: Permit a server without TLS at an address that other machines can reach.
            hosts: Names of the server, in addition to its addresses and the names of its machine;
                `*` permits all.
            origins: Pages that may use the server, for example `https://robot.example`, beside
                those that come from its own address; `*` permits all.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, the path does not
                begin with `/`, or a token is not valid text.
        """
        self._own_port = self.own_ports[tls is not None]
        super().__init__(
            host,
            self._own_port if port is None else port,
            tls=tls,
            insecure=insecure,
            **settings,
        )
        if not path.startswith("/"):
            raise ValueError(f"path begins with /, unlike {path!r}")
        self._path = quote(path, safe="/:@!$&'()*+,;=~-._")
        self._hosts = tuple(hosts)
        self._origins = tuple(origins)

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
        return WebSocketFraming(self.url, FrameReader(self.client_settings.max_frame), handshake)

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
            return WebSocketFraming("the client", server.new_reader(), ServerHandshake(admitted))

        return new_framing
