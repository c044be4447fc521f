"""`mcp+http://host:port` and `mcp+https://host:port`: MCP over HTTP ("streamable HTTP")."""

from __future__ import annotations

import ssl
from collections.abc import AsyncGenerator, Iterable
from contextlib import asynccontextmanager
from typing import Any, ClassVar, Unpack
from urllib.parse import SplitResult

from mcp.server import Server

from fibaction.border.event_loop import asyncio_task
from fibaction.border.http_access import rules
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import boolean, host_only
from fibaction.words.errors import TransportError
from fibaction_transports.mcp.mcp_http import PATH, http_app, is_loopback, served_over_http
from fibaction_transports.mcp.mcp_keywords import McpHttpKeywords
from fibaction_transports.mcp.mcp_transport import McpTransport, items

HOST = "127.0.0.1"
"""The default host: this machine only."""
PORT = 8090
"""The default port."""
MAX_PORT = 65535
"""The largest port: a number of 16 bits."""


class McpHttpTransport(McpTransport):
    """MCP over HTTP, with or without TLS, for any number of clients. It runs on asyncio only.

    Each client needs a token, so that no other user of the machine can move a robot.
    """

    wire_settings = ("token", "tokens", "limits")
    own_settings: ClassVar[tuple[str, ...]] = (
        *McpTransport.own_settings,
        "tls",
        "insecure",
        "hosts",
        "origins",
    )
    own_url_settings: ClassVar = {
        **McpTransport.own_url_settings,
        "insecure": boolean,
        "hosts": items,
        "origins": items,
    }
    tls_schemes: ClassVar[tuple[str, ...]] = ("mcp+https",)

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        hosts: Iterable[str] = (),
        origins: Iterable[str] = (),
        **settings: Unpack[McpHttpKeywords],
    ) -> None:
        """Take an address, and the rules for what a model may do.

        A URL has the settings after its `?`, with commas between their items, but for `tokens`.
        With `mcp+https://` it has the paths `ca`, `cert` and `key` as well.

        Args:
            host: The host to listen at.
            port: The port; 0 is a free one, which the URL shows that `serve` gives.
            tls: The files to make TLS from, or a context.
            insecure: Permit a server without TLS at an address that other machines can reach.
            hosts: Names of the server, in addition to its addresses and the names of its machine;
                `*` permits all.
            origins: Pages that may use the server, for example `https://robot.example`, beside
                those that come from its own address; `*` permits all.
            settings: `allow`, `unasked`, `read_only` and `patience` are those of `AgentPolicy`.
                `token` is the one that clients need, or `tokens` maps several to the names of their
                owners. Of `limits`, `connections`, `per_address` and `handshake` hold here.

        Raises:
            TypeError: There is no such setting.
            ValueError: The port or the patience is out of range, a pattern is empty, or a token is
                not valid text.
        """
        super().__init__(**settings)
        if not 0 <= port <= MAX_PORT:
            raise ValueError(f"port is between 0 and {MAX_PORT}, not {port}")
        tokens = dict(settings.get("tokens") or {})
        if token := settings.get("token"):
            tokens[token] = "agent"
        self._access = AccessPolicy(tokens) if tokens else None
        self._host = host
        self._port = port
        self._tls = tls
        self._insecure = insecure
        self._hosts = tuple(hosts)
        self._origins = tuple(origins)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL.

        Raises:
            ValueError: It has a user or a path, or the port is invalid.
        """
        host = host_only(parts) or HOST
        return {"host": host, "port": PORT if parts.port is None else parts.port}

    @property
    def url(self) -> str:
        scheme = "mcp+https" if self._tls else "mcp+http"
        return f"{scheme}://{self._netloc(self._port)}"

    def _netloc(self, port: int) -> str:
        return f"[{self._host}]:{port}" if ":" in self._host else f"{self._host}:{port}"

    @asynccontextmanager
    async def offer(self, server: Server[Any]) -> AsyncGenerator[str, None]:
        access = self._checked_access()
        tls = self._tls.server() if isinstance(self._tls, TlsFiles) else self._tls
        admitted = rules(
            self._host, PATH, hosts=self._hosts, origins=self._origins, has_tls=tls is not None
        )
        app = http_app(server, self._host, admitted, access)
        async with served_over_http(
            app, self._host, self._port, tls, self.server_settings.limits
        ) as port:
            yield f"{'https' if tls else 'http'}://{self._netloc(port)}{PATH}"

    def _checked_access(self) -> AccessPolicy:
        """Return the tokens, if the address can be used with them.

        Raises:
            TransportError: It cannot.
        """
        if not (self._tls or self._insecure or is_loopback(self._host)):
            raise TransportError(
                f"{self.url} can be reached from other machines: use TLS, with cert= and key= at"
                f" mcp+https://, or, if the network is your own, insecure=true"
            )
        if self._access is None:
            raise TransportError(
                f"{self.url} needs a token, since a model moves things: append ?token=... to the"
                f" URL, or give tokens={{...}} in code"
            )
        if asyncio_task() is None:
            raise TransportError(f"{self.url} needs asyncio: its HTTP server does not run on trio")
        return self._access
