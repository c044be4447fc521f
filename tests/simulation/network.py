"""A network in memory: streams of bytes that take time, come in pieces, and break.

Each client has a `Line` to the server's `Host`, and a line has a weather: how long bytes take, in
what pieces they come, how many are under way at most. Faults are methods: `cut`, `half_close`,
`freeze` and the like. All chance comes from one `random.Random`, all time from the virtual loop.
What the bytes mean is not known here.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import anyio
import msgspec
from anyio.abc import ByteStream

from fibaction.waking import Waking
from tests.simulation.loop import VirtualLoop

Direction: TypeAlias = Literal["up", "down"]
"""`up` is from the client to the server."""
Manner: TypeAlias = Literal["reset", "end", "silence"]
"""How a connection ends: both ends get an error, or the end of the stream, or never hear of it."""
Teller: TypeAlias = Callable[[str], None]


class Weather(msgspec.Struct, frozen=True):
    """What a line is like."""

    latency: float = 0.001
    """Seconds that each piece takes at least."""
    jitter: float = 0.0
    """Seconds that it may take longer, but never overtaking what was sent before."""
    pieces: int = 1
    """In how many pieces at most what is sent at once arrives."""
    buffer: int = 2**16
    """Bytes that may be under way in one direction, before whoever sends waits."""
    dial: float = 0.002
    """Seconds until a connection is there."""


def _do_nothing() -> None:
    pass


class _Way:
    """One direction of one connection."""

    def __init__(self, network: Network, weather: Weather) -> None:
        self._network = network
        self._weather = weather
        self._flight: deque[tuple[float, bytes | None]] = deque()  # None is the end of the stream
        self._latest = 0.0
        self._timer: Any = None
        self._inbox: deque[bytes] = deque()
        self._size = 0
        self.thaws_at = 0.0
        self.is_closed = False
        """Whether its sender sends no more."""
        self.has_ended = False
        """Whether the end of the stream has arrived."""
        self.is_broken = False
        """Whether its reader gets an error."""
        self.is_lost = False
        """Whether what is sent is lost on the way, and nobody knows."""
        self.arrived = Waking()
        self.room = Waking()
        self.on_arrival: Callable[[], None] = _do_nothing
        """Called when there may be something to read: see `sockets`."""
        self.on_room: Callable[[], None] = _do_nothing
        """Called when there may be room to write."""

    def _tell_reader(self) -> None:
        self.arrived.wake()
        self.on_arrival()

    def _tell_writer(self) -> None:
        self.room.wake()
        self.on_room()

    @property
    def is_full(self) -> bool:
        return self._size >= self._weather.buffer

    def send(self, data: bytes) -> None:
        if self.is_lost or self.is_closed:
            return
        chance, weather = self._network.chance, self._weather
        pieces = chance.randint(1, min(weather.pieces, len(data))) if weather.pieces > 1 else 1
        places = [0, *sorted(chance.sample(range(1, len(data)), pieces - 1)), len(data)]
        for start, end in pairwise(places):
            self._launch(data[start:end])

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            if not self.is_lost:
                self._launch(None)

    def _launch(self, piece: bytes | None) -> None:
        weather = self._weather
        delay = weather.latency
        if weather.jitter:
            delay += self._network.chance.uniform(0, weather.jitter)
        self._latest = max(self._network.loop.time() + delay, self._latest)
        self._flight.append((self._latest, piece))
        self._size += len(piece or b"")
        self._set_timer()

    def _set_timer(self) -> None:
        if self._timer is None and self._flight:
            at = max(self._flight[0][0], self.thaws_at)
            if at < math.inf:
                self._timer = self._network.loop.call_at(at, self._deliver)

    def _deliver(self) -> None:
        self._timer = None
        now = self._network.loop.time()
        if now >= self.thaws_at:
            while self._flight and self._flight[0][0] <= now:
                piece = self._flight.popleft()[1]
                if piece is None:
                    self.has_ended = True
                else:
                    self._inbox.append(piece)
            self._tell_reader()
        self._set_timer()

    def freeze(self, until: float) -> None:
        """Nothing arrives before that; `math.inf` is never."""
        self.thaws_at = until
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._set_timer()

    def lose(self) -> None:
        """Lose what is under way, from a byte on that chance chooses, and all that follows."""
        self.is_lost = True
        under_way = sum(len(piece or b"") for _, piece in self._flight)
        keep = self._network.chance.randint(0, under_way)
        kept: deque[tuple[float, bytes | None]] = deque()
        for at, piece in self._flight:
            if not keep or piece is None:
                break
            kept.append((at, piece[:keep]))
            keep -= len(kept[-1][1] or b"")
        self._flight = kept
        self._size = sum(map(len, self._inbox)) + sum(len(piece or b"") for _, piece in kept)
        self._tell_writer()

    def take(self, limit: int) -> bytes:
        piece = self._inbox.popleft()
        if len(piece) > limit:
            self._inbox.appendleft(piece[limit:])
            piece = piece[:limit]
        self._size -= len(piece)
        self._tell_writer()
        return piece

    def __bool__(self) -> bool:
        return bool(self._inbox)

    def end_with(self, manner: Manner) -> None:
        """Whoever reads here will find out in this way, behind what is still under way."""
        if manner == "end":
            self._launch(None)
        elif manner == "reset":
            at = self._network.loop.time() + self._network.chance.uniform(0, 0.01)
            self._network.loop.call_at(at, self.break_now)

    def break_now(self) -> None:
        self.is_broken = True
        self._tell_reader()
        self._tell_writer()


class SimulatedStream(ByteStream):
    """One end of a connection."""

    def __init__(self, name: str, incoming: _Way, outgoing: _Way, peer: str) -> None:
        self.name = name
        self.peer = peer
        self._incoming = incoming
        self._outgoing = outgoing
        self.is_open = True
        self._gone = False

    async def send(self, item: bytes) -> None:
        await anyio.lowlevel.checkpoint()
        while True:
            self._check()
            # A peer that has closed answers with a reset; the end of its stream came first.
            if self._incoming.is_broken or (self._incoming.has_ended and self._gone):
                raise anyio.BrokenResourceError
            if not self._outgoing.is_full:
                break
            await self._outgoing.room.wait()
        self._gone = self._incoming.has_ended
        self._outgoing.send(item)

    async def receive(self, max_bytes: int = 65536) -> bytes:
        await anyio.lowlevel.checkpoint()
        while not self._incoming:
            self._check()
            if self._incoming.is_broken:
                raise anyio.BrokenResourceError
            if self._incoming.has_ended:
                raise anyio.EndOfStream
            await self._incoming.arrived.wait()
        self._check()
        return self._incoming.take(max_bytes)

    async def send_eof(self) -> None:
        await anyio.lowlevel.checkpoint()
        self._outgoing.close()

    async def aclose(self) -> None:
        self.close_now()
        await anyio.lowlevel.checkpoint()

    def close_now(self) -> None:
        """Close it. What comes from now on comes to nobody, and its sender does not wait for it."""
        if self.is_open:
            self.is_open = False
            self._outgoing.close()
            self._incoming.is_lost = True
            for way in (self._incoming, self._outgoing):
                way.arrived.wake()
                way.room.wake()

    @property
    def ways(self) -> tuple[_Way, _Way]:
        """What comes, and what goes."""
        return self._incoming, self._outgoing

    def _check(self) -> None:
        if not self.is_open:
            raise anyio.ClosedResourceError


class _Connection:
    """Both ends of a connection, and what lies between."""

    def __init__(self, network: Network, line: Line, number: int) -> None:
        up, down = _Way(network, line.weather), _Way(network, line.weather)
        self.line = line
        self.ways: dict[Direction, _Way] = {"up": up, "down": down}
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
        self._news = Waking()

    def offer(self, stream: SimulatedStream) -> None:
        """Somebody has connected."""
        self._waiting.append(stream)
        self._news.wake()

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
