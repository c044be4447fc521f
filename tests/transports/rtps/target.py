"""A participant that is sent packets of our own making, by strangers or by a peer that it knows."""

from __future__ import annotations

from typing import Any

from fibaction_transports.rtps.discovery.known_participants import (
    ParticipantData,
    participant_payload,
)
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.codec import packet_head, read_packet, submessage_bytes
from fibaction_transports.rtps.messages.ids import (
    FAST_DDS,
    PUBLICATIONS_WRITER,
    SPDP_WRITER,
    UNKNOWN_ENTITY,
    Address,
    udp_locator,
)
from fibaction_transports.rtps.messages.layout import LITTLE, Order
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.submessages import (
    Data,
    Destination,
    Submessage,
    WriterHeartbeat,
)
from fibaction_transports.rtps.qos import Durability, Qos
from tests.transports.rtps.world import Node, S, World, payload, reader_of, writer_of

STRANGER = FAST_DDS + b"a stranger"
HOST = "10.0.0.99"
SOURCE = (HOST, 7410)
"""The address of the stranger."""


def packet(prefix: bytes, *of: Submessage, order: Order = LITTLE) -> bytes:
    """Return a packet of a participant."""
    content = (submessage_bytes(each, order) for each in of)
    return packet_head(prefix[:2], prefix) + b"".join(content)


def announcement(content: bytes | None, inline_qos: Parameters | None = None) -> Data:
    """Return the announcement of a participant with this content."""
    return Data(UNKNOWN_ENTITY, SPDP_WRITER, 1, content, inline_qos)


def hello(prefix: bytes = STRANGER, *at: Address, **changed: Any) -> Data:
    """Return the announcement of a participant at these addresses."""
    locators = tuple(map(udp_locator, at or (SOURCE,)))
    fields = {"prefix": prefix, "discovery_locators": locators, "data_locators": locators}
    return announcement(participant_payload(ParticipantData(**(fields | changed))))


class Target:
    """A participant, what strangers send it, and what it sends to whom."""

    def __init__(self, limits: RtpsLimits | None = None) -> None:
        self.world = World()
        self.node: Node = self.world.join(limits=limits)
        self.participant = self.node.participant
        self.counters = self.participant.counters
        self._announced = 0
        self.received = 0
        """Bytes that strangers have sent."""
        self.sent: list[tuple[bytes, Address]] = []
        """The datagrams that it has sent since the first announcement."""
        self.take()
        self.sent.clear()

    def receive(
        self,
        *of: Submessage,
        prefix: bytes = STRANGER,
        host: str = HOST,
        order: Order = LITTLE,
    ) -> int:
        """Take submessages in the name of a participant; return the bytes that are sent at once."""
        datagram = packet(prefix, *of, order=order)
        self.received += len(datagram)
        self.participant.receive(datagram, (host, 7410), self.world.now)
        return self.take()

    def take(self) -> int:
        """Take what the participant tells and sends; return the bytes that it sends."""
        self.node.told += self.participant.events()
        datagrams = [*self.participant.datagrams_to_send()]
        self.sent += datagrams
        return sum(len(datagram) for datagram, _ in datagrams)

    def later(self, seconds: float) -> int:
        """Let time pass for the participant alone; return the bytes that it sends."""
        end, size = self.world.now + seconds, 0
        while (deadline := self.participant.next_deadline()) <= end:
            self.world.now = max(self.world.now, deadline)
            self.participant.handle_deadline(self.world.now)
            size += self.take()
        self.world.now = end
        return size

    def bytes_to(self, host: str) -> int:
        """Return the bytes that were sent to a host."""
        return sum(len(datagram) for datagram, address in self.sent if address[0] == host)

    def answers(self, kind: type[S]) -> list[tuple[Address, S]]:
        """Return the submessages of a kind that were sent, with their addresses."""
        return [
            (address, each)
            for datagram, address in self.sent
            for each in read_packet(datagram).submessages
            if isinstance(each, kind)
        ]

    def announce(self, content: bytes | None, inline: Parameters | None = None) -> None:
        """Take the announcement of a stranger's writer, or its end."""
        if not self._announced:
            self.receive(hello())
        self._announced += 1
        number, ends = self._announced, (UNKNOWN_ENTITY, PUBLICATIONS_WRITER)
        beat = WriterHeartbeat(*ends, 1, number, number, is_final=True)
        self.receive(Data(*ends, number, content, inline), beat)

    @property
    def here(self) -> Destination:
        """The proof of a sender that it has received something."""
        return Destination(self.participant.prefix)


class Victim(Target):
    """A participant with a reader and a writer, and a peer that knows it, with one of each."""

    def __init__(self, limits: RtpsLimits | None = None) -> None:
        super().__init__(limits)
        self.peer = self.world.join()
        qos = Qos(durability=Durability.TRANSIENT_LOCAL, depth=5)
        self.reader = reader_of(self.world, self.node)
        self.writer = writer_of(self.world, self.node, qos)
        self.peer_reader = reader_of(self.world, self.peer, qos)
        self.peer_writer = writer_of(self.world, self.peer, Qos())
        self.writer.write(payload("x" * 1000), self.world.now)
        self.world.run(2.0)
        assert self.reader.writers
        assert self.writer.readers

    @property
    def ends(self) -> tuple[bytes, bytes]:
        """The entities of the victim's reader and of the peer's writer."""
        return self.reader.guid.entity, self.peer_writer.guid.entity

    @property
    def asking(self) -> tuple[bytes, bytes]:
        """The entities of the peer's reader and of the victim's writer."""
        return self.peer_reader.guid.entity, self.writer.guid.entity

    @property
    def texts(self) -> list[str]:
        """The texts that the victim's reader has received."""
        return self.node.texts(self.reader)

    def hear(self, *of: Submessage) -> int:
        """Take submessages of the peer; return the bytes that are sent at once."""
        return self.receive(*of, prefix=self.peer.participant.prefix, host=self.peer.host)

    def write(self, *texts: str) -> int:
        """Write a sample with each text; return the bytes that are sent."""
        for text in texts:
            self.writer.write(payload(text), self.world.now)
        return self.take()

    @property
    def works(self) -> bool:
        """True if samples of the peer still arrive."""
        before = len(self.texts)
        self.peer_writer.write(payload("still there"), self.world.now)
        self.world.run(5.0)
        return len(self.texts) == before + 1
