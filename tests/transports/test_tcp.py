"""`fibaction_transports.tcp`: addresses, sockets, TLS, tokens. The contract suite has the rest."""

from __future__ import annotations

import gc
import logging
import socket
import ssl
import stat
from collections.abc import AsyncGenerator, Callable, Generator
from errno import EMFILE
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import msgspec
import pytest
from anyio.abc import Listener, SocketAttribute, SocketStream, TaskGroup

from fibaction import (
    ActionClient,
    ActionServer,
    AuthenticationFailed,
    ConnectionLost,
    GoalHandle,
    GoalID,
    Outcome,
    ProtocolError,
    ServerNotFound,
    TransportError,
    UnknownGoal,
    connect,
    serve,
)
from fibaction.messages import Hello
from fibaction.wire.access import Peer, Verb
from fibaction.wire.limits import Limits
from fibaction_transports import tcp
from fibaction_transports.tcp import TcpTransport, TlsFiles, UnixTransport
from tests.certificates import pems
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.transports.hearing import Hearing, hearing, port_of, raw

pytestmark = pytest.mark.asyncio

SECRET = "correct-horse"

"""A handshake that fails leaves its socket open: see the last tests of TLS."""


@pytest.fixture(autouse=True)
def collected() -> Generator[None, None, None]:
    """What a test leaves open is found in that test, not in one that comes later."""
    yield
    gc.collect()


@pytest.fixture
def heard() -> Generator[Hearing, None, None]:
    with hearing() as found:
        yield found


def new_server() -> ActionServer[Goal, Feedback, Result]:
    return ActionServer(FIBONACCI, fibonacci)


async def works(url: str | TcpTransport | UnixTransport, **settings: Any) -> bool:
    with anyio.fail_after(5):
        async with connect(url, FIBONACCI, **settings) as client:
            return await client.call(Goal(3)) == Result([0, 1, 1, 2])


# Addresses


