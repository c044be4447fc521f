"""`AgentHttpTransport`: the address, the tokens and the rules of a server of HTTP for agents."""

from __future__ import annotations

import ssl
from collections.abc import AsyncGenerator, Iterable
from contextlib import asynccontextmanager
from typing import Any, ClassVar, Unpack
from urllib.parse import SplitResult

from fibaction.border.event_loop import asyncio_task
from fibaction.border.http_access import rules
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import boolean, host_only
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_keywords import AgentHttpKeywords
from fibaction_transports._agents.agent_transport import AgentTransport, items
from fibaction_transports._agents.http_guard import App, Guarded
from fibaction_transports._agents.http_server import is_loopback, served_over_http

HOST = "127.0.0.1"
"""The default host: this machine only."""
MAX_PORT = 65535
"""The largest port: a number of 16 bits."""


class AgentHttpTransport(AgentTransport):
    """A server of HTTP, with or without TLS, for any number of agents. It runs on asyncio only.

    Each client needs a token, so that no other user of the machine can move a robot.
    """

    wire_settings = ("token", "tokens", "limits")
    own_settings: ClassVar[tuple[str, ...]] = (
        *AgentTransport.own_settings,
        "tls",
        "insecure",
        "hosts",
        "origins",
    )
    own_url_settings: ClassVar = {
        **AgentTransport.own_url_settings,
        "insecure": boolean,
        "hosts": items,
        "origins": items,
    }
    schemes: ClassVar[tuple[str, str]]
    """The scheme without TLS, and the one with it."""
    default_port: ClassVar[int]

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        hosts: Iterable[str] = (),
        origins: Iterable[str] = (),
        **settings: Unpack[AgentHttpKeywords],
    ) -> None:
        """Take an address, and the rules for what an agent may do.

        A URL has the settings after its `?`, with commas between their items, but for `tokens`.
        With TLS it has the paths `ca`, `cert` and `key` as well.

        Args:
            host: The host to listen at.
            port: The port, None for the default one; 0 is a free one, which the URL shows that
                `serve` gives.
            tls: The files to make TLS from, or a context.
            insecure: Permit a server without TLS at an address that other machines can reach.
            hosts: Names of the server, in addition to its addresses and the names of its machine;
                `*` permits all.
            origins: Pages that may use the server, for example `https://robot.example`, besides
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
        port = self.default_port if port is None else port
        if not 0 <= port <= MAX_PORT:
            raise ValueError(f"port is between 0 and {MAX_PORT}, not {port}")
        tokens = dict(settings.get("tokens") or {})
        if token := settings.get("token"):
            tokens[token] = "agent"
        self._access = AccessPolicy(tokens) if tokens else None
        self.host = host
        """The host to listen at."""
        self._port = port
        self._tls = tls
        self._insecure = insecure
        self.hosts = tuple(hosts)
        self._origins = tuple(origins)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL.

        Raises:
            ValueError: It has a user or a path, or the port is invalid.
        """
        host = host_only(parts) or HOST
        return {"host": host, "port": parts.port}

    @property
    def url(self) -> str:
        scheme = self.schemes[bool(self._tls)]
        return f"{scheme}://{self._netloc(self._port)}"

    def _netloc(self, port: int) -> str:
        return f"[{self.host}]:{port}" if ":" in self.host else f"{self.host}:{port}"

    @asynccontextmanager
    async def serve_app(self, app: App, path: str, *public: str) -> AsyncGenerator[str, None]:
        """Serve an application during the block, which gets the URL of the path in it.

        The `public` paths may be read without a token.

        Raises:
            TransportError: The address cannot be used.
        """
        access = self._checked_access()
        tls = self._tls.server() if isinstance(self._tls, TlsFiles) else self._tls
        admitted = rules(
            self.host, path, hosts=self.hosts, origins=self._origins, has_tls=tls is not None
        )
        guarded = Guarded(app, admitted, access, public)
        async with served_over_http(
            guarded, self.host, self._port, tls, self.server_settings.limits
        ) as port:
            yield f"{'https' if tls else 'http'}://{self._netloc(port)}{path}"

    def _checked_access(self) -> AccessPolicy:
        """Return the tokens, if the address can be used with them.

        Raises:
            TransportError: It cannot.
        """
        if not (self._tls or self._insecure or is_loopback(self.host)):
            raise TransportError(
                f"{self.url} can be reached from other machines: use TLS, with cert= and key= at"
                f" {self.schemes[True]}://, or, if the network is your own, insecure=true"
            )
        if self._access is None:
            raise TransportError(
                f"{self.url} needs a token, since an agent moves things: append ?token=... to the"
                f" URL, or give tokens={{...}} in code"
            )
        if asyncio_task() is None:
            raise TransportError(f"{self.url} needs asyncio: its HTTP server does not run on trio")
        return self._access
