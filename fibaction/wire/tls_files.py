"""The files that a transport makes TLS from."""

from __future__ import annotations

import ssl
from collections.abc import Generator
from contextlib import contextmanager

import msgspec

from fibaction.words.errors import TransportError


class TlsFiles(msgspec.Struct, frozen=True):
    """Paths of PEM files to make TLS from."""

    ca: str | None = None
    """The authorities to trust; None trusts those of the system. A server with `ca` asks its
    clients for certificates."""
    cert: str | None = None
    """The certificate of this side; a server must have one, and a client may."""
    key: str | None = None
    """The key of the certificate, if it is in another file."""

    def client(self) -> ssl.SSLContext:
        """Make the context of a client, which checks the server's certificate and its host.

        Raises:
            TransportError: The files cannot be used.
        """
        with self._translated():
            context = ssl.create_default_context(cafile=self.ca)
            if self.cert is not None:
                context.load_cert_chain(self.cert, self.key)
            return context

    def server(self) -> ssl.SSLContext:
        """Make the context of a server.

        Raises:
            TransportError: The files cannot be used, or there is no certificate.
        """
        if self.cert is None:
            raise TransportError("a TLS server needs a certificate: give cert=, and key=")
        with self._translated():
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=self.ca)
            context.load_cert_chain(self.cert, self.key)
            if self.ca is not None:
                context.verify_mode = ssl.CERT_REQUIRED
            return context

    @contextmanager
    def _translated(self) -> Generator[None, None, None]:
        try:
            yield
        except (OSError, ValueError) as exc:
            files = ", ".join(name for name in (self.ca, self.cert, self.key) if name)
            raise TransportError(f"cannot load TLS files {files}: {exc}") from exc
