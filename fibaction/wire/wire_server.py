"""`WireServer`: all connections of one served transport, of any and of one address."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, suppress
from functools import lru_cache, partial
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple

import anyio
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Endpoint
from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.event_loop import Background
from fibaction.wire.channel import Line
from fibaction.wire.frames import FIRST_FRAME, FrameMemory, FrameReader
from fibaction.wire.link import Link, close_line, naming
from fibaction.wire.messages import Goodbye, Why, encode
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.session import Session
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import (
    AuthenticationFailed,
    ConnectionLost,
    LimitReached,
    ProtocolError,
)

SITE = 64
"""Bits of an IPv6 address that name a site: a host with one address there has all of them."""


class Candidate(NamedTuple):
    """A connection that may be ended for a newcomer."""

    address: str
    """Its address; empty if it has none."""
    end: Callable[[], None]
    """Ends it."""


class Addresses:
    """The connections of each address, and which connection makes room for a newcomer.

    A server that is full ends a connection for each newcomer, of those that say nothing, do nothing
    or do not read: of the address that has the most connections, since that is where a flood comes
    from. So the clients of other addresses get in during a flood. Clients behind one proxy have one
    address, and share this fate, but are not kept out: what is ended has nothing to lose.
    """

    def __init__(self, most: int | None) -> None:
        """Let each address have so many connections; None for any number."""
        self.most = most
        """The most connections of one address; None for any number."""
        self._counts: Counter[str] = Counter()

    def enter(self, peer: str) -> str:
        """Count one more connection of a peer, and return its address."""
        address = address_of(peer)
        self._counts[address] += 1
        return address

    def leave(self, address: str) -> None:
        """Count one connection less."""
        self._counts[address] -= 1
        if not self._counts[address]:
            del self._counts[address]

    def has_too_many(self, address: str) -> bool:
        """Return whether an address has more connections than it may have."""
        return self.most is not None and bool(address) and self._counts[address] > self.most

    def make_room(self, candidates: Iterable[Candidate], address: str = "") -> bool:
        """End the first candidate of the address that has the most connections, or of the given
        one; return whether there was one.
        """
        chosen = max(
            (one for one in candidates if address in ("", one.address)),
            key=lambda one: self._counts[one.address],
            default=None,
        )
        if chosen is not None:
            chosen.end()
        return chosen is not None


@lru_cache(maxsize=1000)
def address_of(peer: str) -> str:
    """Return what is counted of a peer such as `127.0.0.1:51234`: its address, of an IPv6 address
    the site; empty if it has none.
    """
    try:
        address = ip_address(peer.rpartition(":")[0])
    except ValueError:  # a local process, for example
        return ""
    if not isinstance(address, IPv6Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return f"{IPv6Address(int(address) >> SITE << SITE)}/{SITE}"


LEAVE_TIMEOUT = 1.0
"""Seconds that a closing server gives its clients to take the last messages."""

logger = clean_logger("fibaction.wire")


class ConnectionCounts:
    """The connections of clients, and what was wrong with them."""

    def __init__(self) -> None:
        self.open = 0
        """Connections that are open now."""
        self.errors: Counter[str] = Counter()
        """Connections that the server has ended because of an error, by the name of its class."""


CONNECTIONS = ConnectionCounts()
"""The counts of this process."""


class WireServer:
    """Serves endpoints to every client that connects, within the limits."""

    def __init__(
        self, tasks: TaskGroup, endpoints: Mapping[str, Endpoint], settings: WireSettings
    ) -> None:
        self.tasks = tasks
        """The task group of the connections."""
        self.memory = ByteBudget(settings.limits.total_memory)
        """The bytes that all connections hold together, see `Limits.total_memory`."""
        self.frames = FrameMemory(self.memory)
        """The part of these bytes that is large messages which are being read or written."""
        self.turn = anyio.Lock()
        """The turn of the connections that have much to handle."""
        self.endpoints = endpoints
        """The endpoints that are served, by the names of their actions."""
        self.settings = settings
        """The settings of the serving half."""
        self.addresses = Addresses(settings.limits.per_address)
        """The connections of each address."""
        self._owners = Owners(
            tasks, grace=settings.grace, then=settings.orphans, limit=settings.limits.lost
        )
        self._sessions: dict[Session, str] = {}  # with their addresses, in the order of arrival
        self._unknown: dict[Session, float] = {}  # have not said hello; the end of their time
        self._has_unknown = Notifier()
        self._latest: dict[bytes, Session] = {}  # of each client with a session

    def new_reader(self) -> FrameReader:
        """Return the reader of a new line, for a transport that makes frames of bytes.

        It knows the limits of the server. The line closes it when the line itself is closed.
        """
        limit = self.settings.limits.frame
        return FrameReader(limit, first=FIRST_FRAME, memory=self.frames)

    def start(self, line: Line) -> None:
        """Serve one client in a task of its own."""
        self.tasks.start_soon(self.serve, line)

    async def serve(self, line: Line) -> None:
        """Serve one client until its connection ends. An error of any kind ends this one only."""
        line.share_turns(self.turn)
        address = self.addresses.enter(line.peer)
        try:
            await self._serve(line, address)
        except Exception as exc:
            # A bug of fibaction, or of the handler of a log.
            with suppress(Exception):
                logger.error("%s: the connection failed", line.peer, exc_info=exc)
        finally:
            self.addresses.leave(address)
            await close_line(line)

    async def _serve(self, line: Line, address: str) -> None:
        heartbeat, limits = self.settings.heartbeat, self.settings.limits
        if reason := self._why_not(address):
            logger.warning("%s is rejected: %s", line.peer, reason)
            CONNECTIONS.errors[LimitReached.__name__] += 1
            link = Link(line, heartbeat)
            await link.say_last(encode(Goodbye(reason, Why.LIMIT)))
            return
        link = Link(line, heartbeat, limits.queue, self.frames)
        session = Session(
            link,
            self.endpoints,
            self.settings,
            self._owners,
            self.memory,
            self._clients_of,
            self._entered,
        )
        self._sessions[session] = address
        self._unknown[session] = anyio.current_time() + limits.handshake
        self._has_unknown.notify()
        CONNECTIONS.open += 1
        try:
            error = await session.run()
        finally:
            CONNECTIONS.open -= 1
            self._forget(session)
        wrong = isinstance(error, ProtocolError | AuthenticationFailed | LimitReached)
        if wrong:
            CONNECTIONS.errors[type(error).__name__] += 1
        level, kind = logging.WARNING if wrong else logging.INFO, type(error).__name__
        logger.log(level, "%s", naming(line.peer, error), extra={"kind": kind})

    def _forget(self, session: Session) -> None:
        self._sessions.pop(session, None)
        self._unknown.pop(session, None)
        if self._latest.get(session.client.session) is session:
            del self._latest[session.client.session]

    def _why_not(self, address: str) -> str:
        """Return the reason for which a client of that address is not served; empty if it is.

        Connections that say nothing make room, so they keep no client out.
        """
        addresses, limits = self.addresses, self.settings.limits
        if addresses.has_too_many(address) and not addresses.make_room(self.silent(), address):
            return too_many(address, addresses.most)
        if len(self._sessions) >= limits.connections and not addresses.make_room(self.silent()):
            return f"the server is full: it has {limits.connections} connections"
        return ""

    def silent(self) -> Iterator[Candidate]:
        """Yield the connections that have not said hello, the oldest first."""
        for session in self._unknown:
            yield Candidate(self._sessions[session], partial(self._end_silent, session))

    def _end_silent(self, session: Session) -> None:
        self._forget(session)
        session.end(LimitReached("another client needs its place, and it has not said hello"))

    async def expect_hellos(self) -> None:
        """End each connection that does not say hello in time."""
        handshake = self.settings.limits.handshake
        while True:
            while not self._unknown:
                await self._has_unknown.wait()
            session, ends = next(iter(self._unknown.items()))
            await anyio.sleep_until(ends)
            if self._unknown.pop(session, None) is not None:
                # The line may have been held up, so the client may try again.
                session.end(LimitReached(f"it has not said hello within {handshake:g} s"))
            del session  # the next one may come late, and what this one holds is to be freed

    def _entered(self, session: Session) -> None:
        """Note that a client was let in; end its earlier connection."""
        self._unknown.pop(session, None)
        if key := session.client.session:
            earlier, self._latest[key] = self._latest.get(key), session
            if earlier is not None:
                earlier.end(ConnectionLost("its client has a newer connection"))

    def _clients_of(self, action: str) -> list[str]:
        clients = (session.client for session in self._sessions)
        return sorted(client.name for client in clients if action in client.actions)

    async def drain(self) -> None:
        """Tell every client how its goals have ended, and say goodbye."""
        try:
            with anyio.move_on_after(LEAVE_TIMEOUT, shield=True):
                async with anyio.create_task_group() as tasks:
                    for session in tuple(self._sessions):
                        tasks.start_soon(_drain, session)
        finally:  # asyncio can cancel the task itself, which no scope shields
            await self._owners.aclose()


async def _drain(session: Session) -> None:
    try:
        await session.drain()
    except Exception as exc:  # of a stream, which may be foreign code; others are drained, too
        logger.error("%s: its goals could not be told", session.client.name, exc_info=exc)


def too_many(address: str, most: int | None) -> str:
    """Return the reason for which one more client of an address is not served."""
    return f"its address {address} has {most} connections, which are the most"


@asynccontextmanager
async def open_server(
    endpoints: Mapping[str, Endpoint], settings: WireSettings
) -> AsyncGenerator[WireServer, None]:
    """Open a server of these endpoints; at the end of the block its connections are closed."""
    async with Background() as tasks:
        server = WireServer(tasks, endpoints, settings)
        tasks.start_soon(server.expect_hellos)
        try:
            yield server
        finally:
            await server.drain()
