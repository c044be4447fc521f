"""`tcp://host:port` and `tls://host:port`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Unpack
from urllib.parse import SplitResult

from fibaction.wire.transport import host_only
from fibaction_transports._socket_lines.host_transport import HostSettings, HostTransport, port_in

if TYPE_CHECKING:
    from fibaction_transports.keywords import HostKeywords

HOST, PORT = "127.0.0.1", 7400
"""The default address: on this machine only."""


class TcpTransport(HostTransport):
    """TCP, with or without TLS."""

    tls_schemes = ("tls",)

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        **settings: Unpack[HostKeywords],
    ) -> None:
        """Take an address and settings.

        Args:
            host: The host to connect to, or to listen at.
            port: The port; a server at port 0 gets a free one, which its URL shows.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        super().__init__(host, port, HostSettings.of(self, settings))

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL."""
        host = host_only(parts) or HOST
        return {"host": host, "port": port_in(parts, PORT)}
