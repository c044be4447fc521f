"""Connecting to one broker: TLS, the ways to log in, and what is no broker."""

from __future__ import annotations

import json
import logging
import ssl
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest
from anyio.abc import SocketAttribute, SocketStream

from fibaction import AuthenticationFailed, LimitReached, ServerNotFound, TransportError
from fibaction.border.event_loop import asyncio_loop
from fibaction.wire.transport import TlsFiles
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    Message,
    NoResponders,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.broker.broker_socket import LONGEST_LINE
from fibaction_transports.nats.broker.dial import Dialer, LoginLines
from fibaction_transports.nats.broker.login import (
    BrokerInfo,
    NatsCredentials,
    connect_command,
    info_of,
    is_let_in,
)
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.certificates import pems
from tests.support.nats_keys import USER, Key, Operator
from tests.support.nats_server import NatsServer, nats_server, needs_nats
from tests.transports.hearing import Hearing
from tests.transports.nats.test_broker_rules import put

pytestmark = pytest.mark.anyio

INFO = {"version": "2.15.0", "headers": True}


async def check_use(settings: FleetSettings) -> None:
    """Connect, and use JetStream."""
    async with open_broker(settings) as broker:
        await broker.create_streams(FleetNames("fleet"))


@asynccontextmanager
async def saying(*lines: bytes, **info: Any) -> AsyncGenerator[str, None]:
    """Something that says INFO and these lines, and then closes when the client has answered."""

    async def handle(stream: SocketStream) -> None:
        async with stream:
            await stream.send(b"INFO %s\r\n" % json.dumps({**INFO, **info}).encode())
            await stream.send(b"".join(lines))
            await stream.receive()

    async with listening(handle) as address:
        yield address


def dialer_to(address: str, **settings: Any) -> Dialer:
    dialer = Dialer(settings_for(address, **settings), lambda *_: None, lambda: None)
    dialer.read_files()
    return dialer


async def not_found(address: str) -> str:
    error = await error_of(settings_for(address))
    assert isinstance(error, ServerNotFound)
    return str(error)


# Keys


@needs_nats
async def test_a_user_with_a_key_is_let_in(tmp_path: Path) -> None:
    user = Key(USER)
    path = tmp_path / "user.nk"
    path.write_text(f"{user.seed}\n")
    config = f"jetstream: {{}}\nauthorization: {{users: [{{nkey: {user.public}}}]}}"
    with nats_server(config) as server:
        await check_use(settings_for(server.address, creds=str(path)))
        path.write_text(Key(USER).seed)
        error = await error_of(settings_for(server.address, creds=str(path)))
    assert isinstance(error, AuthenticationFailed)
    assert str(error) == (
        f"the broker {server.address} rejects the login: give user:password@ or token@ in front of"
        " the host, or creds="
    )


@needs_nats
async def test_a_credentials_file_is_read_for_each_connection(tmp_path: Path, log: Hearing) -> None:
    path = tmp_path / "my.creds"
    operator = Operator()
    operator.write_credentials(path)
    with nats_server(f"jetstream: {{}}\n{operator.config}") as server:
        async with open_broker(settings_for(server.address, creds=str(path))) as broker:
            server.kill()
            path.unlink()
            server.start()
            await log.until(f"the credentials file {path} cannot be read")
            operator.write_credentials(path)
            await log.until("is back")
            await broker.flush()


async def test_a_nonce_does_not_keep_a_client_without_keys_out() -> None:
    async with saying(b"+OK\r\nPONG\r\n", nonce="n") as address:
        await (await dialer_to(address).dial(address)).cut()