@pytest.fixture
def dialed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Where somebody tried to connect to; nobody ever answers."""
    found: list[tuple[str, int]] = []

    async def connect_tcp(host: str, port: int) -> SocketStream:
        found.append((host, port))
        raise ConnectionRefusedError(111, "refused")

    monkeypatch.setattr(anyio, "connect_tcp", connect_tcp)
    return found


@pytest.mark.parametrize(
    ("url", "host", "port", "told"),
    [
        ("tcp://", "127.0.0.1", 7400, "tcp://127.0.0.1:7400"),
        ("tcp://robot", "robot", 7400, "tcp://robot:7400"),
        ("tcp://robot:0", "robot", 0, "tcp://robot:0"),
        ("tcp://:81", "127.0.0.1", 81, "tcp://127.0.0.1:81"),
        ("tls://192.0.2.1:82", "192.0.2.1", 82, "tls://192.0.2.1:82"),
        ("tcp://[2001:db8::1]:83", "2001:db8::1", 83, "tcp://[2001:db8::1]:83"),
        ("tls://[::1]", "::1", 7400, "tls://[::1]:7400"),
        (f"tcp://robot:84?token={SECRET}", "robot", 84, "tcp://robot:84"),
    ],
)
async def test_a_url_says_where_the_server_is(
    url: str, host: str, port: int, told: str, dialed: list[tuple[str, int]]
) -> None:
    with pytest.raises(ServerNotFound) as caught:
        async with connect(url, reconnect=False):
            raise AssertionError("the block must not run")
    assert dialed == [(host, port)]
    assert str(caught.value) == (
        f"nobody listens at {told} (refused): start the server, or wait for it with"
        f" wait_for_server()"
    )


async def test_the_settings_behind_a_url_have_types_and_those_given_count_for_more() -> None:
    url = (
        f"tls://?token={SECRET}&heartbeat=0.5&reconnect=false&reconnect_timeout=7&window=3"
        "&insecure=true&grace=2&orphans=cancel&ca=a&cert=b&key=c"
    )
    made = TcpTransport.from_url(url, window=5)
    keeping = made._keeping
    assert (keeping.token, keeping.heartbeat, keeping.window) == (SECRET, 0.5, 5)
    assert (keeping.reconnect, keeping.reconnect_timeout) == (False, 7.0)
    assert (made._insecure, made._terms.grace, made._terms.orphans) == (True, 2.0, "cancel")
    assert made._terms.heartbeat == 0.5
    assert made._tls == TlsFiles("a", "b", "c")
    local = UnixTransport.from_url("unix:///run/a%20b?window=3&reconnect=true", window=4)
    assert (local._path, local._keeping.window) == (Path("/run/a b"), 4)


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        (f"tcp://robot?tokem={SECRET}", "tcp://robot has no setting 'tokem'"),
        (
            f"tcp://robot?window=few&token={SECRET}",
            "tcp://robot: the setting 'window' cannot be 'few'",
        ),
        (
            f"tcp://robot?token={SECRET}&reconnect=maybe",
            "tcp://robot: the setting 'reconnect' cannot be 'maybe'",
        ),
        (
            f"unix:///run/x?token={SECRET}&grace=long",
            "unix:///run/x: the setting 'grace' cannot be 'long'",
        ),
        ("tcp://robot?ca=x", "tcp://robot has no setting 'ca'"),
        ("unix:///run/x?insecure=", "unix:///run/x has no setting 'insecure'"),
        ("tcp://robot?insecure=", "tcp://robot: the setting 'insecure' cannot be ''"),
        ("tcp://robot:99999", "tcp://robot:99999 has no good port: Port out of range 0-65535"),
        (
            "tcp://robot:-1",
            "tcp://robot:-1 has no good port: Port could not be cast to integer value as '-1'",
        ),
        ("unix://", "the URL of a socket is like unix:///run/robot.sock, not unix://"),
        ("unix:///", "the URL of a socket is like unix:///run/robot.sock, not unix:///"),
        ("unix://x/y", "the URL of a socket is like unix:///run/robot.sock, not unix://x/y"),
    ],
)
async def test_a_bad_url_is_refused_in_one_sentence(url: str, problem: str) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert type(caught.value) is TransportError
    assert str(caught.value) == problem


@pytest.mark.parametrize(
    "url",
    [
        f"tcp://robot:99999?token={SECRET}",
        f"unix://x/y?token={SECRET}",
        f"tcp:robot?token={SECRET}",
    ],
)
async def test_a_bad_url_is_refused_without_telling_its_token(url: str) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize("url", ["tcp://[::1", "tcp://robot?heartbeat=0", "tcp://robot?window=-1"])
async def test_a_bad_url_is_a_transport_error_whatever_is_bad(url: str) -> None:
    with pytest.raises(TransportError):
        connect(url)


@pytest.mark.parametrize(
    ("url", "what"),
    [
        (f"tcp://me:{SECRET}@robot:7400", "tcp://robot:7400 has a user"),
        (f"tls://{SECRET}@robot?ca=x", "tls://robot has a user"),
        ("tcp://@robot", "tcp://robot has a user"),
        ("tcp://robot:7400/arm", "tcp://robot:7400/arm has a path"),
        ("tcp:///run/robot.sock", "tcp:///run/robot.sock has a path"),
        (f"tcp://robot?token={SECRET}#1", "tcp://robot has a part behind #"),
    ],
)
async def test_what_a_url_says_besides_is_refused_and_not_left_out_silently(
    url: str, what: str
) -> None:
    with pytest.raises(TransportError) as caught:
        connect(url)
    assert str(caught.value) == (
        f"{what}, and the URL of a server is like {url[:3]}://host:port,"
        f" with settings behind ? such as token="
    )
    assert TcpTransport.from_url("tcp://robot:7400/")._where == "tcp://robot:7400"


async def test_a_socket_whose_path_cannot_be_is_refused() -> None:
    with pytest.raises(TransportError):
        async with serve(new_server(), "unix:///tmp/a%00b"):
            raise AssertionError("the block must not run")


async def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match=r"heartbeat is between 0\.001 and 3600, not 0"):
        TcpTransport(heartbeat=0)
    with pytest.raises(ValueError, match="window is between 1 and 2147483647, not 0"):
        UnixTransport("/run/x", window=0)
    with pytest.raises(ValueError, match="grace is between 0 and inf, not nan"):
        TcpTransport(grace=float("nan"))
    with pytest.raises(TransportError, match="orphans is 'keep' or 'cancel', not 'eat'"):
        TcpTransport.from_url("tcp://robot?orphans=eat")


async def test_a_setting_that_there_is_not_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="speed"):
        TcpTransport.from_url("tcp://", speed=3)
    with pytest.raises(TypeError, match="speed"):
        UnixTransport.from_url("unix:///x", speed=3)


# Listening


async def test_with_port_0_the_url_has_the_port_that_was_found() -> None:
    async with serve(new_server(), "tcp://127.0.0.1:0", "tcp://localhost:0") as (one, other):
        assert 0 != port_of(one) != port_of(other) != 0
        assert one == f"tcp://127.0.0.1:{port_of(one)}"
        assert await works(one)
        assert await works(other)


async def test_an_ipv6_address_is_in_brackets() -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            pass
    except OSError:
        pytest.skip("this machine has no IPv6")
    async with serve(new_server(), "tcp://[::1]:0") as (url,):
        assert url == f"tcp://[::1]:{port_of(url)}"
        assert await works(url)


async def test_an_address_in_use_is_refused() -> None:
    async with serve(new_server(), "tcp://127.0.0.1:0") as (url,):
        with pytest.raises(TransportError) as caught:
            async with serve(new_server(), url):
                raise AssertionError("the block must not run")
        assert str(caught.value).lower() == f"cannot listen at {url}: address already in use"
        assert await works(url)


async def test_two_actions_of_one_name_are_refused() -> None:
    with pytest.raises(TransportError, match="two of the endpoints serve actions of the same name"):
        async with serve([new_server(), new_server()], "tcp://127.0.0.1:0"):
            raise AssertionError("the block must not run")


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which hosts somebody wanted to listen at; he gets a loopback address instead."""
    hosts: list[str] = []
    listen = anyio.create_tcp_listener

    async def create_tcp_listener(*, local_host: str, local_port: int) -> Listener[Any]:
        hosts.append(local_host)
        return await listen(local_host="127.0.0.1", local_port=local_port)

    monkeypatch.setattr(anyio, "create_tcp_listener", create_tcp_listener)
    return hosts


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "[::]", "[2001:db8::1]", "robot.test"])
async def test_a_public_address_needs_tls_or_an_explicit_word(
    host: str, listening: list[str]
) -> None:
    with pytest.raises(TransportError) as caught:
        async with serve(new_server(), f"tcp://{host}:0"):
            raise AssertionError("the block must not run")
    assert str(caught.value) == (
        f"tcp://{host}:0 can be reached from other machines: use tls://, or say insecure=True if"
        f" the network is your own"
    )
    assert listening == []
    for url in (f"tcp://{host}:0?insecure=true", f"tls://{host}:0?cert={pems().cert}"):
        async with serve(new_server(), url):
            pass
    assert listening == [host.strip("[]")] * 2


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "localhost", "[::1]"])
async def test_a_loopback_address_needs_neither(host: str, listening: list[str]) -> None:
    async with serve(new_server(), f"tcp://{host}:0"):
        assert listening == [host.strip("[]")]


