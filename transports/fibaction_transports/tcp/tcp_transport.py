"""`tcp://host:port` and `tls://host:port`."""

from __future__ import annotations

import ssl
from typing import Any, Unpack
from urllib.parse import SplitResult

from fibaction.wire.settings import WireKeywords
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import host_only
from fibaction_transports._socket_lines.host_transport import HostTransport, port_in

HOST, PORT = "127.0.0.1", 7400
"""The default address: on this machine only."""


class TcpTransport(HostTransport):
    """TCP, with or without TLS."""

    tls_schemes = ("tls",)

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        insecure: bool = False,
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take an address, and the settings of every transport over the wire protocol.

        A URL has `insecure` and the text, number and boolean settings after its `?`. With `tls://`
        it has the paths `ca`, `cert` and `key` as well.

        Args:
            host: The host to connect to, or to listen at.
            port: The port; a server at port 0 gets a free one, which its URL shows.
            tls: The files to make TLS from, or a context for the half that is used.
            insecure: Permit a server without TLS at an address that other machines can reach.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        super().__init__(host, port, tls=tls, insecure=insecure, **settings)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL."""
        host = host_only(parts) or HOST
        return {"host": host, "port": port_in(parts, PORT)}
