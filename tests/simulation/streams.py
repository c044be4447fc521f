"""The two ends of a connection in memory: bytes that take time, arrive in pieces, and get lost.

All randomness comes from one `random.Random`, all time from the virtual loop. The streams do not
interpret the bytes.
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

from fibaction._runtime.notify import Notifier
from tests.simulation.loop import VirtualLoop

Manner: TypeAlias = Literal["reset", "end", "silence"]
"""The end of a connection: both ends get an error, or the end of the stream, or no notice."""


class Weather(msgspec.Struct, frozen=True):
    """The properties of a line."""

    latency: float = 0.001
    """The least seconds that each piece takes."""
    jitter: float = 0.0
    """The most seconds that a piece takes longer; pieces never overtake each other."""
    pieces: int = 1
    """The most pieces in which the bytes of one `send` arrive."""
    buffer: int = 2**16
    """Bytes that may be under way in one direction before the sender waits."""
    dial: float = 0.002
    """Seconds until a connection is open."""


def _do_nothing() -> None:
    pass


class Way:
    """One direction of one connection."""

    def __init__(self, loop: VirtualLoop, chance: random.Random, weather: Weather) -> None:
        self._loop = loop
        self._chance = chance
        self._weather = weather
        self._flight: deque[tuple[float, bytes | None]] = deque()  # None is the end of the stream
        self._latest = 0.0
        self._timer: Any = None
        self._inbox: deque[bytes] = deque()
        self._size = 0
        self.thaws_at = 0.0
        self.is_closed = False
        """True if its sender has closed it."""
        self.has_ended = False
        """True if the end of the stream has arrived."""
        self.is_broken = False
        """True if its reader gets an error."""
        self.is_lost = False
        """True if bytes are lost on the way without notice."""
        self.arrived = Notifier()
        self.room = Notifier()
        self.on_arrival: Callable[[], None] = _do_nothing
        """The callback for bytes that may have arrived: see `sockets`."""
        self.on_room: Callable[[], None] = _do_nothing
        """The callback for room to write."""

    def _tell_reader(self) -> None:
        self.arrived.notify()
        self.on_arrival()

    def _tell_writer(self) -> None:
        self.room.notify()
        self.on_room()

    @property
    def is_full(self) -> bool:
        return self._size >= self._weather.buffer

    def send(self, data: bytes) -> None:
        if self.is_lost or self.is_closed:
            return
        chance, weather = self._chance, self._weather
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
            delay += self._chance.uniform(0, weather.jitter)
        self._latest = max(self._loop.time() + delay, self._latest)
        self._flight.append((self._latest, piece))
        self._size += len(piece or b"")
        self._set_timer()

    def _set_timer(self) -> None:
        if self._timer is None and self._flight:
            at = max(self._flight[0][0], self.thaws_at)
            if at < math.inf:
                self._timer = self._loop.call_at(at, self._deliver)

    def _deliver(self) -> None:
        self._timer = None
        now = self._loop.time()
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
        """Delay all bytes until that time; `math.inf` is for ever."""
        self.thaws_at = until
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._set_timer()

    def lose(self) -> None:
        """Lose the bytes under way, from a random byte on, and all that follow."""
        self.is_lost = True
        under_way = sum(len(piece or b"") for _, piece in self._flight)
        keep = self._chance.randint(0, under_way)
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

    @property
    def has_bytes(self) -> bool:
        """True if bytes have arrived and were not taken."""
        return bool(self._inbox)

    def end_with(self, manner: Manner) -> None:
        """End the way behind the bytes that are under way, in this manner."""
        if manner == "end":
            self._launch(None)
        elif manner == "reset":
            at = self._loop.time() + self._chance.uniform(0, 0.01)
            self._loop.call_at(at, self.break_now)

    def break_now(self) -> None:
        self.is_broken = True
        self._tell_reader()
        self._tell_writer()


class SimulatedStream(ByteStream):
    """One end of a connection."""

    def __init__(self, name: str, incoming: Way, outgoing: Way, peer: str) -> None:
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
        while not self._incoming.has_bytes:
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
        """Close the stream. Bytes that arrive afterwards are lost, without blocking the sender."""
        if self.is_open:
            self.is_open = False
            self._outgoing.close()
            self._incoming.is_lost = True
            for way in (self._incoming, self._outgoing):
                way.arrived.notify()
                way.room.notify()

    def forget_callbacks(self) -> None:
        """Drop the callbacks of `sockets`."""
        self._incoming.on_arrival = self._outgoing.on_room = _do_nothing

    @property
    def ways(self) -> tuple[Way, Way]:
        """The incoming and the outgoing way."""
        return self._incoming, self._outgoing

    def _check(self) -> None:
        if not self.is_open:
            raise anyio.ClosedResourceError
