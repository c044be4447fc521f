"""A participant with sockets: the driver of the library for asyncio and trio."""

from __future__ import annotations

import math
import socket
from collections import OrderedDict, deque
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager, closing
from time import perf_counter

import anyio
from msgspec import Struct, field

from fibaction.border.event_loop import Background
from fibaction.words.errors import TransportError
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import Event
from fibaction_transports.rtps.limits import MIB
from fibaction_transports.rtps.loops import AnyioLoop, AsyncioLoop, DrivingLoop, calls_for
from fibaction_transports.rtps.messages.ids import Address, Guid, is_ipv6
from fibaction_transports.rtps.participant import Participant, ParticipantSettings
from fibaction_transports.rtps.ports import (
    LOCALHOSTS,
    DiscoveryRange,
    DomainSettings,
    ParticipantSockets,
    announced_addresses,
    data_port,
    default_interface,
    discovery_port,
)
from fibaction_transports.rtps.qos import Qos

DATAGRAMS_READ_AT_ONCE = 64
"""Datagrams that are read from a socket at once."""
FAST = 0.0005
"""Seconds between two datagrams below which the socket is asked for another one at once. It costs a
call of the system, and mostly there is none."""
TURN = 0.005
"""Seconds after which other tasks get their turn, before more datagrams are taken."""
INBOX, INBOX_OF_ONE = 32 * MIB, 8 * MIB
"""Bytes of datagrams that were read and not taken, of all senders and of one."""
APART = 0.0005
"""Seconds between two samples from which on they need not share a datagram."""
CLOSING_TIME = 1.0
"""Seconds for which a participant that leaves waits for room to say so."""
MOST_WAITING = 256
"""Submessages that wait for the end of a turn before they are sent."""
OVERHEAD = 256
"""Bytes that are counted for a datagram beside its content."""
_LARGEST_DATAGRAM = 2**16
_FAMILIES: dict[tuple[int, ...], socket.AddressFamily] = {
    (4,): socket.AF_INET,
    (6,): socket.AF_INET6,
    (4, 6): socket.AF_UNSPEC,
}


class OwnAddresses(Struct, frozen=True, kw_only=True):
    """The addresses that a participant uses."""

    number: int
    """The number of the participant on this host, which its ports tell."""
    hosts: tuple[str, ...]
    """The addresses of this host that it announces."""
    interfaces: tuple[str, ...]
    """The addresses of the interfaces at which it has joined multicast."""
    peers: tuple[str, ...]
    """The addresses of the static peers, in their order."""


class _SenderQueue(Struct):
    """The datagrams of one sender."""

    datagrams: deque[bytes] = field(default_factory=deque)
    size: int = 0


class FairInbox:
    """Datagrams in the order in which they are taken.

    A sender that floods the sockets fills its own queue only: a datagram of another one waits for
    one of each sender, and not for all that came before it.
    """

    def __init__(self, limit: int, limit_of_one: int) -> None:
        """Keep so many bytes, and so many of one sender."""
        self._limit = limit
        self._limit_of_one = limit_of_one
        self._queues: OrderedDict[Address, _SenderQueue] = OrderedDict()
        self._size = 0

    def __bool__(self) -> bool:
        return bool(self._queues)

    def put(self, datagram: bytes, source: Address) -> bool:
        """Add a datagram; return False, and add none, if there is no room."""
        queue = self._queues.get(source)
        size = len(datagram) + OVERHEAD
        if queue is None:
            queue = _SenderQueue()
        if queue.size + size > self._limit_of_one or self._size + size > self._limit:
            return False
        self._queues[source] = queue
        queue.datagrams.append(datagram)
        queue.size += size
        self._size += size
        return True

    def take(self) -> tuple[bytes, Address]:
        """Take the next datagram, of which there is one."""
        source, queue = self._queues.popitem(last=False)
        datagram = queue.datagrams.popleft()
        size = len(datagram) + OVERHEAD
        queue.size -= size
        self._size -= size
        if queue.datagrams:
            self._queues[source] = queue
        return datagram, source


