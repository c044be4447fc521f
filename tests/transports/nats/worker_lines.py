"""A transport for tests: one worker of a fleet that has no records, and clients of it."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.wire.client.connection import open_connection
from fibaction.wire.settings import ClientSettings, WireSettings
from fibaction.wire.wire_server import open_server
from fibaction_transports.nats.broker.nats_broker import open_broker
from fibaction_transports.nats.lines import ClientLines, WorkerLines
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings

WORKER = "robot 7.x"


class LineTransport(Transport):
    """Clients and a worker, each with a connection of its own to the broker."""

    def __init__(
        self,
        settings: FleetSettings,
        client: ClientSettings | None = None,
        server: WireSettings | None = None,
    ) -> None:
        self._settings = settings
        self._names = FleetNames(settings.fleet)
        self._client = client or ClientSettings()
        self._server = server or WireSettings()

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> Transport:
        raise NotImplementedError

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        served = {endpoint.info.name: endpoint for endpoint in endpoints}
        async with open_broker(self._settings) as broker:
            async with open_server(served, self._server) as server:
                lines = WorkerLines(broker, self._names, WORKER, server.new_reader, server.start)
                await lines.open()
                yield self._settings.url
            lines.close()

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        async with open_broker(self._settings) as broker:
            lines = ClientLines(broker, self._names, max_frame=self._client.max_frame)
            await lines.open()
            url = self._settings.url
            async with open_connection(lambda: lines.dial(WORKER), url, self._client) as connection:
                yield connection
            lines.close()
