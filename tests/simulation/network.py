"""A network in memory: connections that are opened, stand still, and break.

Each client has a `Line` to the server's `Host`, and a line has a weather, which its `streams` have.
Faults are methods: `cut`, `half_close`, `freeze` and the like. All chance comes from one
`random.Random`, all time from the virtual loop. What the bytes mean is not known here.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from typing import Literal, TypeAlias

import anyio

from fibaction._notify import Notifier
from tests.simulation.loop import VirtualLoop
from tests.simulation.streams import Manner, SimulatedStream, Way, Weather

Direction: TypeAlias = Literal["up", "down"]
"""`up` is from the client to the server."""
Teller: TypeAlias = Callable[[str], None]


class _Connection:
    """Both ends of a connection, and what lies between."""

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


class Listening:
    """What a server accepts connections with."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._waiting: deque[SimulatedStream] = deque()
        self._news = Notifier()

    def offer(self, stream: SimulatedStream) -> None:
        """Somebody has connected."""
        self._waiting.append(stream)
        self._news.notify()

    async def accept(self) -> SimulatedStream:
        """Wait for the next connection."""
        while not self._waiting:
            await self._news.wait()
        return self._waiting.popleft()

    async def aclose(self) -> None:
        """Accept no more, and close those that nobody has accepted. It takes no time."""
        if self._host.listener is self:
            self._host.listener = None
        for stream in self._waiting:
            with anyio.CancelScope(shield=True):
                await stream.aclose()


class Host:
    """Where servers listen, one after the other."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self.listener: Listening | None = None

    def listen(self) -> Listening:
        """Begin to listen.

        Raises:
            OSError: Somebody does.
        """
        if self.listener is not None:
            raise OSError("somebody listens already")
        self.listener = Listening(self)
        return self.listener

    def die(self, manner: Manner) -> None:
        """The process ends at once, and with it all connections."""
        self.listener = None
        for connection in self._network.open_connections():
            self._network.sever(connection, manner, dead="far")


class Line:
    """One client's way to the server."""

    def __init__(self, network: Network, name: str, weather: Weather) -> None:
        self._network = network
        self.name = name
        self.weather = weather
        self.refuses_until = 0.0
        self.dies_at_once = 0
        """How many connections are to end as soon as they are there."""
        self._frozen_until: dict[Direction, float] = {"up": 0.0, "down": 0.0}

    async def dial(self) -> SimulatedStream:
        """Open a connection.

        Raises:
            OSError: Nobody listens, or the line refuses.
        """
        network = self._network
        await anyio.sleep(self.weather.dial)
        frozen = max(self._frozen_until.values())
        if frozen > network.loop.time():
            await (anyio.sleep_forever() if frozen == math.inf else anyio.sleep_until(frozen))
        if network.host.listener is None or self.refuses_until > network.loop.time():
            raise ConnectionRefusedError(111, "Connection refused")
        connection = network.connect(self)
        network.host.listener.offer(connection.far)
        if self.dies_at_once:
            self.dies_at_once -= 1
            delay = network.chance.uniform(0, 3 * self.weather.latency)
            network.loop.call_at(network.loop.time() + delay, network.sever, connection, "reset")
        return connection.near

    def cut(self, manner: Manner) -> None:
        """End all connections, and lose what is under way."""
        for connection in self._connections():
            self._network.sever(connection, manner)

    def half_close(self, direction: Direction) -> None:
        """End one direction, and let the other one be."""
        for connection in self._connections():
            connection.ways[direction].close()

    def freeze(self, seconds: float, *directions: Direction, new_too: bool = True) -> None:
        """Let nothing arrive for so long; `new_too` says whether that is so for new connections.

        If it is not, a client may be back on a new connection while the bytes of the old one, or
        its end, are still to come.
        """
        until = self._network.loop.time() + seconds
        for connection in self._connections():
            for direction in directions:
                connection.ways[direction].freeze(until)
        if new_too:
            for direction in directions:
                self._frozen_until[direction] = until

    def thawing(self, direction: Direction) -> float:
        """Until when nothing arrives on a new connection."""
        return self._frozen_until[direction]

    def die(self) -> None:
        """The client's process ends at once."""
        for connection in self._connections():
            self._network.sever(connection, "reset", dead="near")
        self.refuses_until = math.inf

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
        """A new line."""
        return Line(self, name, weather)

    def connect(self, line: Line) -> _Connection:
        """A new connection over that line."""
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
        """End a connection; the end that is `dead` notices at once, and nobody cares."""
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
        """Those of which an end has not been closed."""
        return [connection for connection in self._connections if connection.is_open]

    def open_ends(self) -> list[str]:
        """The names of all ends that nobody has closed."""
        return [
            end.name
            for connection in self._connections
            for end in (connection.near, connection.far)
            if end.is_open
        ]
