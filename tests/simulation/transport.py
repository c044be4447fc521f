"""The transport of the simulation: the wire's two halves over the simulated network."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

from fibaction import Endpoint, ServerNotFound, Transport
from fibaction.border.abc import Connection
from fibaction.border.event_loop import Background
from fibaction.wire.channel import StreamChannel
from fibaction.wire.client.connection import open_connection
from fibaction.wire.frames import FrameReader
from fibaction.wire.settings import ClientSettings, WireSettings
from fibaction.wire.wire_server import WireServer, open_server
from fibaction_transports._socket_lines.protocol_line import ProtocolLine
from tests.simulation.network import Line, Listener, Network
from tests.simulation.sockets import line_over
from tests.simulation.streams import SimulatedStream


class SimulatedTransport(Transport):
    """The wire's two halves over the simulated network, combined as for TCP."""

    def __init__(
        self,
        network: Network,
        line: Line | None = None,
        keeping: ClientSettings | None = None,
        terms: WireSettings | None = None,
        *,
        calls_back: bool = False,
        is_alive: Callable[[], bool] = lambda: True,
    ) -> None:
        """Make a transport: with a line and settings for a client, or with settings for a server.

        With `calls_back`, the loop calls a protocol, as for TCP without TLS; otherwise tasks read
        and write. A server that is not alive when it begins to listen cannot be reached.
        """
        self._is_alive = is_alive
        self._calls_back = calls_back
        self._network = network
        self._line = line
        self._keeping = keeping
        self._terms = terms

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> SimulatedTransport:
        raise NotImplementedError  # a simulated network does not have addresses

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        assert self._terms is not None
        served = {endpoint.info.name: endpoint for endpoint in endpoints}
        async with open_server(served, self._terms) as connections:
            host = self._network.host
            listener = host.listen() if self._is_alive() else Listener(host)
            try:
                async with Background() as accepting:
                    accepting.start_soon(self._accept, listener, connections)
                    yield "sim://server"
            finally:
                await listener.aclose()

    async def _accept(self, listener: Listener, connections: WireServer) -> None:
        while True:
            stream = await listener.accept()
            connections.start(self._line_over(stream, "", connections.new_reader()))

    def _line_over(
        self, stream: SimulatedStream, peer: str, reader: FrameReader
    ) -> ProtocolLine | StreamChannel:
        if self._calls_back:
            return line_over(stream, reader, peer)
        return StreamChannel(stream, peer or stream.peer, reader)

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        assert self._line is not None
        assert self._keeping is not None
        where = f"sim://server/{self._line.name}"
        async with open_connection(self._dial, where, self._keeping) as connection:
            yield connection

    async def _dial(self) -> ProtocolLine | StreamChannel:
        assert self._line is not None
        try:
            stream = await self._line.dial()
        except OSError as exc:
            raise ServerNotFound(f"the server does not listen: {exc}") from exc
        return self._line_over(stream, stream.peer, FrameReader())
