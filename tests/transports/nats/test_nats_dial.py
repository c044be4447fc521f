"""Connecting to one broker: TLS, the ways to log in, and what is no broker."""

from __future__ import annotations

import json
import logging
import ssl
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio.abc import SocketStream

from fibaction import AuthenticationFailed, ServerNotFound
from fibaction.border.event_loop import asyncio_loop
from fibaction.wire.tls_files import TlsFiles
from fibaction_transports.nats.broker.broker import Message
from fibaction_transports.nats.broker.broker_socket import LONGEST_LINE
from fibaction_transports.nats.broker.dial import Dialer, LoginLines
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.certificates import pems
from tests.support.nats_keys import USER, Key, Operator
from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_server
from tests.transports.hearing import Hearing
from tests.transports.nats.test_bad_brokers import error_of, listening, settings_for

pytestmark = pytest.mark.asyncio

needs_broker = pytest.mark.skipif(IS_LEFT_OUT, reason="nats-server is not installed")
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


@needs_broker
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


@needs_broker
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


@needs_broker
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


@needs_broker
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


@needs_broker
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


@needs_broker
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


@needs_broker
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
