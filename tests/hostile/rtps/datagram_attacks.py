"""The attacks: what an attacker sends again and again, and the bounds of what it costs."""

from __future__ import annotations

import os
import socket
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import asynccontextmanager
from itertools import count
from typing import NamedTuple, TypeAlias

import anyio

from fibaction_transports.rtps.discovery.endpoint_discovery import EndpointData, endpoint_payload
from fibaction_transports.rtps.events import EndpointMatched, Event
from fibaction_transports.rtps.messages.ids import (
    PUBLICATIONS_READER,
    PUBLICATIONS_WRITER,
    SUBSCRIPTIONS_READER,
    SUBSCRIPTIONS_WRITER,
    UNKNOWN_ENTITY,
    Guid,
)
from fibaction_transports.rtps.messages.layout import MAX_NUMBER
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
    SourceInfo,
    Submessage,
    WriterHeartbeat,
)
from fibaction_transports.rtps.network import open_network
from fibaction_transports.rtps.ports import DomainSettings
from fibaction_transports.rtps.qos import Durability, Qos
from tests.hostile.rtps.echo_victim import ANSWERED, ASKED, KEPT, LARGE, SIZE, EchoIdentity
from tests.transports.rtps.target import hello, packet
from tests.transports.rtps.world import TYPE, payload

DATAGRAMS = 300
"""Datagrams of a wave, at least."""
PACKED = 300
"""Submessages in each of those that are packed: so many cost an attacker little."""
VENDOR = b"\1\x0f"
MIB = 2**20


class Attacker:
    """An attacker: a real participant that has found its victim, and a socket beside it."""

    def __init__(self, victim: EchoIdentity, raw: socket.socket) -> None:
        self.victim = victim
        self.raw = raw
        self.sent = 0
        """Bytes that were sent."""
        self.prefix = self.writer = self.reader = self.large = b""
        self.counts = count(1)
        self.numbers = count(1)
        self._news = anyio.Event()
        self._matched = 0

    def told(self, event: Event) -> None:
        """Take an event of the real participant."""
        self._matched += isinstance(event, EndpointMatched)
        if self._matched >= 3:
            self._news.set()

    async def meet(self) -> None:
        """Wait until all endpoints are matched with those of the victim."""
        await self._news.wait()

    @property
    def here(self) -> tuple[str, int]:
        """The address of the raw socket."""
        host, port = self.raw.getsockname()
        return str(host), int(port)

    def throw(self, datagram: bytes) -> None:
        """Send a datagram; one for which there is no room is lost."""
        try:
            self.raw.sendto(datagram, self.victim.address)
        except BlockingIOError:
            return
        self.sent += len(datagram)

    def send(self, *of: Submessage, prefix: bytes | None = None) -> None:
        """Send submessages in the name of the attacker, or of another participant."""
        self.throw(packet(prefix or self.prefix, *of))


