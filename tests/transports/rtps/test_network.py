"""Participants with sockets, on this machine."""

from __future__ import annotations

import errno
import select
import socket
import struct
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager
from typing import Any, ClassVar, Self, TypeAlias

import anyio
import pytest

from fibaction.border.event_loop import Background, asyncio_loop
from fibaction.words.errors import TransportError
from fibaction_transports.rtps import loops
from fibaction_transports.rtps import network as network_module
from fibaction_transports.rtps import ports as ports_module
from fibaction_transports.rtps.discovery.type_lookup import TYPE_ID_SIZE
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import (
    CaughtUp,
    EndpointMatched,
    EndpointUnmatched,
    Event,
    ParticipantFound,
    ParticipantLost,
    SampleReceived,
)
from fibaction_transports.rtps.loops import AsyncioLoop, calls_for
from fibaction_transports.rtps.network import (
    DATAGRAMS_READ_AT_ONCE,
    MOST_WAITING,
    FairInbox,
    ParticipantNetwork,
    open_network,
)
from fibaction_transports.rtps.ports import (
    GROUPS,
    LOCALHOSTS,
    PARTICIPANTS,
    DiscoveryRange,
    DomainSettings,
    ParticipantSockets,
    default_interface,
    discovery_port,
    multicast_port,
)
from fibaction_transports.rtps.qos import Qos
from tests.support.ipv6 import has_ipv6
from tests.support.ros_domain import claim_domain
from tests.transports.rtps.world import TOPIC, TYPE, payload

PATIENCE = 15.0
"""Seconds for an exchange; fewer than a lease, because a participant that leaves says so."""
MANY = DATAGRAMS_READ_AT_ONCE + 10
"""More datagrams than are taken in one turn."""
Opened: TypeAlias = Callable[[], ParticipantSockets]
needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
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


@asynccontextmanager
async def link(domain: int) -> AsyncGenerator[tuple[ParticipantNetwork, DataWriter, Listener]]:
    """Open two participants; yield one with its writer, which has sent a sample, and what the other
    one is told.
    """
    here, there = Listener(), Listener()
    settings = DomainSettings(domain=domain)
    async with participant(settings, here) as one, participant(settings, there) as other:
        other.create_reader(TOPIC, TYPE, Qos())
        writer = one.create_writer(TOPIC, TYPE, Qos(depth=None))
        await here.wait(EndpointMatched)
        one.write(writer, payload("first"))
        await there.wait(SampleReceived)
        yield one, writer, there


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
            assert other.catch_up(reader)
            await there.wait(CaughtUp)
            other.remove(reader)
            await here.wait(EndpointUnmatched)
        await here.wait(ParticipantLost)
        assert one.participant.counters.invalid == 0


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("changed", "more"),
    [
        pytest.param({}, {}, id="this machine"),
        pytest.param({"static_peers": ("localhost",)}, {}, id="without multicast"),
        pytest.param({"discovery_range": SUBNET}, {}, id="the default interface"),
        pytest.param({"discovery_range": SUBNET}, {"interfaces": ["127.0.0.1"]}, id="an interface"),
        *(
            pytest.param({"ip_versions": versions, "static_peers": peers}, {}, marks=needs_ipv6)
            for versions in [(6,), (4, 6)]
            for peers in [(), ("::1",)]
        ),
    ],
)
async def test_two_participants_find_each_other_and_exchange_samples(
    domain: int, monkeypatch: pytest.MonkeyPatch, changed: Any, more: Any
) -> None:
    monkeypatch.setattr("fibaction_transports.rtps.network.default_interface", LOCALHOSTS.get)
    await exchange(DomainSettings(domain=domain, **changed), **more)


@pytest.mark.anyio
async def test_the_addresses_and_the_others_can_be_asked_for(domain: int) -> None:
    settings = DomainSettings(domain=domain, static_peers=("localhost",))
    found = Listener()
    async with participant(settings, found) as one, participant(settings) as other:
        await found.wait(ParticipantFound)
        (remote,) = one.participant.remote_participants
        assert (remote.data.prefix, remote.source) == (other.participant.prefix, "127.0.0.1")
        assert {one.addresses.number, other.addresses.number} == {0, 1}
        assert one.addresses.peers == ("127.0.0.1",)
        assert one.addresses.interfaces == ()


