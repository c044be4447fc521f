"""The connection to a broker after the login."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from nats.aio.client import Client

from fibaction import ServerNotFound
from fibaction_transports.nats.broker.broker import Message
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.settings import FleetSettings
from tests.support.nats_server import NatsServer

pytestmark = pytest.mark.asyncio


async def test_a_broker_that_closes_after_the_login_is_not_found(
    shared_broker: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect: Any = Client.connect

    async def closed(client: Any, *servers: Any, **settings: Any) -> None:
        await connect(client, *servers, **settings)
        client._transport._io_writer.transport.abort()

    monkeypatch.setattr(Client, "connect", closed)
    with pytest.raises(ServerNotFound) as caught:
        async with open_broker(FleetSettings("fleet", (shared_broker.address,))):
            pass
    assert str(caught.value) == f"the broker {shared_broker.address} has closed the connection"


async def test_a_message_that_is_too_large_is_not_sent_and_the_next_one_is(
    shared_broker: NatsServer, fleet: str
) -> None:
    async with open_broker(FleetSettings("fleet", (shared_broker.address,))) as broker:
        heard: list[Message] = []
        await broker.subscribe(f"fib.{fleet}.x", heard.append)
        broker.publish(f"fib.{fleet}.x", bytes(2**20 + 1))
        broker.publish(f"fib.{fleet}.x", bytes(2**20))
        with anyio.fail_after(5):
            await broker.flush()
        assert [len(message.data) for message in heard] == [2**20]