@asynccontextmanager
async def attacker_of(victim: EchoIdentity) -> AsyncGenerator[Attacker, None]:
    """Open an attacker, which has found its victim."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
        raw.bind(("127.0.0.1", 0))
        raw.setblocking(False)
        attacker = Attacker(victim, raw)
        async with open_network(DomainSettings(domain=victim.domain), attacker.told) as network:
            late = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)
            attacker.prefix = network.participant.prefix
            attacker.writer = network.create_writer(ASKED, TYPE, Qos()).guid.entity
            attacker.reader = network.create_reader(ANSWERED, TYPE, Qos()).guid.entity
            attacker.large = network.create_reader(LARGE, TYPE, late).guid.entity
            await attacker.meet()
            yield attacker


Wave: TypeAlias = Callable[[Attacker], Iterator[None]]


class DatagramAttack(NamedTuple):
    """An attack, which repeats a wave of datagrams; it stops at each `yield`."""

    wave: Wave
    above: int
    """MiB of memory that the victim may use above those before."""
    factor: float
    """Bytes that the victim may send for each byte of the attack, beside its budget of repairs."""


DATAGRAM_ATTACKS: dict[str, DatagramAttack] = {}


def attack(name: str, *, above: int = 32, factor: float = 3.0) -> Callable[[Wave], Wave]:
    """Register a wave as an attack."""

    def register(wave: Wave) -> Wave:
        DATAGRAM_ATTACKS[name] = DatagramAttack(wave, above, factor)
        return wave

    return register


def stranger() -> bytes:
    return VENDOR + os.urandom(10)


@attack("datagrams of nothing")
def nothing(attacker: Attacker) -> Iterator[None]:
    for number in range(DATAGRAMS):
        for datagram in (b"", b"RTPS", os.urandom(100), packet(stranger()), bytes(60_000)):
            attacker.throw(datagram)
        if number % 10 == 0:
            yield


@attack("participants", above=48)
def participants(attacker: Attacker) -> Iterator[None]:
    for _ in range(DATAGRAMS):
        name = stranger()
        attacker.send(hello(name, attacker.here), prefix=name)
        yield


@attack("many participants in one datagram", above=48)
def packed_participants(attacker: Attacker) -> Iterator[None]:
    for _ in range(10):
        names = [stranger() for _ in range(PACKED)]
        announced = [(SourceInfo(VENDOR, name), hello(name, attacker.here)) for name in names]
        attacker.send(*(each for pair in announced for each in pair))
        yield


@attack("participants that receive", above=64, factor=20)
def proven_participants(attacker: Attacker) -> Iterator[None]:
    for _ in range(DATAGRAMS):
        name = stranger()
        attacker.send(hello(name, attacker.here), prefix=name)
        attacker.send(Destination(attacker.victim.prefix), prefix=name)
        yield


def _announced(attacker: Attacker, number: int, *, depth: int) -> list[Submessage]:
    """Return the announcement of a writer or reader on the topics of the victim."""
    is_writer = number % 2 == 0
    entity = (number % 1000 + 100).to_bytes(3, "big") + (b"\3" if is_writer else b"\4")
    data = EndpointData(
        guid=Guid(attacker.prefix + entity),
        topic=ASKED if is_writer else LARGE,
        type_name=TYPE,
        qos=Qos(depth=depth),
    )
    ends = (
        (PUBLICATIONS_READER, PUBLICATIONS_WRITER)
        if is_writer
        else (SUBSCRIPTIONS_READER, SUBSCRIPTIONS_WRITER)
    )
    at = 10 + next(attacker.numbers)
    beat = WriterHeartbeat(*ends, at, at, next(attacker.counts))
    return [beat, Data(*ends, at, endpoint_payload(data))]


@attack("endpoints", above=64, factor=5)
def endpoints(attacker: Attacker) -> Iterator[None]:
    for number in range(DATAGRAMS):
        attacker.send(*_announced(attacker, number, depth=1))
        yield


@attack("endpoints that change, many in one datagram", above=64, factor=5)
def changing_endpoints(attacker: Attacker) -> Iterator[None]:
    for depth in range(1, 10):
        several = [_announced(attacker, number, depth=depth) for number in range(100)]
        attacker.send(*(each for one in several for each in one))
        yield


@attack("fragments that never end", above=96)
def endless_fragments(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    for number in range(1, DATAGRAMS):
        first = DataFragment(*ends, number % 200 + 1, 1, 1, 1000, 10 * MIB, bytes(1000))
        attacker.send(WriterHeartbeat(*ends, 1, 250, next(attacker.counts)), first)
        yield


@attack("samples of gigabytes")
def gigabytes(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    for number in range(1, DATAGRAMS):
        attacker.send(DataFragment(*ends, number, 1, 1, 2**16 - 1, 2**32 - 2, bytes(2**16 - 1000)))
        attacker.send(DataFragment(*ends, number, 1, 1, 60_000, 2**31, bytes(60_000)))
        yield


@attack("requests for large samples, again and again")
def acknack_storm(attacker: Attacker) -> Iterator[None]:
    ends = attacker.large, attacker.victim.large
    numbers = tuple(range(1, KEPT + 1))
    for _ in range(DATAGRAMS):
        attacker.send(AckNack(*ends, NumberSet(1, numbers), next(attacker.counts)))
        yield


@attack("requests for fragments, again and again")
def fragment_storm(attacker: Attacker) -> Iterator[None]:
    ends = attacker.large, attacker.victim.large
    for number in range(DATAGRAMS):
        wanted = NumberSet(1, tuple(range(1, SIZE // 63_000 + 2)))
        at = number % KEPT + 1
        attacker.send(FragmentNack(*ends, at, wanted, next(attacker.counts)))
        yield


@attack("many requests in one datagram")
def packed_requests(attacker: Attacker) -> Iterator[None]:
    ends = attacker.reader, attacker.victim.writer
    numbers = NumberSet(1, tuple(range(1, 257)))
    wanted, asked = AckNack(*ends, numbers, 1), AckNack(*ends, NumberSet(0), 1)
    packets = [packet(attacker.prefix, *[each] * PACKED) for each in (wanted, asked)]
    for number in range(100):
        attacker.throw(packets[number % 2])
        yield


@attack("heartbeats, many in one datagram")
def heartbeat_storm(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    beats = [WriterHeartbeat(*ends, first, 250, first) for first in (1, 2)]
    packets = [packet(attacker.prefix, *[each] * PACKED) for each in beats]
    for number in range(100):
        attacker.throw(packets[number % 2])
        yield


@attack("numbers that jump")
def jumps(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    for exponent in range(1, 62):
        at = 2**exponent
        attacker.send(
            WriterHeartbeat(*ends, at, MAX_NUMBER - 1, next(attacker.counts)),
            *(Data(*ends, at + 2 * step, payload("x" * 100)) for step in range(100)),
            Gap(*ends, at, NumberSet(at + 1, (at + 3, at + 200))),
        )
        yield


@attack("gaps, many in one datagram")
def gap_flood(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    for _ in range(40):
        at = 1_000_000 + next(attacker.numbers) * 500
        gaps = [Gap(*ends, at + 1, NumberSet(at + 2 + step % 200)) for step in range(PACKED)]
        attacker.send(WriterHeartbeat(*ends, at, at + 400, next(attacker.counts)), *gaps)
        yield


@attack("samples that come too early")
def held_samples(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    for step in range(DATAGRAMS):
        sample = Data(*ends, 2**61 + 2 + step % 250, payload("x" * 60_000))
        attacker.send(WriterHeartbeat(*ends, 2**61, 2**61 + 250, next(attacker.counts)))
        attacker.send(sample)
        yield


@attack("heartbeats of writers that nobody knows")
def early_heartbeats(attacker: Attacker) -> Iterator[None]:
    for _ in range(40):
        beats = (
            WriterHeartbeat(UNKNOWN_ENTITY, os.urandom(3) + b"\3", 1, 9, next(attacker.counts))
            for _ in range(PACKED)
        )
        attacker.send(*beats)
        yield


@attack("samples of strangers")
def strangers(attacker: Attacker) -> Iterator[None]:
    ends = attacker.victim.reader, attacker.writer
    samples = [Data(*ends, 1, payload("x" * 40))] * PACKED
    for _ in range(20):
        attacker.send(*samples, prefix=stranger())
        yield
