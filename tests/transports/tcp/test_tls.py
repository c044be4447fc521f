"""`fibaction_transports._socket_lines.tls`: who is let in, and who is talked to."""

from __future__ import annotations

import os
import re
import socket
import ssl
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from shutil import copyfile
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import SocketAttribute, SocketStream

from fibaction import (
    AuthenticationFailed,
    ConnectionLost,
    ProtocolError,
    TransportError,
    serve,
)
from fibaction.wire.frames import FrameReader
from fibaction.wire.settings import Limits
from fibaction_transports._socket_lines import sockets
from fibaction_transports._socket_lines.on_asyncio import ClientTls
from fibaction_transports._socket_lines.tls import TlsChannel, TlsEnd, TlsListener
from fibaction_transports.tcp import TcpTransport, TlsFiles
from tests.support.certificates import pems
from tests.transports.hearing import Hearing, port_of, raw
from tests.transports.tcp.servers import Named, failure, new_server, refusal, tls_server, works

pytestmark = pytest.mark.asyncio


async def test_a_host_with_several_addresses_is_served_over_tls_at_each_of_them() -> None:
    try:
        addresses = {str(one[4][0]) for one in socket.getaddrinfo("localhost", 0)}
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    transport = TcpTransport("localhost", 0, tls=TlsFiles(cert=pems().cert))
    context = TlsFiles(ca=pems().ca).client()
    context.check_hostname = False
    async with serve(new_server(), transport) as (url,):
        for host in addresses:
            assert await works(TcpTransport(host, port_of(url), tls=context))


@pytest.mark.parametrize(
    ("host", "ca", "reason"),
    [
        ("127.0.0.1", "", "certificate"),
        ("127.0.0.1", "other.test", "certificate"),
        ("other.test", "other.test", "certificate is not valid for '127.0.0.1'"),
    ],
    ids=["an authority of nobody's", "another authority", "another host"],
)
async def test_a_server_whose_certificate_is_not_right_is_not_talked_to(
    host: str, ca: str, reason: str
) -> None:
    trusted = TlsFiles(ca=pems(ca).ca if ca else None)
    async with serve(new_server(), tls_server(cert=pems(host).cert)) as (url,):
        for reconnect in (True, False):
            failed = await failure(AuthenticationFailed, url, tls=trusted, reconnect=reconnect)
            assert failed.startswith(f"cannot set up TLS with {url}: ")
            assert re.search(reason, failed)


@pytest.mark.parametrize("reconnect", [True, False])
@pytest.mark.parametrize(
    ("newest", "cert", "text", "line"),
    [
        (
            ssl.TLSVersion.TLSv1_3,
            "",
            "URL asks its clients for a certificate: give cert=, and key=",
            "peer did not return a certificate",
        ),
        (
            ssl.TLSVersion.TLSv1_3,
            "other.test",
            "URL rejected our certificate: unknown ca",
            "certificate",
        ),
        (
            ssl.TLSVersion.TLSv1_2,
            "other.test",
            "URL rejected our certificate: unknown ca",
            "certificate",
        ),
    ],
    ids=["none", "of another authority", "of another authority, with TLS 1.2"],
)
async def test_with_mutual_tls_a_client_whose_certificate_is_refused_is_told_so_and_gives_up(
    newest: ssl.TLSVersion, cert: str, text: str, line: str, reconnect: bool, heard: Hearing
) -> None:
    mine = TlsFiles(ca=pems().ca, cert=pems(cert).cert if cert else None).client()
    mine.maximum_version = newest
    async with serve(new_server(), tls_server(**pems()._asdict())) as (url,):
        failed = await failure(AuthenticationFailed, url, tls=mine, reconnect=reconnect)
        assert failed == text.replace("URL", url)
        (said,) = heard.warnings
        assert re.search(f": no TLS: .*{line}", said)
        assert await works(url, tls=TlsFiles(*pems()))


async def test_a_server_hears_why_a_client_refuses_it(heard: Hearing) -> None:
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
        await failure(AuthenticationFailed, url, tls=TlsFiles(ca=pems("other.test").ca))
        await heard.until(": no TLS: it rejected our certificate: unknown ca")


async def test_who_is_refused_and_does_not_go_is_not_waited_for_long(
    monkeypatch: pytest.MonkeyPatch, heard: Hearing
) -> None:
    monkeypatch.setattr(sockets, "LEAVE", 0.01)
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,), raw(url) as peer:
        await peer.say(b"hello?")
        with anyio.fail_after(5), pytest.raises(anyio.BrokenResourceError):
            while True:
                await peer.stream.send(b"and another thing")
                await anyio.lowlevel.checkpoint()
        assert len(heard.warnings) == 1


class _Failing(Named):
    """A stream that fails to read."""

    error: Exception = ssl.SSLError()

    async def receive(self, max_bytes: int) -> bytes:
        raise self.error