class _OutOfFiles(Listener[Any]):
    """A listener that cannot accept at first."""

    def __init__(self, listener: Listener[Any]) -> None:
        self.failures = 2
        self._listener = listener

    async def serve(
        self, handler: Callable[[Any], Any], task_group: TaskGroup | None = None
    ) -> None:
        if self.failures:
            self.failures -= 1
            raise OSError(EMFILE, "Too many open files")
        await self._listener.serve(handler, task_group)

    async def aclose(self) -> None:
        await self._listener.aclose()

    @property
    def extra_attributes(self) -> Any:
        return self._listener.extra_attributes


async def test_a_server_that_cannot_accept_for_a_while_goes_on_afterwards(
    monkeypatch: pytest.MonkeyPatch, heard: Hearing
) -> None:
    listen = anyio.create_tcp_listener

    async def create_tcp_listener(**where: Any) -> Listener[Any]:
        return _OutOfFiles(await listen(**where))

    monkeypatch.setattr(anyio, "create_tcp_listener", create_tcp_listener)
    monkeypatch.setattr(tcp, "ACCEPT_PAUSE", 0)
    async with serve(new_server(), "tcp://127.0.0.1:0") as (url,):
        assert await works(url)
    said = "tcp://127.0.0.1:0 cannot accept connections: [Errno 24] Too many open files"
    assert heard.warnings == [said, said]