class ParticipantNetwork:
    """A participant that sends and receives. Made by `open_network`."""

    def __init__(
        self,
        participant: Participant,
        sockets: ParticipantSockets,
        on_event: Callable[[Event], None],
        loop: DrivingLoop,
        addresses: OwnAddresses,
    ) -> None:
        self.participant = participant
        """The participant. After calling its methods that change something, call `settle`."""
        self.addresses = addresses
        self._sockets = sockets
        self._on_event = on_event
        self._loop = loop
        self._inbox = FairInbox(INBOX, INBOX_OF_ONE)
        self._sending = participant.datagrams_to_send()
        self._unsent: tuple[bytes, Address] | None = None
        self._read_at = math.inf
        self._written_at = -math.inf
        self._is_blocked = anyio.Event()

    def create_writer(
        self, topic: str, type_name: str, qos: Qos, *, user_data: bytes = b""
    ) -> DataWriter:
        """Create a writer of a topic, and announce it."""
        now = self._loop.time()
        writer = self.participant.create_writer(topic, type_name, qos, now, user_data=user_data)
        self.settle()
        return writer

    def create_reader(
        self, topic: str, type_name: str, qos: Qos, *, user_data: bytes = b""
    ) -> DataReader:
        """Create a reader of a topic, and announce it."""
        now = self._loop.time()
        reader = self.participant.create_reader(topic, type_name, qos, now, user_data=user_data)
        self.settle()
        return reader

    def match_own(self, endpoint: DataWriter | DataReader) -> None:
        """Match an endpoint with the others of this participant."""
        self.participant.match_own(endpoint, self._loop.time())
        self.settle()

    def remove(self, endpoint: DataWriter | DataReader) -> None:
        """Close a writer or reader, and tell others that it is gone."""
        self.participant.remove(endpoint, self._loop.time())
        self.settle()

    def write(
        self,
        writer: DataWriter,
        payload: bytes,
        *,
        inline_qos: Sequence[tuple[int, bytes]] = (),
        time: float | None = None,
        only_to: Guid | None = None,
        is_alone: bool = False,
    ) -> int:
        """Send a sample, as `DataWriter.write` describes.

        Samples that are written at nearly the same time share datagrams, which leave soon. One that
        is alone belongs to no others: it leaves at once, if none was written just before.
        """
        now = self._loop.time()
        number = writer.write(payload, now, inline_qos=inline_qos, time=time, only_to=only_to)
        is_apart = is_alone and now - self._written_at > APART
        self._written_at = now
        if is_apart or self.participant.outbox.count >= MOST_WAITING:
            self.settle()
        else:
            self._loop.settle_soon()
        return number

    def catch_up(self, reader: DataReader) -> bool:
        """Get the samples that a reader is missing, as `DataReader.catch_up` describes."""
        takes_time = reader.catch_up(self._loop.time())
        self.settle()
        return takes_time

    def pause(self, reader: DataReader, is_paused: bool) -> None:
        """Hold samples of reliable writers back, or take them, as `DataReader.pause` describes."""
        reader.pause(self._loop.time(), is_paused=is_paused)
        self.settle()

    def ask_types(self, prefix: bytes, type_ids: Sequence[bytes]) -> int:
        """Ask another participant about types, as `TypeLookup.ask` describes."""
        number = self.participant.ask_types(prefix, type_ids, self._loop.time())
        self.settle()
        return number

    def settle(self) -> None:
        """Send what the participant wants to send, hand over its events, and note its deadline."""
        self._send()
        for event in self.participant.events():
            self._on_event(event)
        self._loop.wake(self.participant.next_deadline())

    async def close(self) -> None:
        """Tell others that this participant is gone, when its tasks have ended."""
        self.participant.close(self._loop.time())
        self._send()
        # Without that, others would miss it only when its lease is over.
        with anyio.move_on_after(CLOSING_TIME, shield=True):
            while self._is_blocked.is_set():
                await self._send_rest()

    def read(self, source: socket.socket) -> None:
        """Read what has arrived at a socket: one datagram, or several while they come fast."""
        before, self._read_at = self._read_at, perf_counter()
        for _ in range(DATAGRAMS_READ_AT_ONCE if self._read_at - before < FAST else 1):
            try:
                datagram, address = source.recvfrom(_LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:
                continue  # an answer of ICMP to something that was sent
            if not self._inbox.put(datagram, address[:2]):
                self.participant.counters.over_limit += 1

    def work(self) -> bool:
        """Take what was read, for a short time; return whether something is left."""
        self._send()  # the answer to a question is not to share a datagram with older samples
        end = perf_counter() + TURN
        is_left = bool(self._inbox)
        while is_left:
            # Not the time of the first one: many large ones take longer than some pauses.
            self.participant.receive(*self._inbox.take(), self._loop.time())
            is_left = bool(self._inbox)
            if perf_counter() > end:
                break
        self.settle()
        return is_left

    def on_deadline(self) -> None:
        """Do what is due."""
        self.participant.handle_deadline(self._loop.time())
        self.settle()

    async def send_later(self) -> None:
        """Continue sending when the system has room again, until it is canceled."""
        while True:
            await self._is_blocked.wait()
            await self._send_rest()

    async def _send_rest(self) -> None:
        await anyio.wait_writable(self._sockets.sender)
        self._is_blocked = anyio.Event()
        self._send()

    def _send(self) -> None:
        if self._unsent is None and not self.participant.outbox.count:
            return
        while not self._is_blocked.is_set():
            if self._unsent is None:
                self._unsent = next(self._sending, None)
            if self._unsent is None:
                self._sending = self.participant.datagrams_to_send()
                return
            try:
                self._sockets.send(*self._unsent)
            except BlockingIOError:
                self._is_blocked.set()
            else:
                self._unsent = None


@asynccontextmanager
async def open_network(
    settings: DomainSettings,
    on_event: Callable[[Event], None],
    *,
    interfaces: Sequence[str] = (),
    name: str = "/",
    fragment_size: int = 63_000,
) -> AsyncGenerator[ParticipantNetwork, None]:
    """Open the sockets of a participant, and run it while the block is open.

    `on_event` is called for each event, in order; it must not block. The interfaces, by their
    addresses, are for multicast; by default the one of the default route, for each version of IP.

    Raises:
        TransportError: The sockets cannot be opened, or a static peer is unknown.
    """
    reach, versions = settings.discovery_range, settings.ip_versions
    is_multicast = reach is DiscoveryRange.SUBNET
    peers = await _addresses(settings) if reach is not DiscoveryRange.OFF else ()
    is_local = not is_multicast and not peers
    hosts = [
        host
        for version in versions
        for host in _own_hosts(version, interfaces if is_multicast else (), is_local=is_local)
    ]
    domain = settings.domain
    joined = [host for host in hosts if host != LOCALHOSTS[6]] if is_multicast else []
    with closing(
        ParticipantSockets(domain, is_local=is_local, interfaces=joined, ip_versions=versions)
    ) as sockets:
        number = sockets.participant
        participant = Participant(
            ParticipantSettings(
                discovery_addresses=tuple((host, discovery_port(domain, number)) for host in hosts),
                data_addresses=tuple((host, data_port(domain, number)) for host in hosts),
                announce_to=announced_addresses(settings, peers, number),
                domain=domain,
                name=name,
                fragment_size=fragment_size,
            ),
            anyio.current_time(),
        )
        loop = AsyncioLoop() if calls_for(sockets.sender) else AnyioLoop()
        own = OwnAddresses(
            number=number,
            hosts=tuple(hosts),
            interfaces=tuple(joined),
            peers=peers,
        )
        network = ParticipantNetwork(participant, sockets, on_event, loop, own)
        try:
            async with Background() as tasks:
                sources = sockets.received if reach is not DiscoveryRange.OFF else ()
                tasks.start_soon(loop.run, network, sources)
                tasks.start_soon(network.send_later)
                network.settle()
                yield network
        finally:
            await network.close()


def _own_hosts(version: int, interfaces: Sequence[str], *, is_local: bool) -> list[str]:
    """Return the addresses of this host that a participant announces, of one version of IP."""
    if is_local:
        return [LOCALHOSTS[version]]
    found = [each for each in interfaces if is_ipv6(each) == (version == 6)]
    return found or [default_interface(version)]


async def _addresses(settings: DomainSettings) -> tuple[str, ...]:
    """Return the addresses of the static peers."""
    found = list[str]()
    for host in settings.static_peers:
        if is_ipv6(host) and 6 not in settings.ip_versions:
            raise TransportError(f"static peer {host!r} is an address of IPv6: use ip_versions=4,6")
        try:
            infos = await anyio.getaddrinfo(host, None, family=_FAMILIES[settings.ip_versions])
        except OSError as error:
            raise TransportError(f"static peer {host!r} is unknown: {error}") from error
        found.append(str(infos[0][4][0]))
    return tuple(found)
