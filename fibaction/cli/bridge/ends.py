"""The serving end of a bridge whose actions come and go while it runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import anyio
from anyio.abc import TaskGroup, TaskStatus

from fibaction._api import serve
from fibaction.border.abc import Endpoint, Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for
from fibaction.wire.server.requests import ChangingEndpoints
from fibaction.wire.transport import WireTransport
from fibaction.wire.wire_server import open_server


class BridgeEnd(ABC):
    """The actions that are served at one address."""

    where = ""
    """The URL under which clients find the actions."""
    can_change = True
    """True if actions can be added after `begin`, and removed."""

    @abstractmethod
    async def add(self, endpoint: Endpoint) -> None:
        """Serve one more action.

        Raises:
            TransportError: It cannot be served.
        """

    @abstractmethod
    async def remove(self, name: str) -> None:
        """Stop serving the action. Goals of its clients go on at their server."""

    async def begin(self) -> None:  # noqa: B027  # most serve from the first action on
        """Serve what has been added.

        Raises:
            TransportError: The address cannot be used.
        """


class _WireEnd(BridgeEnd):
    """One server of the wire protocol, which looks up its actions with each request."""

    def __init__(self) -> None:
        self.endpoints = ChangingEndpoints()

    async def add(self, endpoint: Endpoint) -> None:
        self.endpoints.add(endpoint)

    async def remove(self, name: str) -> None:
        del self.endpoints[name]


class _SingleServers(BridgeEnd):
    """A server for each action.

    Each server runs in a task of its own, since a block of `serve` must be left in its own task.
    """

    def __init__(self, address: str | Transport, tasks: TaskGroup) -> None:
        self._address = address
        self._tasks = tasks
        self._stops: dict[str, anyio.Event] = {}
        self._ended: dict[str, anyio.Event] = {}

    async def add(self, endpoint: Endpoint) -> None:
        name = endpoint.info.name
        stop, ended = anyio.Event(), anyio.Event()
        self.where = await self._tasks.start(self._serve, endpoint, stop, ended)
        self._stops[name], self._ended[name] = stop, ended

    async def _serve(
        self,
        endpoint: Endpoint,
        stop: anyio.Event,
        ended: anyio.Event,
        *,
        task_status: TaskStatus[Any] = anyio.TASK_STATUS_IGNORED,
    ) -> None:
        try:
            async with serve(endpoint, self._address) as (where,):
                task_status.started(where)
                await stop.wait()
        finally:
            ended.set()

    async def remove(self, name: str) -> None:
        self._stops.pop(name).set()
        await self._ended.pop(name).wait()

    async def aclose(self) -> None:
        """Stop all servers, and wait until they have stopped."""
        for stop in self._stops.values():
            stop.set()
        for ended in self._ended.values():
            await ended.wait()


class _FixedServer(BridgeEnd):
    """One server, whose actions stay the same: that of a worker in a fleet, for example."""

    can_change = False

    def __init__(self, address: str | Transport, block: AsyncExitStack) -> None:
        self._address = address
        self._block = block
        self._endpoints: list[Endpoint] = []

    async def add(self, endpoint: Endpoint) -> None:
        self._endpoints.append(endpoint)

    async def remove(self, name: str) -> None:
        self._endpoints = [one for one in self._endpoints if one.info.name != name]

    async def begin(self) -> None:
        block = serve(self._endpoints, self._address)
        (self.where,) = await self._block.enter_async_context(block)


@asynccontextmanager
async def open_end(where: str | Transport) -> AsyncGenerator[BridgeEnd, None]:
    """Open the serving end of a bridge, which serves nothing yet.

    Raises:
        TransportError: The address cannot be used.
    """
    transport = transport_for(where)
    if isinstance(transport, WireTransport):
        end = _WireEnd()
        async with (
            open_server(end.endpoints, transport.settings) as server,
            transport.accept_lines(server) as end.where,
        ):
            yield end
    elif transport.shares_address:
        async with Background() as tasks:
            servers = _SingleServers(where, tasks)
            try:
                yield servers
            finally:
                with anyio.CancelScope(shield=True):
                    await servers.aclose()
    else:
        async with AsyncExitStack() as block:
            yield _FixedServer(where, block)
