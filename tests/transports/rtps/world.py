"""Participants on a network in virtual time, which loses, delays, repeats and reorders."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from random import Random
from typing import TypeVar

from msgspec import Struct

from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import Event, SampleReceived
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.codec import read_packet
from fibaction_transports.rtps.messages.ids import Address
from fibaction_transports.rtps.messages.submessages import Submessage
from fibaction_transports.rtps.participant import Participant, ParticipantSettings
from fibaction_transports.rtps.qos import Qos

GROUP = ("239.255.0.1", 7400)
TOPIC, TYPE = "rt/chatter", "std_msgs::msg::dds_::String_"
KEEP_ALL = Qos(depth=None)
E = TypeVar("E")
S = TypeVar("S", bound=Submessage)


def payload(text: str) -> bytes:
    """Return a payload of any length, with its encapsulation header."""
    return b"\x00\x01\x00\x00" + text.encode()


class Node:
    """A participant at an address, and what it has told."""

    def __init__(self, participant: Participant, host: str) -> None:
        self.participant = participant
        self.host = host
        self.told: list[Event] = []

    def all(self, kind: type[E]) -> list[E]:
        """Return the events of a kind."""
        return [event for event in self.told if isinstance(event, kind)]

    def samples(self, reader: DataReader) -> list[Sample]:
        """Return the samples that a reader has received."""
        found = self.all(SampleReceived)
        return [event.sample for event in found if event.reader == reader.guid]

    def texts(self, reader: DataReader) -> list[str]:
        """Return the texts that a reader has received."""
        return [sample.payload[4:].decode() for sample in self.samples(reader)]

    def sent(self) -> list[tuple[Submessage, ...]]:
        """Take the datagrams that it wants to send; return the submessages of each."""
        datagrams = self.participant.datagrams_to_send()
        return [read_packet(datagram).submessages for datagram, _ in datagrams]


class World:
    """A network and its participants."""

    def __init__(
        self, seed: int = 0, *, loss: float = 0, delay: float = 0.0001, repeats: float = 0
    ) -> None:
        self.random = Random(seed)
        self.now = 0.0
        self.nodes: dict[str, Node] = {}
        self.loss, self.delay, self.repeats = loss, delay, repeats
        self.sent = 0
        self.is_lost: Callable[[bytes, Address], bool] = lambda datagram, address: False
        """A rule for losses of its own."""
        self._under_way: list[tuple[float, int, bytes, Address, Address]] = []
        self._order = itertools.count()
        self._numbers = itertools.count(1)

    def join(
        self, *, lease: float = 20.0, fragment_size: int = 63_000, limits: RtpsLimits | None = None
    ) -> Node:
        """Add a participant."""
        number = next(self._numbers)
        host = f"10.0.0.{number}"
        settings = ParticipantSettings(
            discovery_addresses=((host, 7410),),
            data_addresses=((host, 7411),),
            announce_to=(GROUP,),
            lease=lease,
            fragment_size=fragment_size,
            limits=limits or RtpsLimits(),
        )
        prefix = b"\x01\x7f" + number.to_bytes(10, "big")
        node = Node(Participant(settings, self.now, prefix=prefix), host)
        self.nodes[host] = node
        return node

    def kill(self, node: Node) -> None:
        """Take a participant away, without a word."""
        del self.nodes[node.host]

    def pair(self) -> tuple[Node, Node]:
        """Add two participants, and wait until both know each other."""
        one, other = self.join(), self.join()
        self.run(1.0)
        return one, other

    def flush(self) -> None:
        """Take what the participants want to send and tell."""
        for node in list(self.nodes.values()):
            for datagram, address in node.participant.datagrams_to_send():
                self.send(datagram, (node.host, 7410), address)
            node.told += node.participant.events()

    def send(self, datagram: bytes, source: Address, address: Address) -> None:
        """Send a datagram, which may be lost or repeated."""
        self.sent += 1
        for _ in range(1 + (self.random.random() < self.repeats)):
            if self.random.random() >= self.loss and not self.is_lost(datagram, address):
                when = self.now + self.random.uniform(0.00005, self.delay)
                item = (when, next(self._order), datagram, source, address)
                heapq.heappush(self._under_way, item)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.run_until(lambda: False, seconds)

    def run_until(self, is_done: Callable[[], bool], limit: float = 60.0) -> bool:
        """Let time pass until something holds, at most the limit; return whether it holds."""
        end = self.now + limit
        while True:
            self.flush()
            if is_done():
                return True
            nodes = [node.participant for node in self.nodes.values()]
            arrival = self._under_way[0][0] if self._under_way else math.inf
            deadline = min((each.next_deadline() for each in nodes), default=math.inf)
            if min(arrival, deadline) > end:
                self.now = end
                return False
            self.now = max(self.now, min(arrival, deadline))
            if arrival <= deadline:
                self._arrive()
            else:
                for participant in nodes:
                    participant.handle_deadline(self.now)

    def heard(self, kind: type[S]) -> list[tuple[float, Address, S]]:
        """Return the submessages of a kind that are sent from now on: when, where to, and what."""
        found: list[tuple[float, Address, S]] = []

        def note(datagram: bytes, address: Address) -> bool:
            sent = read_packet(datagram).submessages
            found.extend((self.now, address, each) for each in sent if isinstance(each, kind))
            return False

        self.is_lost = note
        return found

    def _arrive(self) -> None:
        _, _, datagram, source, (host, _) = heapq.heappop(self._under_way)
        for node in list(self.nodes.values()):
            if node.host == host or (host == GROUP[0] and node.host != source[0]):
                node.participant.receive(datagram, source, self.now)


def writers_in(datagram: bytes, kind: type[Struct] = Struct) -> set[bytes]:
    """Return the entities of the writers that the submessages of a kind in a datagram name."""
    found = read_packet(datagram).submessages
    return {getattr(each, "writer", b"") for each in found if isinstance(each, kind)}


def reader_of(world: World, node: Node, qos: Qos | None = None, topic: str = TOPIC) -> DataReader:
    """Create a reader."""
    return node.participant.create_reader(topic, TYPE, qos or Qos(), world.now)


def writer_of(world: World, node: Node, qos: Qos = KEEP_ALL, topic: str = TOPIC) -> DataWriter:
    """Create a writer."""
    return node.participant.create_writer(topic, TYPE, qos, world.now)


class Link:
    """A writer of one participant and a reader of another, which have found each other."""

    def __init__(self, offered: Qos = KEEP_ALL, requested: Qos | None = None) -> None:
        self.world = World()
        self.one, self.other = self.world.pair()
        self.writer = writer_of(self.world, self.one, offered)
        self.reader = reader_of(self.world, self.other, requested)
        assert self.world.run_until(lambda: bool(self.writer.readers and self.reader.writers))
        self.world.run(1.0)

    @property
    def texts(self) -> list[str]:
        """The texts that the reader has received."""
        return self.other.texts(self.reader)

    def write(self, *texts: str) -> None:
        """Write a sample with each text."""
        for text in texts:
            self.writer.write(payload(text), self.world.now)

    def lose(self, *texts: str) -> None:
        """Write samples, each of which is lost with its heartbeat."""
        self.world.is_lost = lambda *_: True
        for text in texts:
            self.write(text)
            self.world.flush()
        self.world.is_lost = lambda *_: False
