"""`fibaction_transports.tcp`: addresses, sockets, tokens.

The contract suite has the rest.
"""

from __future__ import annotations

import logging
import re
import socket
import stat
from collections.abc import AsyncGenerator
from errno import EMFILE
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import ByteStream, Listener, SocketAttribute, SocketStream

from fibaction import (
    ActionClient,
    ActionServer,
    AuthenticationFailed,
    GoalHandle,
    GoalID,
    InvalidURL,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.messages import Hello
from fibaction_transports._socket_lines import on_asyncio, stream_transport
from fibaction_transports.tcp import TcpTransport, TlsFiles, UnixTransport
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.transports.hearing import Hearing, port_of, raw
from tests.transports.tcp.servers import SECRET, failure, new_server, refusal, tls_server, works

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    """What is for trio runs that by itself."""
    return "asyncio"


@pytest.fixture
def dialed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Where somebody tried to connect to; nobody ever answers."""
    found: list[tuple[str, int]] = []

    async def refuse(host: str, port: int, *_: object) -> SocketStream:
        found.append((host, port))
        raise ConnectionRefusedError(111, "refused")

    monkeypatch.setattr(anyio, "connect_tcp", refuse)
    monkeypatch.setattr(on_asyncio, "dial_tcp", refuse)
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
    failed = await failure(ServerNotFound, url, reconnect=False)
    assert dialed == [(host, port)]
    assert failed == (
        f"no server listens at {told} (refused): start the server, or wait for it with"
        f" wait_for_server()"
    )


async def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match=r"heartbeat must be between 0\.001 and 3600, not 0"):
        TcpTransport(heartbeat=0)
    with pytest.raises(ValueError, match="window must be between 1 and 2147483647, not 0"):
        UnixTransport("/run/x", window=0)
    with pytest.raises(ValueError, match="grace must be between 0 and inf, not nan"):
        TcpTransport(grace=float("nan"))
    for port in (-1, 65536):
        with pytest.raises(ValueError, match=f"port must be between 0 and 65535, not {port}"):
            TcpTransport(port=port)
    with pytest.raises(TransportError, match="orphans must be 'keep' or 'cancel', not 'eat'"):
        TcpTransport.from_url("tcp://robot?orphans=eat")


@pytest.mark.parametrize("host", ["a" * 64, ".robot"])
async def test_nobody_is_at_a_host_whose_name_cannot_be(host: str) -> None:
    assert re.search(
        f"^invalid host in tcp://{host}:81: .*label",
        await failure(InvalidURL, f"tcp://{host}:81", reconnect=False),
    )


async def test_a_host_whose_name_cannot_be_is_no_place_to_listen_at() -> None:
    assert re.search(
        r"^cannot listen at tcp://☃:81: Codepoint",
        await refusal(TcpTransport("☃", 81, insecure=True)),
    )


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
        refused = await refusal(url)
        assert refused.lower() == f"address already in use: {url}"
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
    refused = await refusal(f"tcp://{host}:0")
    assert refused == (
        f"tcp://{host}:0 can be reached from other machines: use tls://, or, if the network is"
        f" your own, append ?insecure=true to the URL (in code insecure=True)"
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


async def test_a_server_that_cannot_accept_for_a_while_goes_on_afterwards(
    monkeypatch: pytest.MonkeyPatch, heard: Hearing
) -> None:
    accept, failures = on_asyncio.accept, [OSError(EMFILE, "Too many open files")] * 2

    async def accept_later(*given: Any) -> None:
        if failures:
            raise failures.pop()
        await accept(*given)

    monkeypatch.setattr(on_asyncio, "accept", accept_later)
    monkeypatch.setattr(stream_transport, "ACCEPT_PAUSE", 0)
    async with serve(new_server(), "tcp://127.0.0.1:0") as (url,):
        assert await works(url)
    said = "tcp://127.0.0.1:0 cannot accept connections: [Errno 24] Too many open files"
    assert heard.warnings == [said, said]


@pytest.mark.parametrize("scheme", ["tcp", "tls"])
def test_a_client_sends_small_messages_at_once(scheme: str) -> None:
    """On trio, where the socket is anyio's; for asyncio see the tests of `_asyncio`."""
    sockets: list[socket.socket] = []
    connect_tcp = anyio.connect_tcp

    async def connect_slowly(host: str, port: int) -> SocketStream:
        stream = await connect_tcp(host, port)
        made = stream.extra(SocketAttribute.raw_socket)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0)
        sockets.append(made)
        return stream

    async def main() -> None:
        settings: dict[str, Any] = {"tls": TlsFiles(*pems())} if scheme == "tls" else {}
        async with serve(new_server(), TcpTransport(port=0, **settings)) as (url,):
            async with connect(url, **settings) as connection:
                assert sockets[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
                assert await connection.actions() == [FIBONACCI.info]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anyio, "connect_tcp", connect_slowly)
        anyio.run(main, backend="trio")