@needs_nats
async def test_a_login_is_in_no_log(log: Hearing, tmp_path: Path) -> None:
    path, user = tmp_path / "user.nk", Key(USER)
    path.write_text(user.seed)
    config = "jetstream: {}\nauthorization: {user: me, password: right}"
    logging.getLogger("fibaction.nats").setLevel(logging.DEBUG)
    with nats_server(config) as server:
        login = {"user": "me", "password": "5ecret", "login_token": "t0ken", "creds": str(path)}
        error = await error_of(settings_for(server.address, **login))
    said = f"{error} {error.__cause__} {[record.getMessage() for record in log.records]}"
    assert not any(secret in said for secret in ("5ecret", "t0ken", user.seed))


# TLS


def tls_config(files: Any, more: str = "") -> str:
    paths = f'cert_file: "{files.cert}", key_file: "{files.cert}", ca_file: "{files.ca}"'
    return f"jetstream: {{}}\ntls: {{{paths} {more}}}"


@needs_nats
async def test_a_broker_may_want_tls_before_its_first_line(log: Hearing) -> None:
    files = pems()
    with nats_server(tls_config(files, ", handshake_first: true")) as server:
        settings = settings_for(server.address, tls=TlsFiles(ca=files.ca))
        async with open_broker(settings) as broker:
            await broker.create_streams(FleetNames("fleet"))
            server.kill()
            await log.until("is lost")
            server.start()
            await log.until("is back")


@needs_nats
async def test_a_broker_may_ask_for_a_certificate() -> None:
    files = pems()
    with nats_server(tls_config(files, ", verify: true")) as server:
        await check_use(settings_for(server.address, tls=TlsFiles(ca=files.ca, cert=files.cert)))
        error = await error_of(settings_for(server.address, tls=TlsFiles(ca=files.ca)))
    assert isinstance(error, AuthenticationFailed)
    assert str(error) == (
        f"no TLS with the broker {server.address}: it asks its clients for a certificate: give"
        " cert=, and key="
    )


@needs_nats
async def test_other_brokers_of_a_cluster_have_the_name_of_the_first_one() -> None:
    files = pems("localhost")
    with nats_server(tls_config(files)) as one, nats_server(tls_config(files)) as other:
        first = f"localhost:{one.port}"
        dialer = dialer_to(first, tls=TlsFiles(ca=files.ca))
        with pytest.raises(AuthenticationFailed, match="no TLS with the broker 127"):
            await dialer.dial(other.address)
        await (await dialer.dial(first)).cut()
        await (await dialer.dial(other.address)).cut()
        await (await dialer.dial(f"localhost:{other.port}")).cut()


async def test_what_is_said_between_the_first_line_and_tls_is_not_believed() -> None:
    async with saying(b"PONG\r\n", tls_required=True) as address:
        assert "no broker of NATS answers" in await not_found(address)


async def test_a_connection_that_is_lost_when_tls_is_made_is_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def start_tls(transport: Any, *_: Any, **__: Any) -> None:
        transport.abort()

    monkeypatch.setattr(asyncio_loop(), "start_tls", start_tls, raising=False)
    async with saying(tls_required=True) as address:
        assert "no broker of NATS answers" in await not_found(address)


async def test_a_handshake_that_is_never_answered_is_given_up() -> None:
    async def handle(stream: SocketStream) -> None:
        async with stream:
            await stream.send(b'INFO {"tls_required": true}\r\n')
            await anyio.sleep_forever()

    async with listening(handle) as address:
        with anyio.fail_after(30):
            error = await error_of(settings_for(address, tls=ssl.create_default_context()))
    assert str(error) == f"the broker {address} did not answer in 2 s"


@needs_nats
@pytest.mark.parametrize("more", ["", ", handshake_first: true"])
async def test_tls_begins_on_uvloop_as_well(more: str) -> None:
    pytest.importorskip("uvloop")
    files = pems()
    with nats_server(tls_config(files, more)) as server:
        settings = settings_for(server.address, tls=TlsFiles(ca=files.ca))
        run = partial(anyio.run, check_use, settings, backend_options={"use_uvloop": True})
        await anyio.to_thread.run_sync(run)


# What is no broker, or has no room