@pytest.mark.parametrize("scheme", ["tcp", "tls"])
async def test_a_client_sends_small_messages_at_once(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sockets: list[socket.socket] = []
    connect_tcp = anyio.connect_tcp

    async def connect_slowly(host: str, port: int) -> SocketStream:
        stream = await connect_tcp(host, port)
        made = stream.extra(SocketAttribute.raw_socket)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0)
        sockets.append(made)
        # Python 3.11 does not trace what follows a task group that was left by a cancellation, as
        # that of `connect_tcp` is, until the task has waited once more.
        await anyio.lowlevel.checkpoint()
        return stream

    monkeypatch.setattr(anyio, "connect_tcp", connect_slowly)
    settings: dict[str, Any] = {"tls": TlsFiles(*pems())} if scheme == "tls" else {}
    async with serve(new_server(), TcpTransport(port=0, **settings)) as (url,):
        async with connect(url, **settings) as connection:
            assert sockets[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert await connection.actions() == [FIBONACCI.info]


# Unix sockets


async def test_a_unix_socket_is_for_its_owner_only_and_is_removed_afterwards(
    tmp_path: Path,
) -> None:
    path = tmp_path / "robot arm.sock"
    async with serve(new_server(), f"unix://{tmp_path}/robot%20arm.sock") as (url,):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert await works(url)
        assert await works(UnixTransport(path))
    assert not path.exists()
    with pytest.raises(ServerNotFound, match=f"nobody listens at unix://{path} "):
        async with connect(UnixTransport(path, reconnect=False)):
            raise AssertionError("the block must not run")


async def test_a_socket_file_that_a_dead_server_left_behind_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    async with serve(new_server(), UnixTransport(path)) as (url,):
        assert stat.S_ISSOCK(path.stat().st_mode)
        assert await works(url)
    assert not path.exists()


async def test_a_unix_socket_that_is_in_use_is_refused_and_stays(tmp_path: Path) -> None:
    async with serve(new_server(), f"unix://{tmp_path}/socket") as (url,):
        with pytest.raises(TransportError) as caught:
            async with serve(new_server(), url):
                raise AssertionError("the block must not run")
        assert str(caught.value) == f"cannot listen at {url}: somebody does already"
        assert await works(url)


async def test_another_file_in_the_way_of_a_unix_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "diary"
    path.write_text("dear diary")
    with pytest.raises(TransportError, match=f"cannot listen at unix://{path}: "):
        async with serve(new_server(), UnixTransport(path)):
            raise AssertionError("the block must not run")
    assert path.read_text() == "dear diary"


# TLS


def tls_server(**files: str) -> str:
    query = "&".join(f"{name}={value}" for name, value in files.items())
    return f"tls://127.0.0.1:0?{query}"


async def test_a_client_that_knows_the_authority_is_served_over_tls() -> None:
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
        assert url == f"tls://127.0.0.1:{port_of(url)}"
        assert await works(url, tls=TlsFiles(ca=pems().ca))
        assert await works(f"{url}?ca={pems().ca}")


async def test_contexts_of_ones_own_are_used_as_they_are() -> None:
    serving = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    serving.load_cert_chain(pems().cert)
    connecting = ssl.create_default_context(cafile=pems().ca)
    async with serve(new_server(), TcpTransport(port=0, tls=serving)) as (url,):
        assert await works(TcpTransport(port=port_of(url), tls=connecting))


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
            with anyio.fail_after(5), pytest.raises(AuthenticationFailed, match=reason) as caught:
                async with connect(url, tls=trusted, reconnect=reconnect):
                    raise AssertionError("the block must not run")
            assert str(caught.value).startswith(f"no TLS with {url}: ")


async def test_with_mutual_tls_a_client_that_has_a_certificate_is_served() -> None:
    async with serve(new_server(), tls_server(**pems()._asdict())) as (url,):
        assert await works(url, tls=TlsFiles(*pems()))


async def test_with_mutual_tls_a_client_without_a_certificate_is_not_served(
    heard: Hearing,
) -> None:
    async with serve(new_server(), tls_server(**pems()._asdict())) as (url,):
        with anyio.fail_after(5), pytest.raises(TransportError):
            async with connect(
                url, FIBONACCI, tls=TlsFiles(ca=pems().ca), reconnect=False, heartbeat=0.1
            ) as client:
                await client.call(Goal(1))
        (said,) = heard.warnings
        assert said.endswith(": no TLS: PEER_DID_NOT_RETURN_A_CERTIFICATE")
        assert await works(url, tls=TlsFiles(*pems()))


async def test_a_client_without_a_certificate_is_not_let_in_and_the_servers_log_says_why(
    heard: Hearing,
) -> None:
    async with serve(new_server(), tls_server(**pems()._asdict())) as (url,):
        # It has shaken hands by the time that the server looks at its certificate, and all that it
        # sees then is that the connection is closed.
        with anyio.fail_after(5), pytest.raises(ConnectionLost):
            async with connect(url, tls=TlsFiles(ca=pems().ca), reconnect=False, heartbeat=1):
                raise AssertionError("the block must not run")
        await heard.until("no TLS: PEER_DID_NOT_RETURN_A_CERTIFICATE")


async def test_files_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    nonsense = tmp_path / "nonsense.pem"
    nonsense.write_text("nonsense")
    for files, problem in (
        ({}, "a TLS server needs a certificate: say cert=, and key="),
        ({"cert": "/none.pem"}, "there is no TLS with /none.pem: .*No such file"),
        ({"cert": pems().cert, "key": str(nonsense)}, f"there is no TLS with .*, {nonsense}: "),
        ({"cert": pems().cert, "ca": str(nonsense)}, f"there is no TLS with {nonsense}, .*: "),
    ):
        with pytest.raises(TransportError, match=problem):
            async with serve(new_server(), tls_server(**files)):
                raise AssertionError("the block must not run")
    with pytest.raises(TransportError, match=f"there is no TLS with {nonsense}: "):
        TlsFiles(ca=str(nonsense)).client()
    with pytest.raises(TransportError, match=r"there is no TLS with /none\.pem: "):
        TlsFiles(cert="/none.pem").client()


async def test_plain_text_at_a_tls_port_is_one_line_in_the_log(heard: Hearing) -> None:
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
        async with raw(url) as peer:
            await peer.say(b"hello?")
            record = await heard.until(peer.name)
            assert record.getMessage() == f"{peer.name}: no TLS: WRONG_VERSION_NUMBER"
            assert (record.levelno, record.exc_info) == (logging.WARNING, None)
            assert await works(url, tls=TlsFiles(ca=pems().ca))
        assert heard.warnings == [record.getMessage()]


async def test_who_does_not_begin_with_tls_is_not_waited_for(heard: Hearing) -> None:
    limits = Limits(handshake=0.05)
    transport = TcpTransport(port=0, tls=TlsFiles(cert=pems().cert), limits=limits)
    async with serve(new_server(), transport) as (url,), raw(url) as peer:
        await heard.until(f"{peer.name}: no TLS: TimeoutError")


async def test_a_server_can_stop_while_somebody_begins_with_tls() -> None:
    with anyio.fail_after(5):
        async with serve(new_server(), tls_server(cert=pems().cert)) as (url,), raw(url):
            await anyio.wait_all_tasks_blocked()


async def test_plain_text_at_a_tls_port_ends_the_connection() -> None:
    async with serve(new_server(), tls_server(cert=pems().cert)) as (url,), raw(url) as peer:
        await peer.say(b"hello?")
        with anyio.fail_after(1), pytest.raises((anyio.EndOfStream, anyio.BrokenResourceError)):
            while True:
                await peer.stream.receive()


async def test_a_server_that_closes_during_the_handshake_is_a_transport_error() -> None:
    async def hang_up(stream: SocketStream) -> None:
        await stream.aclose()

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, hang_up)
            port = listener.extra(SocketAttribute.local_port)
            with anyio.fail_after(5), pytest.raises(TransportError):
                async with connect(f"tls://127.0.0.1:{port}", reconnect=False):
                    raise AssertionError("the block must not run")
            tasks.cancel_scope.cancel()


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
            with anyio.fail_after(5), pytest.raises(AuthenticationFailed):
                async with connect(f"tls://127.0.0.1:{port}"):
                    raise AssertionError("the block must not run")
            with anyio.move_on_after(1):
                await closed.wait()
            tasks.cancel_scope.cancel()
    assert closed.is_set()


