"""TLS for streams of bytes and for lines that move bytes, and its failures in words.

For a line, the handshake comes first, over a stream of bytes (`shake_hands`). Then the line sends
and reads bytes as without TLS, and `TlsFraming` encrypts and decrypts its frames, of any form, in
between: each piece that arrives is decrypted in the call that brings it, and all frames of a write
become one piece. No task waits, and no layer keeps bytes: what OpenSSL holds is at most one record
that is not complete. What TLS has to say by itself (an alert, the answer to a change of keys) is
the answer that the next `encode` returns. Each side sends its close; `goodbye` returns ours.

Why not asyncio's TLS: it has a buffer of 256 KiB for each connection. Why not anyio's: it needs a
task for each direction, which wakes up for each piece; a frame there and back takes 3.3 times as
long as here, and each of 64 frames at once 2.2 times (Python 3.11, loopback).
"""

from __future__ import annotations

import ssl
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import anyio
from anyio.abc import AnyByteStream, ByteStream, TaskGroup
from anyio.streams.stapled import MultiListener
from anyio.streams.tls import TLSListener, TLSStream

from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK, StreamChannel
from fibaction.wire.frames import Framing, framed
from fibaction.wire.messages import Goodbye, Why, encode
from fibaction.wire.wire_server import Addresses, Candidate
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


MOST_ANSWERS = CHUNK
"""Bytes that TLS may have to say by itself while the peer reads none of them."""


class TlsEnd:
    """One end of a connection with TLS, and the bytes on their way into it and out of it."""

    def __init__(
        self,
        context: ssl.SSLContext,
        host: str | None = None,
        session: ssl.SSLSession | None = None,
    ) -> None:
        """Begin: at a client with the host whose certificate is expected, and the session of an
        earlier connection, to be resumed.
        """
        self.incoming = ssl.MemoryBIO()
        self.outgoing = ssl.MemoryBIO()
        self.tls = context.wrap_bio(
            self.incoming,
            self.outgoing,
            server_side=host is None,
            server_hostname=host,
            session=session,
        )


async def shake_hands(
    end: TlsEnd,
    receive: Callable[[], Awaitable[bytes]],
    send: Callable[[bytes], Awaitable[None]],
) -> bytes:
    """Shake hands with the peer, and return what has arrived after the handshake.

    Raises:
        ssl.SSLError: The peer does not speak TLS, or one side rejects the other.
        OSError, anyio.BrokenResourceError: The connection has ended.
    """
    while True:
        wants_more = False
        try:
            end.tls.do_handshake()
        except ssl.SSLWantReadError:
            wants_more = True
        except ssl.SSLWantWriteError:
            pass  # there is an alert to send before the error
        else:
            await send(end.outgoing.read())
            return end.incoming.read()
        await send(end.outgoing.read())
        if wants_more:
            try:
                end.incoming.write(await receive())
            except anyio.EndOfStream:
                raise anyio.BrokenResourceError from None


class TlsFraming(Framing):
    """Frames of another form inside TLS, after the handshake."""

    def __init__(self, frames: Framing, end: TlsEnd, peer: str) -> None:
        """Take the form of the frames; `peer` is for errors."""
        self._frames = frames
        self._tls = end.tls
        self._incoming = end.incoming
        self._outgoing = end.outgoing
        self._peer = peer
        self._error: TransportError | None = None  # nothing can be read any more

    @property
    def has_answer(self) -> bool:  # type: ignore[override]  # here it changes
        """True if there are bytes to send that belong to no frame."""
        return self._frames.has_answer or self._outgoing.pending > 0

    @property
    def has_ended(self) -> bool:  # type: ignore[override]  # here it changes
        """True if the peer has closed, or TLS has failed."""
        return self._error is not None or self._frames.has_ended

    @property
    def is_closed(self) -> bool:  # type: ignore[override]  # here it changes
        """True if nothing more is expected of the peer."""
        return self._error is not None

    @property
    def ends_stream(self) -> bool:  # type: ignore[override]  # here it changes
        """True if the stream to the peer ends with the goodbye."""
        return self._frames.ends_stream

    @property
    def is_within_frame(self) -> bool:
        return self._frames.is_within_frame

    def feed(self, data: bytes) -> list[bytes]:
        plain = self._decrypted(data)
        frames = self._frames.feed(plain) if plain else []
        if not frames:
            self.check()
        return frames

    def check(self) -> None:
        self._frames.check()
        if self._error is not None:
            raise self._error

    def _decrypted(self, data: bytes) -> bytes:
        """Return what the complete records in the bytes say, and note the end of the peer."""
        if self._error is not None:
            return b""
        incoming, tls = self._incoming, self._tls
        incoming.write(data)
        parts: list[bytes] = []
        try:
            while incoming.pending or tls.pending():
                part = tls.read(CHUNK)
                if not part:
                    self._end()
                    break
                parts.append(part)
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLZeroReturnError:
            self._end()
        except ssl.SSLError as exc:
            self._error = lost_over_tls(self._peer, exc)
        if self._outgoing.pending > MOST_ANSWERS:
            self._error = ConnectionLost(f"{self._peer} changes keys, and does not read")
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _end(self) -> None:
        """Note that the peer has closed."""
        how = "in the middle of a message" if self.is_within_frame else "its side"
        self._error = ConnectionLost(f"{self._peer} closed {how}")

    def encode(self, frames: Sequence[bytes]) -> bytes:
        return self._encrypted(self._frames.encode(frames))

    def _encrypted(self, data: bytes) -> bytes:
        """Return the bytes encrypted, behind what TLS has to say by itself."""
        try:
            if len(data) <= CHUNK:
                if data:
                    self._tls.write(data)
                return self._outgoing.read()
            parts: list[bytes] = []
            for start in range(0, len(data), CHUNK):
                self._tls.write(data[start : start + CHUNK])
                parts.append(self._outgoing.read())
            return b"".join(parts)
        except ssl.SSLError as exc:
            raise lost_over_tls(self._peer, exc) from exc

    def goodbye(self) -> bytes:
        last = b""
        with suppress(TransportError):  # TLS has failed, and only an alert is left to say
            last = self._encrypted(self._frames.goodbye())
        with suppress(ssl.SSLError):  # the close of the peer has not come yet, or never comes
            self._tls.unwrap()
        return last + self._outgoing.read()

    def discard(self, data: bytes) -> None:
        plain = self._decrypted(data)
        if plain:
            self._frames.discard(plain)

    def close(self) -> None:
        self._frames.close()
