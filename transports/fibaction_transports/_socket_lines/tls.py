"""TLS for streams of bytes, and its failures in words."""

from __future__ import annotations

import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import anyio
from anyio.abc import AnyByteStream, ByteStream, TaskGroup
from anyio.streams.stapled import MultiListener
from anyio.streams.tls import TLSListener, TLSStream

from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import StreamChannel
from fibaction.wire.frames import framed
from fibaction.wire.messages import Goodbye, Why, encode
from fibaction.wire.server.addresses import Addresses, Candidate
from fibaction.words.errors import AuthenticationFailed, ConnectionLost, TransportError, text_of
from fibaction_transports._socket_lines.sockets import leave, peer_of, serve_alone

SPEAKS_TLS = framed([encode(Goodbye("this server speaks TLS: use tls://", Why.PROTOCOL))])
"""The answer to a client that does not begin with TLS. OpenSSL has no alert for it."""

logger = clean_logger("fibaction.wire")

Made = TypeVar("Made")


def telling(context: ssl.SSLContext) -> ssl.SSLContext:
    """Return the context, whose connections tell the peer why they do not shake hands."""
    context.sslobject_class = _Telling
    return context


class _Telling(ssl.SSLObject):
    """One end of a connection that tells the peer why it does not shake hands."""

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
            raise  # the peer has gone, and its address is known only until that is noticed
        except ssl.SSLError as exc:
            # OpenSSL has made an alert that is still to be written, and anyio does not write it
            # after an error. So let anyio write first; then it calls this method again.
            self._failure = exc
            raise ssl.SSLWantWriteError from exc


@dataclass(eq=False)
class TlsListener(TLSListener):
    """A listener whose failed handshakes are one line of the log, without a traceback.

    So many clients may shake hands at the same time. Each takes memory, so one more ends the oldest
    of the address that has most of them: clients that begin and then say nothing keep no other out.
    """

    most: int = 1000
    speaks_tls: bytes = SPEAKS_TLS
    """The answer to a client that does not begin with TLS."""
    shaking: dict[anyio.CancelScope, str] = field(default_factory=dict)
    """The handshakes that are not done, with the addresses of the peers, the oldest first."""
    addresses: Addresses = field(default_factory=partial(Addresses, None))
    """The handshakes of each address."""

    def parts(self) -> list[TlsListener]:
        """Return a listener for each address of the host; together they have one limit."""
        assert isinstance(self.listener, MultiListener)
        return [replace(self, listener=one) for one in self.listener.listeners]

    async def serve(
        self, handler: Callable[[TLSStream], Any], task_group: TaskGroup | None = None
    ) -> None:
        async def begin(stream: AnyByteStream) -> None:
            async def wrap() -> TLSStream:
                return await TLSStream.wrap(
                    stream,
                    ssl_context=self.ssl_context,
                    standard_compatible=self.standard_compatible,
                )

            await self.shake_hands(stream, wrap, handler)

        await self.listener.serve(partial(serve_alone, begin), task_group)

    async def shake_hands(
        self,
        stream: AnyByteStream,
        handshake: Callable[[], Awaitable[Made]],
        handler: Callable[[Made], Awaitable[None]],
    ) -> None:
        """Give what a handshake makes to the handler.

        If the handshake fails, or exceeds the limits, the stream is closed, and the peer and the
        log are told why.
        """
        peer, shaking = peer_of(stream), self.shaking
        address = self.addresses.enter(peer)
        if len(shaking) >= self.most:
            self.addresses.make_room(
                Candidate(other, partial(self._end, scope)) for scope, other in shaking.items()
            )
        made: Made | None = None
        with anyio.CancelScope() as scope:
            shaking[scope] = address
            try:
                with anyio.fail_after(self.handshake_timeout):
                    made = await handshake()
            except BaseException as exc:
                await self.handle_handshake_error(exc, stream, self.speaks_tls)
            finally:
                shaking.pop(scope, None)
                self.addresses.leave(address)
        if scope.cancelled_caught:
            logger.warning("%s: no TLS: it took too long while %d others began", peer, self.most)
        if made is None:
            return
        await handler(made)

    def _end(self, scope: anyio.CancelScope) -> None:
        del self.shaking[scope]
        scope.cancel()

    @staticmethod
    async def handle_handshake_error(
        exc: BaseException, stream: AnyByteStream, speaks_tls: bytes = SPEAKS_TLS
    ) -> None:
        try:
            if not isinstance(exc, Exception):
                raise exc  # the server is to stop, and nothing is wrong with the client
            logger.warning("%s: no TLS: %s", peer_of(stream), _why(exc))
            if isinstance(exc, ssl.SSLError) and isinstance(stream, ByteStream):
                # A peer that does not begin with TLS may be a client with `tcp://` for `tls://`.
                await leave(stream, speaks_tls if is_other_than_tls(exc) else b"")
        finally:
            await anyio.aclose_forcefully(stream)