async def test_a_broker_that_closes_after_the_login_is_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    received = LoginLines.data_received

    def lose(lines: LoginLines, data: bytes) -> None:
        received(lines, data)
        if b"PONG" in data:
            lines.transport.abort()

    monkeypatch.setattr(LoginLines, "data_received", lose)
    async with saying(b"PONG\r\n") as address:
        assert await not_found(address) == f"the broker {address} has closed the connection"


@pytest.mark.parametrize("line", [b"220 mail ready\r\n", bytes(LONGEST_LINE + 1), b""])
async def test_another_protocol_after_the_first_line_is_not_found(line: bytes) -> None:
    async with saying(line) as address:
        assert "no broker of NATS answers" in await not_found(address)


@pytest.mark.parametrize("name", [f"{'x' * 64}.org", "a..b"])
async def test_a_name_that_no_host_can_have_is_not_found(name: str) -> None:
    text = await not_found(f"{name}:4222")
    assert text == f"no broker at {name}:4222: it is not the name of a host"


async def test_an_address_that_a_broker_tells_may_be_anything() -> None:
    dialer = dialer_to("a:1")
    for server in ("", "a:b", "127.0.0.1:99999", "[::1", "a\0b:1", "127.0.0.1"):
        with pytest.raises(ServerNotFound):
            await dialer.dial(server)


async def test_a_login_that_is_canceled_closes_its_connection() -> None:
    closed = anyio.Event()

    async def handle(stream: SocketStream) -> None:
        async with stream:
            with pytest.raises((anyio.BrokenResourceError, anyio.EndOfStream)):
                await stream.receive()
        closed.set()

    async with listening(handle) as address:
        dialer = dialer_to(address)
        with anyio.move_on_after(0.2):
            await dialer.dial(address)
        with anyio.fail_after(30):
            await closed.wait()


async def test_a_message_that_is_too_large_is_not_sent_and_the_next_one_is(
    shared_broker: NatsServer, fleet: str
) -> None:
    async with open_broker(FleetSettings("fleet", (shared_broker.address,))) as broker:
        heard: list[Message] = []
        await broker.subscribe(f"fib.{fleet}.x", heard.append)
        broker.publish(f"fib.{fleet}.x", bytes(2**20 + 1))
        broker.publish(f"fib.{fleet}.x", bytes(2**20))
        with anyio.fail_after(30):
            await broker.flush()
        assert [len(message.data) for message in heard] == [2**20]


# The login at a broker, without a broker


# As the documentation of NATS has them.
SEED = "SUACSSL3UAHUDXKFSNVUZRF5UHPMWZ6BFDTJ7M6USDXIEDNPPQYYYCU3VY"
PUBLIC = "UDXU4RCSJNZOIQHZNWXHXORDPRTGNJAHAHFRGZNEEJCPQTT2M7NLCNF4"
ACCOUNT_SEED = "SAAJDFIJTW4V2ZZ3R624KS3MD7V7QRBNW3SWGOZF673WZFKVYS3X3S46CA"
NO_LOGIN = {"name", "lang", "version", "verbose", "pedantic", "protocol", "headers"}


def fields_of(
    settings: FleetSettings, credentials: NatsCredentials | None = None, **info: Any
) -> dict[str, Any]:
    """The login that a client sends."""
    sent = connect_command(settings, credentials, BrokerInfo(**info))
    assert sent.startswith(b"CONNECT {")
    assert sent.endswith(b"}\r\nPING\r\n")
    fields: dict[str, Any] = msgspec.json.decode(sent.split(b"\r\n")[0].removeprefix(b"CONNECT "))
    return {name: value for name, value in fields.items() if name not in NO_LOGIN}


# What a broker says


@pytest.mark.parametrize(
    "line",
    [b"", b"HTTP/1.1 200 OK", b"INFO", b"INFO x", b'INFO {"max_payload": "x"}', b"INFO \xff"],
)
def test_a_first_line_of_something_else_is_an_error(line: bytes) -> None:
    with pytest.raises(ValueError, match="INFO"):
        info_of(line)


