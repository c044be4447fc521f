"""A network in memory, whose connections can be cut and frozen.

Each client has a `Line` to the server's `Host`. The `Weather` of a line holds for its `streams`.
Faults are methods: `cut`, `half_close`, `freeze` and so on. All randomness comes from one
`random.Random`, all time from the virtual loop. The network does not interpret the bytes.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from typing import Literal, TypeAlias

import anyio

from fibaction._runtime.notify import Notifier
from tests.simulation.loop import VirtualLoop
from tests.simulation.streams import Manner, SimulatedStream, Way, Weather

Direction: TypeAlias = Literal["up", "down"]
"""The direction of bytes: `up` is from the client to the server."""
Teller: TypeAlias = Callable[[str], None]


class _Connection:
    """Both ends of a connection, and the two directions between them."""

    def __init__(self, network: Network, line: Line, number: int) -> None:
        up, down = (Way(network.loop, network.chance, line.weather) for _ in range(2))
        self.line = line
        self.ways: dict[Direction, Way] = {"up": up, "down": down}
        name = f"{line.name}:{number}"
        self.near = SimulatedStream(f"{name} near", down, up, "server")
        self.far = SimulatedStream(f"{name} far", up, down, name)
        self.is_cut = False

    @property
    def is_open(self) -> bool:
        return self.near.is_open or self.far.is_open


class Listener:
    """The listener of a server, which accepts connections."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._waiting: deque[SimulatedStream] = deque()
        self._news = Notifier()

    def offer(self, stream: SimulatedStream) -> None:
        """Add a connection that a client has opened."""
        self._waiting.append(stream)
        self._news.notify()

    async def accept(self) -> SimulatedStream:
        """Wait for the next connection."""
        while not self._waiting:
            await self._news.wait()
        return self._waiting.popleft()

    async def aclose(self) -> None:
        """Stop accepting, and close the connections that were not accepted, without waiting."""
        if self._host.listener is self:
            self._host.listener = None
        for stream in self._waiting:
            with anyio.CancelScope(shield=True):
                await stream.aclose()


class Host:
    """The host on which servers listen, one after the other."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self.listener: Listener | None = None

    def listen(self) -> Listener:
        """Begin to listen.

        Raises:
            OSError: The address is in use.
        """
        if self.listener is not None:
            raise OSError("address already in use")
        self.listener = Listener(self)
        return self.listener

    def die(self, manner: Manner) -> None:
        """End the server's process at once, and with it all connections."""
        self.listener = None
        for connection in self._network.open_connections():
            self._network.sever(connection, manner, dead="far")


class Line:
    """One client's line to the server."""

    def __init__(self, network: Network, name: str, weather: Weather) -> None:
        self._network = network
        self.name = name
        self.weather = weather
        self.rejects_until = 0.0
        self.dies_at_once = 0
        """The number of connections that are to end right after they are opened."""
        self._frozen_until: dict[Direction, float] = {"up": 0.0, "down": 0.0}

    async def dial(self) -> SimulatedStream:
        """Open a connection.

        Raises:
            OSError: The server does not listen, or the line rejects connections.
        """
        network = self._network
        await anyio.sleep(self.weather.dial)
        frozen = max(self._frozen_until.values())
        if frozen > network.loop.time():
            await (anyio.sleep_forever() if frozen == math.inf else anyio.sleep_until(frozen))
        if network.host.listener is None or self.rejects_until > network.loop.time():
            raise ConnectionRefusedError(111, "Connection refused")
        connection = network.connect(self)
        network.host.listener.offer(connection.far)
        if self.dies_at_once:
            self.dies_at_once -= 1
            delay = network.chance.uniform(0, 3 * self.weather.latency)
            network.loop.call_at(network.loop.time() + delay, network.sever, connection, "reset")
        return connection.near

    def cut(self, manner: Manner) -> None:
        """End all connections, and lose the bytes that are under way."""
        for connection in self._connections():
            self._network.sever(connection, manner)

    def half_close(self, direction: Direction) -> None:
        """End one direction of all connections, and keep the other one."""
        for connection in self._connections():
            connection.ways[direction].close()

    def freeze(self, seconds: float, *directions: Direction, new_too: bool = True) -> None:
        """Delay all bytes for so long, with `new_too` also those of new connections.

        Without `new_too`, a client may be back on a new connection before the bytes of the old
        one, or its end, arrive.
        """
        until = self._network.loop.time() + seconds
        for connection in self._connections():
            for direction in directions:
                connection.ways[direction].freeze(until)
        if new_too:
            for direction in directions:
                self._frozen_until[direction] = until

    def thawing(self, direction: Direction) -> float:
        """Return the time before which bytes do not arrive on a new connection."""
        return self._frozen_until[direction]

    def die(self) -> None:
        """End the client's process at once."""
        for connection in self._connections():
            self._network.sever(connection, "reset", dead="near")
        self.rejects_until = math.inf

    def _connections(self) -> list[_Connection]:
        return [
            connection
            for connection in self._network.open_connections()
            if connection.line is self and not connection.is_cut
        ]


class Network:
    """All hosts and lines of one world."""

    def __init__(self, loop: VirtualLoop, chance: random.Random, tell: Teller) -> None:
        self.loop = loop
        self.chance = chance
        self._tell = tell
        self.host = Host(self)
        self.opened = 0
        self.cuts = 0
        self._connections: list[_Connection] = []

    def line(self, name: str, weather: Weather) -> Line:
        """Return a new line."""
        return Line(self, name, weather)

    def connect(self, line: Line) -> _Connection:
        """Open a connection over that line."""
        self.opened += 1
        self._connections = self.open_connections()
        connection = _Connection(self, line, self.opened)
        for direction in connection.ways:
            connection.ways[direction].freeze(line.thawing(direction))
        self._connections.append(connection)
        self._tell(f"{line.name}: connection {self.opened} is open")
        return connection

    def sever(
        self, connection: _Connection, manner: Manner, dead: Literal["near", "far", ""] = ""
    ) -> None:
        """End a connection; the end of a `dead` process breaks at once."""
        if connection.is_cut or not connection.is_open:
            return
        connection.is_cut = True
        self.cuts += 1
        self._tell(f"{connection.far.name}: cut with {manner} {dead}")
        for reader, way in (("far", connection.ways["up"]), ("near", connection.ways["down"])):
            if reader == dead:
                way.lose()
                way.break_now()
            elif manner != "silence":
                way.lose()
                way.end_with(manner)
            else:
                way.lose()

    def open_connections(self) -> list[_Connection]:
        """Return the connections with an end that has not been closed."""
        return [connection for connection in self._connections if connection.is_open]

    def open_ends(self) -> list[str]:
        """Return the names of all ends that have not been closed."""
        return [
            end.name
            for connection in self._connections
            for end in (connection.near, connection.far)
            if end.is_open
        ]
