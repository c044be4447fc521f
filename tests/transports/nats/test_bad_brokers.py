"""Brokers that cannot be used, and those that fail while they are used."""

from __future__ import annotations

import json
import ssl
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio.abc import SocketAttribute, SocketStream

from fibaction import AuthenticationFailed, ServerNotFound, TransportError
from fibaction.wire.tls_files import TlsFiles
from fibaction_transports.nats.broker.broker import BrokerAway, NoResponders, PutError, PutFailure
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.certificates import pems
from tests.support.nats_keys import USER, Key
from tests.support.nats_server import NatsServer, nats_server
from tests.transports.hearing import Hearing
from tests.transports.nats.test_nats_broker import put

pytestmark = pytest.mark.asyncio

Answer = Callable[[str, bytes], Any]


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


@asynccontextmanager
async def fake(version: str = "2.15.0", **answers: Any) -> AsyncGenerator[str, None]:
    """A broker that answers to requests of JetStream with these; None is an answer of nobody."""

    async def handle(stream: SocketStream) -> None:
        info = {"version": version, "max_payload": 2**20, "headers": True, "proto": 1}
        cluster = {"cluster": "c"} if "cluster" in answers else {}
        text = json.dumps({**info, **cluster})
        async with stream:
            await stream.send(f"INFO {text}\r\n".encode())
            rest = b""
            while True:
                try:
                    rest += await stream.receive()
                except (anyio.EndOfStream, anyio.BrokenResourceError):
                    return
                *lines, rest = rest.split(b"\r\n")
                for line in lines:
                    if line == b"PING":
                        await stream.send(b"PONG\r\n")
                    elif line.startswith((b"PUB _INBOX", b"PUB $JS.API")):
                        _, subject, *reply = line.decode().split(" ")
                        await stream.send(_message(subject, reply[0], answers))

    async with listening(handle) as address:
        yield address


def _message(subject: str, reply: str, answers: dict[str, Any]) -> bytes:
    if subject.startswith("_INBOX"):
        return f"MSG {subject} 1 0\r\n\r\n".encode()
    answer = answers.get(subject.split(".")[2], {})
    if callable(answer):
        answer = answer()
    if answer is None:
        head = "NATS/1.0 503\r\n\r\n"
        return f"HMSG {reply} 1 {len(head)} {len(head)}\r\n{head}\r\n".encode()
    text = answer if isinstance(answer, str) else json.dumps(answer)
    return f"MSG {reply} 1 {len(text)}\r\n{text}\r\n".encode()


@pytest.mark.parametrize("version", ["2.9.10", "2.10.29", "", "new"])
async def test_a_version_that_ignores_leases_is_one_sentence(version: str) -> None:
    async with fake(version) as address:
        error = await error_of(settings_for(address))
    assert str(error) == (
        f"the broker at nats://{address} is nats-server {version or 'of no known version'}, and a"
        " fleet needs 2.11 or later: in older ones the lease of a lost worker does not end"
    )


@pytest.mark.parametrize(
    ("info", "text"),
    [
        ({"api": {"level": 0}}, "is older than 2.11: update all brokers"),
        ({"error": {"code": 503, "err_code": 10039, "description": "no"}}, "cannot be used: no"),
        ("no JSON", "does not answer"),
        (None, "is not enabled: start nats-server with -js"),
    ],
)
async def test_an_account_that_cannot_be_used_is_one_sentence(info: Any, text: str) -> None:
    async with fake(INFO=info) as address:
        assert text in str(await error_of(settings_for(address)))


async def test_an_election_is_waited_for_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [None, {"error": {"code": 503, "err_code": 10008}}, {"api": {"level": 1}}]
    async with fake(INFO=lambda: answers.pop(0), cluster=1) as address:
        async with open_broker(settings_for(address)) as broker:
            assert broker.brokers == 2
    monkeypatch.setattr("fibaction_transports.nats.broker.jetstream.ELECTION", 0.3)
    async with fake(INFO=None, cluster=1) as address:
        assert "is not enabled" in str(await error_of(settings_for(address)))


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


async def test_a_credentials_file_that_cannot_be_used_is_one_sentence(
    shared_broker: NatsServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "my.creds"
    error = await error_of(settings_for(shared_broker.address, creds=str(path)))
    assert str(error) == f"the credentials file {path} cannot be read: No such file or directory"
    path.write_text("SU" + "A" * 56)
    error = await error_of(settings_for(shared_broker.address, creds=str(path)))
    assert str(error) == (
        f"{path} is not a credentials file: it has no secret key of a user of NATS"
    )
    path.write_text(Key(USER).seed)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.asymmetric", None)
    error = await error_of(settings_for(shared_broker.address, creds=str(path)))
    needs = "a credentials file of NATS needs cryptography: pip install 'fibaction[nats]'"
    assert str(error) == needs


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