@pytest.mark.parametrize(
    ("said", "kind", "text"),
    [
        ("'Authorization Violation'", AuthenticationFailed, "rejects the login: give user:"),
        ("'User Authentication Expired'", AuthenticationFailed, "rejects the login: give user:"),
        ("'maximum connections exceeded'", LimitReached, "connection: maximum connections exceed"),
        ("'\x1b[2JParser Error'", TransportError, "rejects the connection: \\x1b[2JParser Error"),
    ],
)
def test_an_error_of_a_broker_is_one_sentence(
    said: str, kind: type[TransportError], text: str
) -> None:
    with pytest.raises(TransportError) as caught:
        is_let_in("host:1", f"-ERR {said}".encode())
    assert type(caught.value) is kind
    assert str(caught.value).startswith("the broker host:1 rejects the ")
    assert text in str(caught.value)


# What the client answers


def test_a_key_is_not_sent_and_not_shown() -> None:
    credentials = NatsCredentials(SEED, "")
    fields = fields_of(FleetSettings("f"), credentials, nonce="once")
    assert fields["nkey"] == PUBLIC
    assert SEED not in f"{fields}{credentials!r}"


def test_a_key_needs_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my.creds").write_text(SEED)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.asymmetric", None)
    with pytest.raises(TransportError, match="needs cryptography: pip install"):
        NatsCredentials.read(str(tmp_path / "my.creds"))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no key",
        SEED[:-1],
        SEED[:-1] + "A",
        SEED.lower(),
        "SU" + "1" * 56,
        ACCOUNT_SEED,
        "SU" + "\x00" * 56,
    ],
)
def test_a_file_without_the_key_of_a_user_is_one_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "my.creds"
    path.write_text(text)
    with pytest.raises(TransportError) as caught:
        NatsCredentials.read(str(path))
    assert str(caught.value) == (
        f"{path} is not a credentials file: it has no secret key of a user of NATS"
    )
    assert caught.value.__cause__ is None


def test_a_key_is_not_used_at_a_broker_without_a_nonce() -> None:
    assert set(fields_of(FleetSettings("f"), NatsCredentials(SEED, ""))) == {"no_responders"}


# Brokers that cannot be used, and those that fail while they are used


async def error_of(settings: FleetSettings) -> TransportError:
    with anyio.fail_after(10), pytest.raises(TransportError) as caught:
        async with open_broker(settings):
            pass
    assert "\n" not in str(caught.value)
    return caught.value


def settings_for(address: str, **settings: Any) -> FleetSettings:
    return FleetSettings("fleet", (address,), **settings)


# Brokers that only look like one


@asynccontextmanager
async def listening(
    handle: Callable[[SocketStream], Awaitable[None]],
) -> AsyncGenerator[str, None]:
    listener = await anyio.create_tcp_listener(local_host="127.0.0.1", local_port=0)
    async with listener, anyio.create_task_group() as tasks:
        tasks.start_soon(listener.serve, handle)
        yield f"127.0.0.1:{listener.extra(SocketAttribute.local_port)}"
        tasks.cancel_scope.cancel()


async def test_a_broker_that_is_too_old_is_not_used(
    shared_broker: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jetstream, "LEAST_VERSION", (99, 0))
    assert "a fleet needs" in str(await error_of(settings_for(shared_broker.address)))


async def test_something_that_is_no_broker_is_not_found() -> None:
    async def web(stream: SocketStream) -> None:
        await stream.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await stream.aclose()

    async with listening(web) as address:
        error = await error_of(settings_for(address))
    assert isinstance(error, ServerNotFound)
    assert str(error) == (
        f"no broker of NATS answers at {address}: start one, for example with 'fibaction broker'"
    )


async def test_a_host_that_does_not_exist_is_not_found() -> None:
    error = await error_of(settings_for("no-such-host.invalid:4222"))
    assert isinstance(error, ServerNotFound)
    assert "no broker at no-such-host.invalid:4222: " in str(error)