def test_on_trio_too_who_hangs_up_while_shaking_hands_keeps_no_other_out(heard: Hearing) -> None:
    async def main() -> None:
        async with serve(new_server(), tls_server(cert=pems().cert)) as (url,):
            async with raw(url) as peer:
                await peer.stream.send(b"\x16\x03\x01")  # how TLS begins
            await heard.until(": no TLS: it hung up while shaking hands")
            assert await works(f"{url}?ca={pems().ca}")

    anyio.run(main, backend="trio")


def test_a_unix_socket_is_one_sentence_on_a_system_without_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(socket, "AF_UNIX")
    with pytest.raises(TransportError, match=r"^unix:///run/robot.sock needs a system with Unix"):
        UnixTransport("/run/robot.sock")


async def test_a_server_that_hangs_up_in_the_handshake_is_a_transport_error() -> None:
    async def hang_up(stream: SocketStream) -> None:
        await stream.aclose()

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, hang_up)
            port = listener.extra(SocketAttribute.local_port)
            await failure(TransportError, f"tls://127.0.0.1:{port}", reconnect=False)
            tasks.cancel_scope.cancel()


async def test_a_unix_socket_is_for_its_owner_only_and_is_removed_afterwards(
    tmp_path: Path,
) -> None:
    path = tmp_path / "robot arm.sock"
    async with serve(new_server(), f"unix://{tmp_path}/robot%20arm.sock") as (url,):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert await works(url)
        assert await works(UnixTransport(path))
    assert not path.exists()
    assert re.search(
        f"no server listens at unix://{path} ",
        await failure(ServerNotFound, UnixTransport(path, reconnect=False)),
    )


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
        refused = await refusal(url)
        assert refused == f"address already in use: {url}"
        assert await works(url)


