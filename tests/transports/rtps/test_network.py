"""Participants with sockets, on this machine."""

from __future__ import annotations

import errno
import socket
from collections.abc import AsyncGenerator, Iterator
from contextlib import ExitStack, asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction.words.errors import TransportError
from fibaction_transports.rtps import sockets as sockets_module
from fibaction_transports.rtps.events import (
    EndpointMatched,
    EndpointUnmatched,
    Event,
    ParticipantFound,
    ParticipantLost,
    SampleReceived,
)
from fibaction_transports.rtps.network import MOST_AT_ONCE, ParticipantNetwork, open_network
from fibaction_transports.rtps.ports import (
    PARTICIPANTS,
    DiscoveryRange,
    DomainSettings,
    discovery_port,
    multicast_port,
)
from fibaction_transports.rtps.qos import Qos
from fibaction_transports.rtps.sockets import ParticipantSockets, default_interface
from tests.support.ros_domain import claim_domain
from tests.transports.rtps.world import TOPIC, TYPE, payload

PATIENCE = 15.0
"""Seconds for an exchange; fewer than a lease, because a participant that leaves says so."""
MANY = MOST_AT_ONCE + 10
"""More datagrams than are taken in one turn."""
OFF, SUBNET = DiscoveryRange.OFF, DiscoveryRange.SUBNET


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    """A domain that no other test run of this machine uses."""
    number, claim = claim_domain(50)
    with claim:
        yield number


class Listener:
    """The events of a participant."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._news = anyio.Event()

    def __call__(self, event: Event) -> None:
        self.events.append(event)
        self._news.set()

    async def wait(self, kind: type[Event], count: int = 1) -> list[Any]:
        """Wait until so many events of a kind have come, and return them."""
        while len(found := [event for event in self.events if isinstance(event, kind)]) < count:
            self._news = anyio.Event()
            await self._news.wait()
        return found


@asynccontextmanager
async def participant(
    settings: DomainSettings, listener: Listener | None = None, **more: Any
) -> AsyncGenerator[ParticipantNetwork, None]:
    with anyio.fail_after(PATIENCE):
        async with open_network(settings, listener or Listener(), **more) as network:
            yield network


async def exchange(settings: DomainSettings, **more: Any) -> None:
    """Send samples from one participant to another one, which leaves then."""
    here, there = Listener(), Listener()
    async with participant(settings, here, **more) as one:
        async with participant(settings, there, **more) as other:
            reader = other.create_reader(TOPIC, TYPE, Qos(), user_data=b"hash")
            writer = one.create_writer(TOPIC, TYPE, Qos(depth=None))
            await here.wait(EndpointMatched)
            sent = [payload("a"), payload("b" * 1_000_000), payload("c")]
            for each in sent:
                one.write(writer, each)
            received = await there.wait(SampleReceived, 3)
            assert [event.sample.payload for event in received] == sent
            other.remove(reader)
            await here.wait(EndpointUnmatched)
        await here.wait(ParticipantLost)
        assert one.participant.counters.invalid == 0


@pytest.mark.anyio
async def test_two_participants_of_this_machine_exchange_samples(domain: int) -> None:
    await exchange(DomainSettings(domain=domain))


@pytest.mark.anyio
async def test_they_find_each_other_by_multicast_on_the_interfaces_asked_for(domain: int) -> None:
    settings = DomainSettings(domain=domain, discovery_range=SUBNET)
    await exchange(settings, interfaces=["127.0.0.1"])


@pytest.mark.anyio
async def test_static_peers_are_found_without_multicast(domain: int) -> None:
    await exchange(DomainSettings(domain=domain, static_peers=("localhost",)))


@pytest.mark.anyio
async def test_with_discovery_off_nobody_is_found(domain: int) -> None:
    alone, other = Listener(), Listener()
    silent = DomainSettings(domain=domain, discovery_range=OFF, static_peers=("not a host",))
    async with participant(silent, alone) as network:
        async with participant(DomainSettings(domain=domain), other):
            async with participant(DomainSettings(domain=domain)) as third:
                (found,) = await other.wait(ParticipantFound)
                assert found.prefix == third.participant.prefix
        assert alone.events == []
        assert network.participant.counters.datagrams == 0


@pytest.mark.anyio
async def test_an_unknown_static_peer_is_an_error(domain: int) -> None:
    settings = DomainSettings(domain=domain, static_peers=("host.invalid",))
    with pytest.raises(TransportError, match=r"static peer 'host.invalid' is unknown"):
        async with participant(settings):
            pass


@pytest.mark.anyio
async def test_the_default_interface_is_used_if_none_is_asked_for(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.rtps.network.default_interface", lambda: "127.0.0.1")
    await exchange(DomainSettings(domain=domain, discovery_range=SUBNET))


@pytest.mark.anyio
async def test_sending_goes_on_when_the_system_has_room_again(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = ParticipantSockets.send
    tries = list[int]()

    def send(self: ParticipantSockets, datagram: bytes, address: tuple[str, int]) -> None:
        tries.append(len(datagram))
        if len(tries) % 3 == 1:
            raise BlockingIOError
        sent(self, datagram, address)

    monkeypatch.setattr(ParticipantSockets, "send", send)
    await exchange(DomainSettings(domain=domain))


@pytest.mark.anyio
async def test_errors_of_what_was_sent_before_do_not_end_a_participant(domain: int) -> None:
    async with participant(DomainSettings(domain=domain, discovery_range=OFF)) as network:
        with FailingSocket() as source:
            source.bind(("127.0.0.1", 0))
            source.setblocking(False)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(network.receive_from, source)
                for _ in range(MANY):
                    source.sendto(b"not RTPS", source.getsockname())
                await source.received.wait()
                tasks.cancel_scope.cancel()
        assert network.participant.counters.invalid == MANY


@pytest.mark.anyio
async def test_each_datagram_has_the_time_at_which_its_turn_comes(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    times: set[float] = set()
    async with participant(DomainSettings(domain=domain, discovery_range=OFF)) as network:
        monkeypatch.setattr(network.participant, "receive", lambda *of: times.add(of[-1]))
        with FailingSocket() as source:
            source.bind(("127.0.0.1", 0))
            source.setblocking(False)
            for _ in range(MANY):
                source.sendto(b"a", source.getsockname())
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(network.receive_from, source)
                await source.received.wait()
                tasks.cancel_scope.cancel()
    assert len(times) > MANY // 2


class FailingSocket(socket.socket):
    """A socket that fails once, as after an answer of ICMP."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self._has_failed = False
        self._count = 0
        self.received = anyio.Event()

    def recvfrom(self, *args: Any) -> Any:
        if not self._has_failed:
            self._has_failed = True
            raise ConnectionRefusedError
        datagram = super().recvfrom(*args)
        self._count += 1
        if self._count == MANY:
            self.received.set()
        return datagram


