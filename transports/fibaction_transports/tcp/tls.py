"""TLS for streams of bytes: which files it is made from, and how it fails."""

from __future__ import annotations

import logging
import ssl
from collections.abc import Generator
from contextlib import contextmanager, suppress

import anyio
import msgspec
from anyio.abc import AnyByteStream, ByteStream
from anyio.streams.tls import TLSListener

from fibaction.exceptions import AuthenticationFailed, ConnectionLost, TransportError
from fibaction.wire.channel import StreamChannel
from fibaction.wire.framing import framed
from fibaction.wire.messages import Goodbye, Why, encode
from fibaction_transports.tcp._anyio import peer_of

LAST_WORDS = 1.0
"""Seconds that a peer has to hear why it was refused."""
SPEAKS_TLS = framed([encode(Goodbye("this server speaks TLS: use tls://", Why.PROTOCOL))])
"""What a client hears that does not begin with TLS. OpenSSL has no alert for it."""

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
            context.sslobject_class = _Telling
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
            context.sslobject_class = _Telling
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


class _Telling(ssl.SSLObject):
    """One end of a connection that tells the other why it refuses to shake hands."""

    _failure: ssl.SSLError | None = None

    def do_handshake(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        try:
            super().do_handshake()
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
            raise
        except ssl.SSLEOFError:
            raise  # nobody is there to hear it, and who it was is known only until that is noticed
        except ssl.SSLError as exc:
            # The alert that tells it is yet to be written. anyio leaves it where it is if there is
            # an error, so let it write first; then it comes here again.
            self._failure = exc
            raise ssl.SSLWantWriteError from exc


class TlsListener(TLSListener):
    """One whose handshakes fail in one line of the log, without a traceback."""

    @staticmethod
    async def handle_handshake_error(exc: BaseException, stream: AnyByteStream) -> None:
        try:
            if not isinstance(exc, Exception):
                raise exc  # the server is to stop, and nothing is wrong with the client
            logger.warning("%s: no TLS: %s", peer_of(stream), _why(exc))
            if isinstance(exc, ssl.SSLError) and isinstance(stream, ByteStream):
                # Who does not begin with TLS may be a client that has `tcp://` for `tls://`.
                await _see_off(stream, SPEAKS_TLS if is_other_than_tls(exc) else b"")
        finally:
            await anyio.aclose_forcefully(stream)


async def _see_off(stream: ByteStream, last_words: bytes) -> None:
    """Let a peer hear why it was refused, by the alert that was sent, or by these words: if what it
    has said meanwhile were not read, closing would reset the connection, and what is still on the
    way to it could be lost.
    """
    with (
        anyio.move_on_after(LAST_WORDS),
        suppress(OSError, anyio.EndOfStream, anyio.BrokenResourceError),
    ):
        if last_words:
            await stream.send(last_words)
        await stream.send_eof()
        while True:
            await stream.receive()


def _why(exc: Exception) -> str:
    """Why a client has not shaken hands."""
    if isinstance(exc, ssl.SSLError):
        return (
            "it does not speak TLS"
            if is_other_than_tls(exc)
            else refusal("it", exc) or tls_reason(exc)
        )
    if isinstance(exc, TimeoutError):
        return "it took too long to shake hands"
    if isinstance(exc, OSError | anyio.BrokenResourceError | anyio.EndOfStream):
        return "it hung up while shaking hands, as some do that do not trust our certificate"
    return f"{type(exc).__name__}: {exc}"


class TlsChannel(StreamChannel):
    """A client's connection. With TLS 1.3 it has shaken hands before the server looks at its
    certificate, so that it hears of a refusal in place of the first message.
    """

    async def receive(self) -> list[bytes]:
        try:
            return await super().receive()
        except ConnectionLost as exc:
            if isinstance(exc.__cause__, ssl.SSLError):
                text = refusal(self.peer, exc.__cause__)
                if text:
                    raise AuthenticationFailed(text) from exc.__cause__
            raise


def refusal(server: str, exc: ssl.SSLError) -> str:
    """That a server has refused this client's certificate; empty if it is something else."""
    _, is_alert, said = (getattr(exc, "reason", "") or "").partition("_ALERT_")
    if not is_alert or not ("CERTIFICATE" in said or said in ("UNKNOWN_CA", "ACCESS_DENIED")):
        return ""
    if said == "CERTIFICATE_REQUIRED":
        return f"{server} wants a certificate of its clients: say cert=, and key="
    return f"{server} refused our certificate: {said.replace('_', ' ').lower()}"


def no_tls(server: str, exc: ssl.SSLError) -> str:
    """Why a client has not shaken hands with a server."""
    if is_other_than_tls(exc):
        return f"{server} does not speak TLS: if it is not meant to, use tcp://"
    return refusal(server, exc) or f"no TLS with {server}: {tls_reason(exc)}"


def is_other_than_tls(exc: ssl.SSLError) -> bool:
    """Whether what the peer has sent first is something else than TLS."""
    return exc.reason == "WRONG_VERSION_NUMBER"  # of the bytes where TLS has its version


def tls_reason(exc: ssl.SSLError) -> str:
    """What is wrong, in a few words."""
    words = (exc.reason or "").replace("_", " ").lower()
    return getattr(exc, "verify_message", "") or words or str(exc)