# Real ones


@pytest.mark.parametrize(
    ("config", "right", "wrong"),
    [
        ("{user: me, password: secret}", {"user": "me", "password": "secret"}, {}),
        ("{user: me, password: secret}", {"user": "me", "password": "secret"}, {"user": "me"}),
        ("{token: secret}", {"login_token": "secret"}, {"login_token": "other"}),
    ],
)
async def test_a_login_that_is_rejected_is_one_sentence(
    config: str, right: dict[str, str], wrong: dict[str, str]
) -> None:
    with nats_server(f"jetstream: {{}}\nauthorization: {config}") as server:
        error = await error_of(settings_for(server.address, **wrong))
        assert isinstance(error, AuthenticationFailed)
        assert f"the broker {server.address} rejects the login: give user:password@" in str(error)
        async with open_broker(settings_for(server.address, **right)) as broker:
            await broker.create_streams(FleetNames("fleet"))


async def test_a_credentials_file_that_cannot_be_read_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "my.creds"
    error = await error_of(settings_for("127.0.0.1:1", creds=str(path)))
    assert str(error) == f"the credentials file {path} cannot be read: No such file or directory"


async def test_tls_to_the_brokers_is_checked_by_both() -> None:
    files = pems()
    config = f'jetstream: {{}}\ntls: {{cert_file: "{files.cert}", key_file: "{files.cert}"}}'
    with nats_server(config) as server:
        for context in (TlsFiles(ca=files.ca), ssl.create_default_context(cafile=files.ca)):
            async with open_broker(settings_for(server.address, tls=context)) as broker:
                await broker.create_streams(FleetNames("fleet"))
        for settings in (
            settings_for(server.address),
            settings_for(server.address, tls=TlsFiles()),
        ):
            error = await error_of(settings)
            assert isinstance(error, AuthenticationFailed)
            assert f"no TLS with the broker {server.address}: " in str(error)


@pytest.mark.parametrize("login", [{}, {"user": "me", "password": "secret"}])
async def test_a_broker_without_tls_gets_no_login(
    shared_broker: NatsServer, login: dict[str, str]
) -> None:
    settings = settings_for(shared_broker.address, tls=TlsFiles(), **login)
    error = await error_of(settings)
    assert isinstance(error, AuthenticationFailed)
    assert "the broker has no TLS" in str(error)


# While they are used


async def test_another_broker_of_the_url_is_tried(shared_broker: NatsServer) -> None:
    settings = FleetSettings("fleet", ("127.0.0.1:1", shared_broker.address))
    async with open_broker(settings) as broker:
        assert broker.is_connected


async def test_a_frozen_broker_answers_nothing_and_is_left_in_time(
    own_broker: NatsServer, log: Hearing
) -> None:
    names = FleetNames("fleet")
    async with open_broker(settings_for(own_broker.address)) as broker:
        await broker.create_streams(names)
        own_broker.freeze()
        outcome = await put(broker, names.worker("w"), b"x")
        assert isinstance(outcome, PutError)
        assert outcome.kind is PutFailure.UNKNOWN
        with pytest.raises(BrokerAway):
            await broker.request("fib.x", b"", 0.1)
        with pytest.raises(BrokerAway):
            await broker.subscribe("fib.x", lambda message: None)
        with suppress(TimeoutError):
            await log.until("is lost")
        await log.until("is lost")
        broker.publish("fib.x", bytes(2**20))
        with pytest.raises(BrokerAway):
            async with broker.watch(names.workers, names.worker()):
                pass
        own_broker.thaw()
        await log.until("is back")
        with anyio.fail_after(5), pytest.raises(NoResponders):
            await broker.request("fib.x", b"", 5)
        own_broker.freeze()
        broker.publish("fib.x", bytes(2**16))
        frozen = anyio.current_time()
    assert anyio.current_time() - frozen < 3
    own_broker.thaw()