@pytest.mark.parametrize(
    ("reason", "kind", "text"),
    [
        ("TLSV13_ALERT_CERTIFICATE_REQUIRED", AuthenticationFailed, "robot asks its clients"),
        (
            "SSLV3_ALERT_CERTIFICATE_EXPIRED",
            AuthenticationFailed,
            "rejected .* certificate expired",
        ),
        ("SSLV3_ALERT_BAD_CERTIFICATE", AuthenticationFailed, "rejected .*: bad certificate"),
        ("TLSV1_ALERT_ACCESS_DENIED", AuthenticationFailed, "rejected .*: access denied"),
        ("TLSV1_ALERT_INTERNAL_ERROR", ConnectionLost, "the connection to robot broke"),
        ("CERTIFICATE_VERIFY_FAILED", ConnectionLost, "the connection to robot broke"),
        (None, ConnectionLost, "the connection to robot broke"),
    ],
)
async def test_what_a_server_says_instead_of_its_first_message_is_a_refusal_or_a_loss(
    reason: str | None, kind: type[TransportError], text: str
) -> None:
    error = ssl.SSLError()
    error.reason = reason  # type: ignore[assignment]  # as OpenSSL leaves it, if it has none
    stream: Any = _Failing(socket.AF_INET, None, error)
    with pytest.raises(kind, match=text) as caught:
        await TlsChannel(stream, "robot", FrameReader()).receive()
    assert type(caught.value) is kind
    assert caught.value.__cause__ is error


async def test_files_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    nonsense = tmp_path / "nonsense.pem"
    nonsense.write_text("nonsense")
    for files, problem in (
        ({}, "a TLS server needs a certificate: give cert=, and key="),
        ({"cert": "/none.pem"}, "cannot load TLS files /none.pem: .*No such file"),
        (
            {"cert": pems().cert, "key": str(nonsense)},
            f"cannot load TLS files .*, {nonsense}: ",
        ),
        (
            {"cert": pems().cert, "ca": str(nonsense)},
            f"cannot load TLS files {nonsense}, .*: ",
        ),
    ):
        assert re.search(problem, await refusal(tls_server(**files)))
    with pytest.raises(TransportError, match=f"cannot load TLS files {nonsense}: "):
        TlsFiles(ca=str(nonsense)).client()
    with pytest.raises(TransportError, match=r"cannot load TLS files /none\.pem: "):
        TlsFiles(cert="/none.pem").client()


@pytest.mark.parametrize("reconnect", [True, False])
async def test_a_plain_client_at_a_tls_server_is_told_so_and_gives_up(
    reconnect: bool, heard: Hearing
) -> None:
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
        plain = url.replace("tls://", "tcp://")
        failed = await failure(ProtocolError, plain, reconnect=reconnect)
        assert failed == f"{plain}: this server speaks TLS: use tls://"
        (said,) = heard.warnings
        assert said.endswith(": no TLS: it does not speak TLS")
        assert heard.records[-1].exc_info is None
        assert await works(url, tls=TlsFiles(ca=pems().ca))


@pytest.mark.parametrize("reconnect", [True, False])
async def test_a_tls_client_at_a_plain_server_is_told_so_and_gives_up(reconnect: bool) -> None:
    async with serve(new_server(), "tcp://127.0.0.1:0") as (url,):
        secured = url.replace("tcp://", "tls://")
        failed = await failure(AuthenticationFailed, secured, reconnect=reconnect)
        assert failed == (f"{secured} does not speak TLS: check the port, or use tcp://")


async def test_who_does_not_begin_with_tls_is_not_waited_for(heard: Hearing) -> None:
    limits = Limits(handshake=0.05)
    transport = TcpTransport(port=0, tls=TlsFiles(cert=pems().cert), limits=limits)
    async with serve(new_server(), transport) as (url,), raw(url) as peer:
        await heard.until(f"{peer.name}: no TLS: it took too long to shake hands")
        with anyio.fail_after(5), pytest.raises(anyio.EndOfStream):
            await peer.stream.receive()
        for _ in range(10):  # the server has done with it
            await anyio.lowlevel.checkpoint()


async def test_a_flood_of_unfinished_handshakes_ends_none_of_another_address(
    heard: Hearing,
) -> None:
    limits = Limits(connections=2)
    transport = TcpTransport(port=0, tls=TlsFiles(cert=pems().cert), limits=limits)
    async with serve(new_server(), transport) as (url,), AsyncExitStack() as silent:
        await silent.enter_async_context(raw(url))
        port = int(url.rpartition(":")[2])
        for _ in range(3):
            flood = await anyio.connect_tcp("127.0.0.1", port, local_host="127.0.0.2")
            await silent.enter_async_context(flood)
        await heard.until("no TLS: it took too long while 2 others began")
        assert all(line.startswith("127.0.0.2:") for line in heard.warnings)
        assert await works(f"{url}?ca={pems().ca}")