async def test_a_server_that_stops_leaves_the_socket_of_its_successor_alone(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    has_begun, is_to_stop, has_stopped = anyio.Event(), anyio.Event(), anyio.Event()

    async def serve_before() -> None:
        async with serve(new_server(), UnixTransport(path)):
            has_begun.set()
            await is_to_stop.wait()
        has_stopped.set()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(serve_before)
        with anyio.fail_after(30):
            await has_begun.wait()
        path.unlink()  # as a script does that begins with `rm -f`
        async with serve(new_server(), UnixTransport(path)) as (url,):
            is_to_stop.set()
            with anyio.fail_after(30):
                await has_stopped.wait()
            assert await works(url)
    assert not path.exists()


async def test_a_server_whose_socket_was_removed_stops_as_any_other(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    async with serve(new_server(), UnixTransport(path)) as (url,):
        async with connect(url, FIBONACCI) as client:
            path.unlink()
            await client.call(Goal(1))
    assert not path.exists()


async def test_another_file_in_the_way_of_a_unix_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "diary"
    path.write_text("dear diary")
    assert re.search(f"cannot listen at unix://{path}: ", await refusal(UnixTransport(path)))
    assert path.read_text() == "dear diary"


async def test_a_token_opens_the_door_and_nothing_else_does(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    people: list[Peer] = []

    def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        people.append(peer)
        return True

    serving = TcpTransport(port=0, tokens={SECRET: "ann", "other": "bob"}, authorize=authorize)
    shown: list[object] = [serving, serving.settings, serving.__dict__]
    async with serve(new_server(), serving) as (url,):
        none = (
            "the server asks for a token, and the client gave none: give one as token=, or in"
            " the URL as ?token="
        )
        for wrong, text in (
            (f"{url}?token=wrong-{SECRET}", "the server rejected the client's token"),
            (f"{url}?token={SECRET[:-1]}", "the server rejected the client's token"),
            (url, none),
        ):
            for reconnect in (True, False):
                failed = await failure(AuthenticationFailed, wrong, reconnect=reconnect)
                assert failed == f"{url}: {text}"
        connecting = TcpTransport.from_url(f"{url}?token={SECRET}")
        async with connect(connecting) as connection:
            client = connection.client(FIBONACCI)
            goal = await client.send_goal(Goal(1))
            assert await goal.result() == Result([0, 1])
            shown += [connecting, connecting.settings, connecting.__dict__]
            shown += [connection, connection._connection, connection._connection.__dict__]
            stream = goal.feedback.stream
            shown += [client, client.endpoint, goal, stream, stream.__dict__]
    shown += [people, url, Hello(1, 1.0, SECRET)]
    assert {peer.name for peer in people} == {"ann"}
    assert SECRET not in repr(shown)
    assert SECRET not in caplog.text
    assert "the server rejected the client's token" in caplog.text
    assert "the server asks for a token, and the client gave none" in caplog.text


async def test_a_token_that_cannot_be_sent_is_refused_before_anything_is() -> None:
    with pytest.raises(TransportError, match=r"^tcp://robot: token is not valid text") as caught:
        connect("tcp://robot", FIBONACCI, token="secret \udcff")
    assert "secret" not in str(caught.value)
    with pytest.raises(ValueError, match="token is not valid text"):
        UnixTransport("/run/x", token="secret \udcff")


async def test_who_may_not_observe_cannot_tell_whether_a_goal_exists() -> None:
    def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        return peer.name == "ann" or verb is Permission.SEND

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
                with anyio.fail_after(30):
                    goal = await ann.send_goal(Goal(1))
                    assert (await ann.endpoint.get_result(goal.goal_id)).result
                    there = await told(bob, goal.goal_id)
                    assert there == await told(bob, GoalID.random())


async def test_a_permission_that_cannot_be_found_out_is_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def authorize(peer: Peer, action: str, verb: Permission) -> bool:
        raise OSError("no directory")

    async with serve(new_server(), TcpTransport(port=0, authorize=authorize)) as (url,):
        async with connect(url, FIBONACCI) as client:
            with anyio.fail_after(30), pytest.raises(ServerFailed, match="failed: OSError"):
                await client.call(Goal(1))
    assert "no directory" in caplog.text


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
    line = await heard.until(f"a local process {left}")
    assert line.getMessage().startswith("a local process left")


@pytest.mark.parametrize("waits_for", [b"", b"\r\n\r\n"], ids=["at once", "for a blank line"])
@pytest.mark.parametrize("reconnect", [True, False])
async def test_a_client_at_the_port_of_a_web_server_is_told_so(
    reconnect: bool, waits_for: bytes
) -> None:
    async def answer(stream: ByteStream) -> None:
        async with stream:
            received = await stream.receive()
            while waits_for not in received:
                received += await stream.receive()
            await stream.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        url = f"tcp://127.0.0.1:{listener.extra(SocketAttribute.local_port)}"
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, answer)
            failed = await failure(ProtocolError, url, FIBONACCI, reconnect=reconnect)
            tasks.cancel_scope.cancel()
    assert failed == (
        f"{url}: frame of 1213486160 bytes exceeds the limit of 16777216 bytes: this looks like"
        " HTTP: use http:// at both ends, or check the port"
    )