@pytest.mark.anyio
async def test_a_participant_that_answers_no_questions_about_types_is_asked_none(
    domain: int,
) -> None:
    settings, found = DomainSettings(domain=domain), Listener()
    async with participant(settings, found) as one, participant(settings) as other:
        await found.wait(ParticipantFound)
        assert one.ask_types(other.participant.prefix, [bytes(TYPE_ID_SIZE)]) == 0


def noted(monkeypatch: pytest.MonkeyPatch, content: bytes) -> list[int]:
    """Note how often each datagram that is sent from now on has a content."""
    sent: list[int] = []
    send = ParticipantSockets.send

    def note(self: ParticipantSockets, datagram: bytes, address: Any) -> None:
        sent.append(datagram.count(content))
        send(self, datagram, address)

    monkeypatch.setattr(ParticipantSockets, "send", note)
    return sent


@pytest.mark.anyio
async def test_samples_of_one_turn_share_datagrams(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with link(domain) as (one, writer, there):
        sent = noted(monkeypatch, b"of one turn")
        for _ in range(20):
            one.write(writer, payload("of one turn"))
        assert sum(sent) == 0
        await there.wait(SampleReceived, 21)
        assert max(sent) == 20
        sent.clear()
        for _ in range(2 * MOST_WAITING):
            one.write(writer, payload("of one turn"))
        assert sum(sent) >= MOST_WAITING  # they do not wait for the end of a long turn
        await there.wait(SampleReceived, 21 + 2 * MOST_WAITING)


@pytest.mark.anyio
@pytest.mark.parametrize(("apart", "at_once"), [(-1.0, 1), (PATIENCE, 0)])
async def test_a_sample_that_is_alone_leaves_at_once_if_none_was_written_just_before(
    apart: float, at_once: int, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with link(domain) as (one, writer, there):
        sent = noted(monkeypatch, b"alone")
        monkeypatch.setattr(network_module, "APART", apart)
        one.write(writer, payload("alone"), is_alone=True)
        assert sum(sent) == at_once
        one.write(writer, payload("alone"))
        assert sum(sent) == at_once
        await there.wait(SampleReceived, 3)
        assert max(sent) == 2 - at_once  # the others share one


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
@pytest.mark.parametrize(
    ("peer", "message"),
    [
        ("fe80::1", r"'fe80::1' is an address of IPv6: use ip_versions"),
        ("host.invalid", r"static peer 'host.invalid' is unknown"),
    ],
)
async def test_a_static_peer_that_cannot_be_reached_is_an_error(
    peer: str, message: str, domain: int
) -> None:
    with pytest.raises(TransportError, match=message):
        async with participant(DomainSettings(domain=domain, static_peers=(peer,))):
            pass


@needs_ipv6
@pytest.mark.anyio
async def test_the_addresses_of_both_versions_of_ip_can_be_asked_for(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.rtps.network.default_interface", LOCALHOSTS.get)
    settings = DomainSettings(domain=domain, discovery_range=SUBNET, ip_versions=(4, 6))
    async with participant(settings) as network:
        assert network.addresses.hosts == ("127.0.0.1", "::1")
        assert network.addresses.interfaces == ("127.0.0.1",)  # there is no other of IPv6
    async with participant(settings, interfaces=["127.0.0.1"]) as network:
        assert network.addresses.hosts == ("127.0.0.1", "::1")


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


def read_own(network: ParticipantNetwork, count: int, source: socket.socket | None = None) -> None:
    """Let a socket send itself so many datagrams, and a participant read and take them, in as many
    turns as a busy machine needs.
    """
    with source or socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.setblocking(False)
        for _ in range(count):
            own.sendto(b"not RTPS", own.getsockname())
        is_left = True
        while is_left:
            network.read(own)
            is_left = bool(select.select([own], [], [], 0)[0])
            while network.work():
                pass


@pytest.mark.anyio
async def test_errors_of_what_was_sent_before_do_not_end_a_participant(domain: int) -> None:
    async with participant(DomainSettings(domain=domain, discovery_range=OFF)) as network:
        read_own(network, MANY, FailingSocket())
        assert network.participant.counters.invalid == MANY


@pytest.mark.anyio
async def test_each_datagram_has_the_time_at_which_its_turn_comes(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    times: set[float] = set()
    async with participant(DomainSettings(domain=domain, discovery_range=OFF)) as network:
        monkeypatch.setattr(network.participant, "receive", lambda *of: times.add(of[-1]))
        read_own(network, DATAGRAMS_READ_AT_ONCE)
    assert len(times) > DATAGRAMS_READ_AT_ONCE // 2


@pytest.mark.anyio
async def test_what_takes_long_is_taken_in_several_turns(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.rtps.network.TURN", -1.0)
    await exchange(DomainSettings(domain=domain))


@pytest.mark.anyio
async def test_datagrams_of_one_sender_are_read_up_to_a_limit(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.rtps.network.INBOX_OF_ONE", 1000)
    async with participant(DomainSettings(domain=domain, discovery_range=OFF)) as network:
        read_own(network, 9)
        counters = network.participant.counters
        assert (counters.invalid, counters.over_limit) == (3, 6)


@pytest.mark.anyio
async def test_an_error_of_the_callback_ends_the_block(domain: int) -> None:
    def told(event: Event) -> None:
        if isinstance(event, ParticipantFound):
            raise ValueError(f"a bug with {event.prefix.hex()}")

    settings = DomainSettings(domain=domain)
    with pytest.raises(ExceptionGroup) as raised:
        async with participant(settings), open_network(settings, told):
            await anyio.sleep(PATIENCE)
    assert raised.group_contains(ValueError, match="a bug with")


class FailingSocket(socket.socket):
    """A socket that fails once, as after an answer of ICMP."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self._has_failed = False

    def recvfrom(self, *args: Any) -> Any:
        if not self._has_failed:
            self._has_failed = True
            raise ConnectionRefusedError
        return super().recvfrom(*args)


# Whose turn it is


def test_a_datagram_of_another_sender_does_not_wait_for_a_flood() -> None:
    inbox = FairInbox(10_000, 4_000)
    flood, other = ("127.0.0.1", 1), ("127.0.0.1", 2)
    taken = [inbox.put(bytes([number]), flood) for number in range(50)]
    assert taken.count(True) == 15
    assert inbox.put(b"a", other)
    assert inbox.put(b"b", other)
    found = [inbox.take() for _ in range(5)]
    first, second, third = bytes([0]), bytes([1]), bytes([2])
    assert found == [(first, flood), (b"a", other), (second, flood), (b"b", other), (third, flood)]
    while inbox:
        inbox.take()
    assert inbox.put(bytes(3_000), flood)
    assert inbox.put(bytes(3_000), other)
    assert inbox.put(bytes(3_000), ("127.0.0.1", 3))
    assert not inbox.put(bytes(3_000), ("127.0.0.1", 4))


@pytest.mark.asyncio
async def test_a_loop_of_asyncio_that_does_not_call_back_for_sockets_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def not_there(*_: object) -> None:
        raise NotImplementedError

    one, other = socket.socketpair()
    with one, other:
        assert calls_for(one)
        monkeypatch.setattr(asyncio_loop(), "add_reader", not_there)
        assert not calls_for(one)


def test_a_loop_of_trio_does_not_call_back_for_sockets() -> None:
    async def asked() -> bool:
        with socket.socket() as one:
            return calls_for(one)

    assert not anyio.run(asked, backend="trio")


class Participant:
    """A participant with nothing to do, as its loop sees it."""

    def read(self, source: socket.socket) -> None: ...

    def work(self) -> bool:
        return False

    def on_deadline(self) -> None: ...

    def settle(self) -> None: ...


@pytest.mark.asyncio
async def test_a_loop_of_asyncio_wakes_once_for_the_earliest_time() -> None:
    woken = list[float]()

    class Sleeper(Participant):
        def on_deadline(self) -> None:
            woken.append(anyio.current_time())
            if len(woken) > 1:
                raise ValueError("enough")
            loop.wake(anyio.current_time())

    loop, now = AsyncioLoop(), anyio.current_time()
    for when in (now + 100, now + 0.001, now + 50):
        loop.wake(when)
    with pytest.raises(ValueError, match="enough"):
        await loop.run(Sleeper(), ())
    loop.settle_soon()
    await anyio.wait_all_tasks_blocked()  # nothing is driven any more
    assert woken[0] >= now
    loop.wake(now)
    await anyio.sleep(0.001)
    assert len(woken) == 2
    loop._fail(ValueError("a second error of the same turn"))


@pytest.mark.asyncio
async def test_samples_of_tasks_that_wake_each_other_are_sent_together_and_not_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loops, "LONGEST_SETTLING", 1.0)
    sent = list[int]()

    class Sender(Participant):
        def settle(self) -> None:
            sent.append(written)

    loop, written = AsyncioLoop(), 0
    async with Background() as tasks:
        tasks.start_soon(loop.run, Sender(), ())
        await anyio.wait_all_tasks_blocked()
        for _ in range(10):
            written += 1
            loop.settle_soon()
            await anyio.lowlevel.checkpoint()
        for _ in range(2):
            await anyio.lowlevel.checkpoint()
        assert sent == [10]
        monkeypatch.setattr(loops, "LONGEST_SETTLING", -1.0)
        loop.settle_soon()
        await anyio.lowlevel.checkpoint()
        assert sent == [10, 10]  # not postponed for longer


@pytest.mark.asyncio
@pytest.mark.parametrize("failing", ["read", "work", "settle"])
async def test_an_error_while_a_participant_is_driven_ends_the_loop(
    failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> bool:
        raise ValueError(failing)

    monkeypatch.setattr(Participant, failing, fails)
    one, other = socket.socketpair()
    with one, other:
        loop = AsyncioLoop()
        other.send(b"something")
        loop.settle_soon()
        with pytest.raises(ValueError, match=failing):
            await loop.run(Participant(), [one])


@pytest.mark.asyncio
async def test_datagrams_that_arrive_during_the_work_wait_for_its_next_turn() -> None:
    reads, turns, is_enough = list[object](), list[object](), anyio.Event()

    class Busy(Participant):
        """A participant that always has more to do, and reads nothing of what has arrived."""

        def read(self, source: socket.socket) -> None:
            reads.append(source)
            if len(reads) > 3:
                is_enough.set()

        def work(self) -> bool:
            turns.append(self)
            return True

    one, other = socket.socketpair()
    with one, other, anyio.fail_after(PATIENCE):
        one.send(b"a datagram")
        async with Background() as tasks:
            tasks.start_soon(AsyncioLoop().run, Busy(), [other])
            await is_enough.wait()
    assert len(turns) <= len(reads) + 1


# Sockets


@pytest.fixture
def opened(domain: int) -> Iterator[Opened]:
    """A function that opens the sockets of a participant."""
    with ExitStack() as stack:

        def open_one() -> ParticipantSockets:
            sockets = ParticipantSockets(domain, is_local=True, interfaces=())
            stack.callback(sockets.close)
            return sockets

        yield open_one


def test_each_participant_of_a_machine_has_ports_of_its_own(domain: int, opened: Opened) -> None:
    participants = [opened() for _ in range(3)]
    assert len({sockets.participant for sockets in participants}) == 3
    for sockets in participants:
        address = ("127.0.0.1", discovery_port(domain, sockets.participant))
        assert sockets.sender.getsockname() == address


def test_a_port_that_is_half_taken_is_passed_over(domain: int, opened: Opened) -> None:
    first = opened()
    first.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", discovery_port(domain, first.participant) + 1))
        assert opened().participant > first.participant


def test_a_full_domain_is_an_error(domain: int, opened: Opened) -> None:
    for _ in PARTICIPANTS:
        opened()
    with pytest.raises(TransportError, match=f"all ports of domain {domain} are taken"):
        opened()
    assert len(PARTICIPANTS) == 120


def test_a_host_that_cannot_be_bound_is_an_error(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports_module, "LOCALHOSTS", {4: "192.0.2.1"})
    with pytest.raises(TransportError, match=r"cannot bind to 192.0.2.1"):
        opened()


@pytest.mark.parametrize("interface", ["192.0.2.1", "eth0 of another machine"])
def test_an_interface_that_is_not_there_is_an_error(domain: int, interface: str) -> None:
    with pytest.raises(TransportError, match="is not the address of an interface with multicast"):
        ParticipantSockets(domain, is_local=False, interfaces=[interface])


def test_what_cannot_be_sent_is_lost(domain: int, opened: Opened) -> None:
    sockets = opened()
    sockets.send(b"x", ("192.0.2.1", 9))  # another network, from a loopback address
    sockets.send(b"x", ("239.255.0.1", multicast_port(domain)))  # no interface
    sockets.send(b"x", ("fd00::1", 9))  # no socket of this version
    blocked: Any = BlockedSocket()
    sockets._by_version[4] = [blocked]
    with pytest.raises(BlockingIOError):
        sockets.send(b"x", ("127.0.0.1", 9))
    assert sockets.sender is blocked  # it is waited for


class Ipv6Socket:
    """A socket of IPv6 on a machine with three interfaces, the first of which has no multicast. The
    others have the addresses `fd00::2` and `fd00::3`.
    """

    made: ClassVar[list[Ipv6Socket]] = []

    def __init__(self, family: int, kind: int) -> None:
        assert (family, kind) == (socket.AF_INET6, socket.SOCK_DGRAM)
        self.options: dict[tuple[int, int], list[Any]] = {}
        self.bound: Any = None
        self.sent: list[Any] = []
        self.made.append(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def setblocking(self, is_blocking: bool) -> None:
        assert not is_blocking

    def setsockopt(self, level: int, option: int, value: Any) -> None:
        self.options.setdefault((level, option), []).append(value)

    def connect(self, address: object) -> None:
        if self.of_ipv6(socket.IPV6_MULTICAST_IF) == [1]:
            raise OSError(errno.ENETUNREACH, "no multicast")

    def getsockname(self) -> Any:
        return f"fd00::{self.of_ipv6(socket.IPV6_MULTICAST_IF)[0]}", 1, 0, 0

    def bind(self, address: object) -> None:
        self.bound = address

    def sendto(self, datagram: bytes, address: object) -> None:
        self.sent.append(address)

    def of_ipv6(self, option: int) -> list[Any]:
        return self.options.get((socket.IPPROTO_IPV6, option), [])


@pytest.fixture
def ipv6_sockets(monkeypatch: pytest.MonkeyPatch) -> list[Ipv6Socket]:
    monkeypatch.setattr(Ipv6Socket, "made", [])
    monkeypatch.setattr(socket, "socket", Ipv6Socket)
    names = [(1, "lo"), (2, "eth0"), (3, "eth1")]
    monkeypatch.setattr(socket, "if_nameindex", lambda: names)
    return Ipv6Socket.made


def test_over_ipv6_the_groups_of_both_middlewares_are_joined_at_the_interface_of_the_address(
    ipv6_sockets: list[Ipv6Socket],
) -> None:
    sockets = ParticipantSockets(7, is_local=False, interfaces=["fd00::3"], ip_versions=[6])
    assert all(each.of_ipv6(socket.IPV6_V6ONLY) == [1] for each in ipv6_sockets)
    by_host = {each.bound: each for each in ipv6_sockets}
    receiver, sender = by_host["::", multicast_port(7)], by_host["fd00::3", 0]
    packed = [socket.inet_pton(socket.AF_INET6, group) for group in GROUPS[6]]
    joined = receiver.of_ipv6(socket.IPV6_JOIN_GROUP)
    assert joined == [group + struct.pack("@I", 3) for group in packed]
    assert sender.of_ipv6(socket.IPV6_MULTICAST_IF) == [3]
    assert sender.of_ipv6(socket.IPV6_MULTICAST_HOPS) == [1]
    for group in GROUPS[6]:
        sockets.send(b"x", (group, multicast_port(7)))
    assert sender.sent == [(group, multicast_port(7)) for group in GROUPS[6]]
    sockets.send(b"x", ("fd00::9", 7410))
    assert by_host["::", discovery_port(7, 0)].sent == [("fd00::9", 7410)]
    sockets.close()


@pytest.mark.usefixtures("ipv6_sockets")
def test_an_address_of_ipv6_that_no_interface_has_is_an_error() -> None:
    with pytest.raises(TransportError, match=r"'fd00::9' is not the address of an interface with"):
        ParticipantSockets(7, is_local=False, interfaces=["fd00::9"], ip_versions=[6])


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
    assert default_interface(6) == "::1"