def _why(exc: Exception) -> str:
    """Return why a client has not shaken hands."""
    if isinstance(exc, ssl.SSLError):
        return (
            "it does not speak TLS"
            if is_other_than_tls(exc)
            else rejection("it", exc) or tls_reason(exc)
        )
    if isinstance(exc, TimeoutError):
        return "it took too long to shake hands"
    if isinstance(exc, OSError | anyio.BrokenResourceError | anyio.EndOfStream):
        return "it hung up while shaking hands: it may not trust our certificate"
    return text_of(exc)


class TlsChannel(StreamChannel):
    """A client's connection over TLS.

    With TLS 1.3 it has shaken hands before the server looks at its certificate, so a rejection
    comes in place of the first message.
    """

    async def receive(self) -> list[bytes]:
        try:
            return await super().receive()
        except ConnectionLost as exc:
            if isinstance(exc.__cause__, ssl.SSLError):
                raise lost_over_tls(self.peer, exc.__cause__) from exc.__cause__
            raise


def lost_over_tls(peer: str, exc: ssl.SSLError) -> TransportError:
    """Return the error of a connection on which TLS has failed after the handshake."""
    text = rejection(peer, exc)
    error = (
        AuthenticationFailed(text) if text else ConnectionLost(f"the connection to {peer} broke")
    )
    error.__cause__ = exc
    return error


def rejection(server: str, exc: ssl.SSLError) -> str:
    """Return how a server has rejected this client's certificate; empty for another error."""
    _, is_alert, said = (getattr(exc, "reason", "") or "").partition("_ALERT_")
    if not is_alert or not ("CERTIFICATE" in said or said in ("UNKNOWN_CA", "ACCESS_DENIED")):
        return ""
    if said == "CERTIFICATE_REQUIRED":
        return f"{server} asks its clients for a certificate: give cert=, and key="
    return f"{server} rejected our certificate: {said.replace('_', ' ').lower()}"


def no_tls(server: str, exc: ssl.SSLError, plain: str) -> str:
    """Return why a client has not shaken hands with a server; `plain` is the scheme without TLS."""
    if is_other_than_tls(exc):
        return f"{server} does not speak TLS: check the port, or use {plain}://"
    return rejection(server, exc) or f"cannot set up TLS with {server}: {tls_reason(exc)}"


def is_other_than_tls(exc: ssl.SSLError) -> bool:
    """Return whether the first bytes of the peer are another protocol than TLS."""
    # The first is about the bytes where TLS has its version, the others about words of HTTP.
    return exc.reason in ("WRONG_VERSION_NUMBER", "HTTP_REQUEST", "HTTPS_PROXY_REQUEST")


def tls_reason(exc: ssl.SSLError) -> str:
    """Return the error in a few words."""
    words = (exc.reason or "").replace("_", " ").lower()
    return getattr(exc, "verify_message", "") or words or str(exc)