# Sockets


def test_each_participant_of_a_machine_has_ports_of_its_own(domain: int) -> None:
    with ExitStack() as stack:
        numbers = list[int]()
        for _ in range(3):
            sockets = ParticipantSockets(domain, is_local=True, interfaces=())
            stack.callback(sockets.close)
            numbers.append(sockets.participant)
            host, port = sockets.sender.getsockname()
            assert (host, port) == ("127.0.0.1", discovery_port(domain, sockets.participant))
        assert len(set(numbers)) == 3


def test_a_port_that_is_half_taken_is_passed_over(domain: int) -> None:
    first = ParticipantSockets(domain, is_local=True, interfaces=())
    number = first.participant
    first.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", discovery_port(domain, number) + 1))
        sockets = ParticipantSockets(domain, is_local=True, interfaces=())
        assert sockets.participant > number
        sockets.close()


def test_a_full_domain_is_an_error(domain: int) -> None:
    with ExitStack() as stack:
        for _ in PARTICIPANTS:
            sockets = ParticipantSockets(domain, is_local=True, interfaces=())
            stack.callback(sockets.close)
        with pytest.raises(TransportError, match=f"all ports of domain {domain} are taken"):
            ParticipantSockets(domain, is_local=True, interfaces=())
    assert len(PARTICIPANTS) == 120


def test_a_host_that_cannot_be_bound_is_an_error(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets_module, "LOCALHOST", "192.0.2.1")
    with pytest.raises(TransportError, match=r"cannot bind to 192.0.2.1"):
        ParticipantSockets(domain, is_local=True, interfaces=())


@pytest.mark.parametrize("interface", ["192.0.2.1", "eth0 of another machine"])
def test_an_interface_that_is_not_there_is_an_error(domain: int, interface: str) -> None:
    with pytest.raises(TransportError, match="is not the address of an interface with multicast"):
        ParticipantSockets(domain, is_local=False, interfaces=[interface])


def test_what_cannot_be_sent_is_lost(domain: int) -> None:
    sockets = ParticipantSockets(domain, is_local=True, interfaces=())
    sockets.send(b"x", ("192.0.2.1", 9))  # another network, from a loopback address
    sockets.send(b"x", ("239.255.0.1", multicast_port(domain)))  # no interface
    blocked: Any = BlockedSocket()
    sockets.received = [blocked]
    with pytest.raises(BlockingIOError):
        sockets.send(b"x", ("127.0.0.1", 9))
    sockets.close()


class BlockedSocket:
    """A socket without room."""

    def sendto(self, datagram: bytes, address: object) -> None:
        raise BlockingIOError(errno.EAGAIN, "no room")


def test_the_default_interface_has_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    assert socket.inet_aton(default_interface())

    class Unconnected(socket.socket):
        def connect(self, address: object) -> None:
            raise OSError(errno.ENETUNREACH, "no network")

    monkeypatch.setattr(socket, "socket", Unconnected)
    assert default_interface() == "127.0.0.1"