@pytest.mark.parametrize(
    ("exc", "text"),
    [
        (ConnectionResetError("reset"), "it hung up while shaking hands"),
        (anyio.BrokenResourceError(), "it hung up while shaking hands"),
        (anyio.EndOfStream(), "it hung up while shaking hands"),
        (ValueError("a bug"), "ValueError: a bug"),
    ],
)
async def test_whatever_ends_a_handshake_is_one_line_of_the_log_in_words(
    exc: Exception, text: str, heard: Hearing
) -> None:
    stream: Any = _Closing(socket.AF_INET, ("127.0.0.1", 5))
    await TlsListener.handle_handshake_error(exc, stream)
    assert stream.closed
    (said,) = heard.warnings
    assert said.startswith(f"127.0.0.1:5: no TLS: {text}")


async def test_a_server_can_stop_while_somebody_begins_with_tls(
    monkeypatch: pytest.MonkeyPatch, heard: Hearing
) -> None:
    begun = anyio.Event()
    shake_hands: Callable[..., Awaitable[object]] = TlsListener.shake_hands

    async def shakes_hands(*arguments: Any) -> object:
        begun.set()
        return await shake_hands(*arguments)

    monkeypatch.setattr(TlsListener, "shake_hands", shakes_hands)
    with anyio.fail_after(30):
        async with AsyncExitStack() as stack:
            async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
                await stack.enter_async_context(raw(url))
                await begun.wait()
    assert heard.warnings == []


async def test_a_client_whose_handshake_fails_closes_its_socket() -> None:
    closed = anyio.Event()

    async def speak_no_tls(stream: SocketStream) -> None:
        async with stream:
            await stream.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            try:
                while True:
                    await stream.receive()
            except (anyio.EndOfStream, anyio.BrokenResourceError):
                closed.set()

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, speak_no_tls)
            port = listener.extra(SocketAttribute.local_port)
            await failure(AuthenticationFailed, f"tls://127.0.0.1:{port}")
            with anyio.move_on_after(1):
                await closed.wait()
            tasks.cancel_scope.cancel()
    assert closed.is_set()


class _Closing(Named):
    """A stream that can be closed."""

    closed: bool = False

    async def aclose(self) -> None:
        self.closed = True


async def test_what_is_to_end_python_itself_goes_on_from_a_handshake_that_is_closed(
    heard: Hearing,
) -> None:
    stream: Any = _Closing(socket.AF_INET, ("127.0.0.1", 5))
    with pytest.raises(KeyboardInterrupt):
        await TlsListener.handle_handshake_error(KeyboardInterrupt(), stream)
    assert stream.closed
    assert heard.records == []


# Sessions


def counting() -> ssl.SSLContext:
    """The context of a server, which counts the sessions that were resumed."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(pems().cert)
    return context


@pytest.mark.parametrize("newest", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
async def test_the_next_connection_of_a_client_resumes_its_session(newest: ssl.TLSVersion) -> None:
    context = counting()
    context.maximum_version = newest
    async with serve(new_server(), TcpTransport(port=0, tls=context)) as (url,):
        transport = TcpTransport(port=port_of(url), tls=TlsFiles(ca=pems().ca))
        for resumed in range(3):
            assert await works(transport)
            assert context.session_stats()["hits"] == resumed


async def test_after_a_handshake_that_has_failed_no_session_is_resumed() -> None:
    context = counting()
    async with serve(new_server(), TcpTransport(port=0, tls=context)) as (url,):
        transport = TcpTransport(port=port_of(url), tls=TlsFiles(ca=pems().ca), reconnect=False)
        assert await works(transport)
    async with serve(new_server(), TcpTransport(port=port_of(url))):
        with pytest.raises(AuthenticationFailed, match="does not speak TLS"):
            await works(transport)
    async with serve(new_server(), TcpTransport(port=port_of(url), tls=context)):
        assert await works(transport)
        assert context.session_stats()["hits"] == 0


async def test_files_that_have_changed_are_read_anew_and_no_session_is_resumed(
    tmp_path: Path,
) -> None:
    authority = tmp_path / "ca.pem"
    copyfile(pems().ca, authority)
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
        transport = TcpTransport(port=port_of(url), tls=TlsFiles(ca=str(authority)))
        assert await works(transport)
        copyfile(pems("other.test").ca, authority)
        with pytest.raises(AuthenticationFailed, match="certificate"):
            await works(transport)
        authority.unlink()
        with pytest.raises(TransportError, match=f"cannot load TLS files {authority}"):
            await works(transport)


async def test_a_session_is_not_resumed_if_a_file_has_changed_during_its_handshake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = tmp_path / "ca.pem"
    copyfile(pems().ca, authority)
    keep = ClientTls.keep

    def changed(self: ClientTls, end: TlsEnd) -> None:
        os.utime(authority, (0, 0))
        self.context()  # of another connection
        keep(self, end)

    monkeypatch.setattr(ClientTls, "keep", changed)
    context = counting()
    async with serve(new_server(), TcpTransport(port=0, tls=context)) as (url,):
        transport = TcpTransport(port=port_of(url), tls=TlsFiles(ca=str(authority)))
        for resumed in (0, 0, 1):
            assert await works(transport)
            assert context.session_stats()["hits"] == resumed
