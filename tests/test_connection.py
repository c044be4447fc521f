"""`fibaction.connection`: from a URL or a transport to clients."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from fibaction import (
    ActionPeers,
    ActionServer,
    ClientConnection,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction.abc import Connection
from fibaction_transports.inprocess import InProcessTransport
from tests.fibonacci import FIBONACCI, Goal, Result, fibonacci

pytestmark = pytest.mark.asyncio


async def test_with_an_action_it_gives_a_client_and_without_one_a_connection() -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://connection"):
        async with connect("inproc://connection", FIBONACCI) as client:
            assert await client.call(Goal(1)) == Result([0, 1])
        async with connect("inproc://connection") as connection:
            assert isinstance(connection, ClientConnection)
            assert await connection.client(FIBONACCI).call(Goal(1)) == Result([0, 1])
            assert await connection.actions() == [FIBONACCI.info]
            assert connection.endpoint(FIBONACCI).info == FIBONACCI.info


async def test_who_serves_and_who_uses_an_action_is_what_the_transport_knows() -> None:
    class Told(InProcessTransport):
        """A transport that knows."""

        @asynccontextmanager
        async def connect(self) -> AsyncGenerator[Connection, None]:
            async with super().connect() as connection:
                yield Knowing(connection)

    class Knowing(ClientConnection):
        async def peers(self, action: str) -> ActionPeers:
            return ActionPeers(servers=(f"who serves {action}",))

    async with connect(Told()) as connection:
        assert await connection.peers("fibonacci") == ActionPeers(("who serves fibonacci",))
    async with connect(InProcessTransport()) as connection:
        assert await connection.peers("fibonacci") == ActionPeers()


async def test_a_transport_does_as_well_as_a_url() -> None:
    transport = InProcessTransport()
    async with connect(transport, FIBONACCI) as client:
        with pytest.raises(ServerNotFound):
            await client.call(Goal(1))
        async with serve(ActionServer(FIBONACCI, fibonacci), transport):
            assert await client.call(Goal(1)) == Result([0, 1])


async def test_a_url_that_cannot_be_used_is_told_before_the_block() -> None:
    with pytest.raises(TransportError, match="no transport for pigeon:// is installed"):
        async with connect("pigeon://loft", FIBONACCI):
            raise AssertionError("the block must not run")


async def test_the_exception_of_the_block_goes_on_as_itself() -> None:
    error = KeyError("mine")
    with pytest.raises(KeyError) as caught:
        async with connect("inproc://connection", FIBONACCI):
            raise error
    assert caught.value is error


async def test_settings_go_to_the_transport() -> None:
    with pytest.raises(TypeError, match="reconnect"):
        async with connect("inproc://connection", FIBONACCI, reconnect=False):
            raise AssertionError("the block must not run")


SERVER = ActionServer(FIBONACCI, fibonacci)


@pytest.mark.parametrize("given", [SERVER, "fibonacci", Goal])
async def test_what_is_no_action_is_told_in_one_sentence(given: Any) -> None:
    with pytest.raises(TypeError) as caught:
        connect("inproc://connection", given)
    assert str(caught.value) == (
        f"connect() takes an address, and then an Action or nothing, and not {given!r}"
    )


async def test_what_is_no_address_is_told_in_one_sentence() -> None:
    swapped: Any = (FIBONACCI, "inproc://connection")
    with pytest.raises(TypeError, match=f"an address is a URL such as .* not {FIBONACCI!r}"):
        connect(*swapped)
