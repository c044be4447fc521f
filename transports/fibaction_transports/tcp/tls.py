"""TLS for streams of bytes: which files it is made from, and how it fails."""

from __future__ import annotations

import logging
import ssl
from collections.abc import Generator
from contextlib import contextmanager

import anyio
import msgspec
from anyio.abc import AnyByteStream
from anyio.streams.tls import TLSListener

from fibaction.exceptions import TransportError
from fibaction_transports.tcp.streams import peer_of

logger = logging.getLogger("fibaction.wire")


class TlsFiles(msgspec.Struct, frozen=True):
    """What to make TLS of: paths of PEM files."""

    ca: str | None = None
    """Whom to trust; None is whom the system trusts. With it, a server wants certificates."""
    cert: str | None = None
    """One's own certificate; a server must have one, and a client may."""
    key: str | None = None
    """Its key, if that is in another file."""

    def client(self) -> ssl.SSLContext:
        """For the connecting half: the server's certificate must be right, for its host.

        Raises:
            TransportError: The files cannot be used.
        """
        with self._translated():
            context = ssl.create_default_context(cafile=self.ca)
            if self.cert is not None:
                context.load_cert_chain(self.cert, self.key)
            return context

    def server(self) -> ssl.SSLContext:
        """For the serving half.

        Raises:
            TransportError: The files cannot be used, or there is no certificate.
        """
        if self.cert is None:
            raise TransportError("a TLS server needs a certificate: say cert=, and key=")
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
            raise TransportError(f"there is no TLS with {files}: {exc}") from exc


class TlsListener(TLSListener):
    """One whose handshakes fail in one line of the log, without a traceback."""

    @staticmethod
    async def handle_handshake_error(exc: BaseException, stream: AnyByteStream) -> None:
        reason = tls_reason(exc) if isinstance(exc, ssl.SSLError) else type(exc).__name__
        logger.warning("%s: no TLS: %s", peer_of(stream), reason)
        try:
            if not isinstance(exc, Exception):
                raise exc
        finally:
            await anyio.aclose_forcefully(stream)


def tls_reason(exc: ssl.SSLError) -> str:
    """What is wrong, in a few words."""
    return getattr(exc, "verify_message", "") or exc.reason or str(exc)