# Tokens and permissions


async def test_a_token_opens_the_door_and_nothing_else_does(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    people: list[Peer] = []

    def authorize(peer: Peer, action: str, verb: Verb) -> bool:
        people.append(peer)
        return True

    serving = TcpTransport(port=0, tokens={SECRET: "ann", "other": "bob"}, authorize=authorize)
    shown: list[object] = [serving, serving._terms, serving._keeping, serving.__dict__]
    async with serve(new_server(), serving) as (url,):
        for wrong in (f"{url}?token=wrong-{SECRET}", f"{url}?token={SECRET[:-1]}", url):
            for reconnect in (True, False):
                with anyio.fail_after(5), pytest.raises(AuthenticationFailed) as caught:
                    async with connect(wrong, reconnect=reconnect):
                        raise AssertionError("the block must not run")
                assert str(caught.value) == (
                    f"{url}: the server has closed the connection: its token is not one of this"
                    f" server's"
                )
        connecting = TcpTransport.from_url(f"{url}?token={SECRET}")
        async with connect(connecting) as connection:
            client = connection.client(FIBONACCI)
            goal = await client.send_goal(Goal(1))
            assert await goal.result() == Result([0, 1])
            shown += [connecting, connecting._keeping, connecting.__dict__]
            shown += [connection, connection._connection, connection._connection.__dict__]
            shown += [client, client.endpoint, goal, goal._stream, goal._stream.__dict__]
    shown += [people, url, Hello(1, 1.0, SECRET)]
    assert {peer.name for peer in people} == {"ann"}
    assert SECRET not in repr(shown)
    assert SECRET not in caplog.text
    assert "its token is not one of this server's" in caplog.text


async def test_a_server_with_an_empty_token_is_refused() -> None:
    for tokens in ({}, {"": "anybody"}):
        with pytest.raises(ValueError, match="needs at least one, and none empty"):
            TcpTransport(tokens=tokens)


async def do(client: ActionClient[Goal, Feedback, Result], verb: Verb) -> None:
    if verb is Verb.SEND:
        await client.call(Goal(1))
    elif verb is Verb.CANCEL:
        await client.cancel_goals()
    else:
        (await client.endpoint.status()).close()


@pytest.mark.parametrize("sync", [True, False])
@pytest.mark.parametrize("allowed", list(Verb))
async def test_each_verb_is_allowed_by_itself(allowed: Verb, sync: bool) -> None:
    asked: list[tuple[str, str, Verb]] = []

    def decide(peer: Peer, action: str, verb: Verb) -> bool:
        asked.append((peer.name, action, verb))
        return verb is allowed

    async def decide_later(peer: Peer, action: str, verb: Verb) -> bool:
        await anyio.lowlevel.checkpoint()
        return decide(peer, action, verb)

    settings: dict[str, Any] = {"authorize": decide if sync else decide_later}
    transport = TcpTransport(port=0, tokens={SECRET: "ann"}, **settings)
    async with serve(new_server(), transport) as (url,):
        async with connect(f"{url}?token={SECRET}", FIBONACCI) as client:
            with anyio.fail_after(5):
                for verb in Verb:
                    if verb is allowed:
                        await do(client, verb)
                        continue
                    with pytest.raises(AuthenticationFailed) as caught:
                        await do(client, verb)
                    assert str(caught.value) == (
                        f"this client may not {verb.value} at the action 'fibonacci'"
                    )
    assert asked == [("ann", "fibonacci", verb) for verb in Verb]


async def test_who_may_not_observe_cannot_tell_whether_a_goal_exists() -> None:
    def authorize(peer: Peer, action: str, verb: Verb) -> bool:
        return peer.name == "ann" or verb is Verb.SEND

    async def told(client: ActionClient[Goal, Feedback, Result], goal_id: GoalID) -> list[str]:
        answers: list[str] = []
        for ask in (
            lambda: client.attach(goal_id),
            lambda: client.attach(goal_id, after=0),
            lambda: client.endpoint.get_result(goal_id),
            lambda: client.cancel_goals(goal_id),
        ):
            with pytest.raises(AuthenticationFailed) as caught:
                await ask()
            answers.append(str(caught.value))
        return answers

    transport = TcpTransport(port=0, tokens={"a": "ann", "b": "bob"}, authorize=authorize)
    async with serve(new_server(), transport) as (url,):
        async with connect(f"{url}?token=a", FIBONACCI) as ann:
            async with connect(f"{url}?token=b", FIBONACCI) as bob:
                with anyio.fail_after(5):
                    goal = await ann.send_goal(Goal(1))
                    assert (await ann.endpoint.get_result(goal.goal_id)).result
                    there = await told(bob, goal.goal_id)
                    assert there == await told(bob, GoalID.random())


async def test_who_may_only_send_cannot_follow_a_goal_of_somebody_else() -> None:
    def authorize(peer: Peer, action: str, verb: Verb) -> bool:
        return peer.name == "ann" or verb is Verb.SEND

    transport = TcpTransport(port=0, tokens={"a": "ann", "b": "bob"}, authorize=authorize)
    async with serve(new_server(), transport) as (url,):
        async with connect(f"{url}?token=a", FIBONACCI) as ann:
            async with connect(f"{url}?token=b", FIBONACCI) as bob:
                with anyio.fail_after(5):
                    goal = await ann.send_goal(Goal(5))
                    found: list[Outcome[bytes]] = []
                    try:
                        with await bob.endpoint.feedback(goal.goal_id, own=True) as stream:
                            found.append(await stream.outcome())
                    except (AuthenticationFailed, UnknownGoal):
                        pass
                    assert found == []


async def test_a_permission_that_cannot_be_found_out_is_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def authorize(peer: Peer, action: str, verb: Verb) -> bool:
        raise OSError("no directory")

    async with serve(new_server(), TcpTransport(port=0, authorize=authorize)) as (url,):
        async with connect(url, FIBONACCI) as client:
            with anyio.fail_after(5), pytest.raises(ServerNotFound, match="failed: OSError"):
                await client.call(Goal(1))
    assert "no directory" in caplog.text


async def test_what_says_yes_must_say_true(heard: Hearing) -> None:
    def authorize(peer: Peer, action: str, verb: Verb) -> Any:
        return "yes"

    async with serve(new_server(), TcpTransport(port=0, authorize=authorize)) as (url,):
        async with connect(url, FIBONACCI) as client:
            with anyio.fail_after(5), pytest.raises(AuthenticationFailed):
                await client.call(Goal(1))


# Peers


class _Named(msgspec.Struct):
    """As much of a stream as has a remote address."""

    family: socket.AddressFamily
    address: Any

    def extra(self, attribute: object, default: object = None) -> Any:
        if attribute is SocketAttribute.family:
            return self.family
        assert attribute is SocketAttribute.remote_address
        return self.address or default


async def test_a_peer_is_named_by_its_address_if_it_has_one() -> None:
    for family, address, name in (
        (socket.AF_INET, ("127.0.0.1", 5), "127.0.0.1:5"),
        (socket.AF_INET, None, "a peer that has left"),
        (socket.AF_UNIX, "", "a local process"),
    ):
        stream: Any = _Named(family, address)
        assert tcp._peer_of(stream) == name


async def test_the_log_names_the_peer(heard: Hearing, tmp_path: Path) -> None:
    started = anyio.Event()

    async def executor(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        started.set()
        yield Result([])

    addresses = ("tcp://127.0.0.1:0", f"unix://{tmp_path}/socket")
    async with serve(ActionServer(FIBONACCI, executor), *addresses) as urls:
        for url in urls:
            async with connect(url, FIBONACCI) as client:
                await client.call(Goal(1))
    left = "left: the client has what it wanted"
    assert (await heard.until(left)).getMessage().startswith("127.0.0.1:")
    await heard.until(f"a local process: a local process {left}")


class _Closing(_Named):
    """A stream that can be closed."""

    closed: bool = False

    async def aclose(self) -> None:
        self.closed = True


async def test_what_is_to_end_python_itself_goes_on_from_a_handshake_that_is_closed() -> None:
    stream: Any = _Closing(socket.AF_INET, ("127.0.0.1", 5))
    with pytest.raises(KeyboardInterrupt):
        await tcp._TlsListener.handle_handshake_error(KeyboardInterrupt(), stream)
    assert stream.closed


# Messages that are too large


async def test_what_is_too_large_is_one_goals_error_and_the_connection_lives(
    heard: Hearing,
) -> None:
    go = anyio.Event()

    async def executor(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        if goal.request.order:
            yield Feedback([0] * goal.request.order)
        else:
            await go.wait()
        yield Feedback([1])
        yield Result([0] * goal.request.order)

    server = ActionServer(FIBONACCI, executor)
    small = TcpTransport(port=0, limits=Limits(frame=1000))
    async with serve(server, small) as (url,):
        connecting = TcpTransport.from_url(url, limits=Limits(frame=500))
        async with connect(connecting) as connection:
            client = connection.client(FIBONACCI)
            with anyio.fail_after(5):
                other = await client.send_goal(Goal(0))
                goal = await client.send_goal(Goal(700))
                assert (await anext(goal.feedback)).partial_sequence == [1]
                assert goal.feedback_dropped == 1
                with pytest.raises(TransportError, match="500 are the limit"):
                    await goal.result()
                with pytest.raises(ProtocolError, match="1000 are the server's limit"):
                    await connection.endpoint(FIBONACCI).send_goal(GoalID.random(), bytes(1000))
                go.set()
                assert await other.result() == Result([])
        await heard.until("left: ")
        lines = [one.getMessage() for one in heard.records if one.levelno == logging.INFO]
        assert len(lines) == 1  # there was one connection, to the end


async def test_a_wait_at_a_unix_socket_that_is_canceled_as_data_comes_leaves_no_trace(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "socket"))
    listener.listen()
    stream = await UnixTransport(tmp_path / "socket")._open_stream()
    with anyio.fail_after(5):
        async with stream:
            other, _ = listener.accept()
            with other, listener:
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(stream.receive)
                    await anyio.wait_all_tasks_blocked()
                    other.send(b"1")
                    await anyio.lowlevel.checkpoint()  # now the event loop knows of it
                    tasks.cancel_scope.cancel()
                await anyio.lowlevel.checkpoint()
                assert await stream.receive() == b"1"
                await stream.send_eof()
                assert other.recv(1) == b""
        with pytest.raises(anyio.ClosedResourceError):
            await stream.receive()
    assert caplog.records == []
