"""The connections of a server for agents, which uvicorn does not limit: all of them, and those of
one address.

A connection that waits for a request makes room for a new one, as at the other doors, and one that
does not send its first request in time is closed.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # uvicorn runs on asyncio only
from functools import partial
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import LEAVE
from fibaction.wire.server.addresses import Addresses, Candidate
from fibaction.wire.settings import Limits
from fibaction.wire.wire_server import too_many

logger = clean_logger("fibaction.agents")


class ConnectionPlaces:
    """The places of a server for its connections."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._addresses = Addresses(limits.per_address)
        self._taken: dict[LimitedConnection, str] = {}

    def take(self, connection: LimitedConnection, peer: str) -> str:
        """Take a place for a connection; return the reason if there is none, or an empty text."""
        address, addresses = self._addresses.enter(peer), self._addresses
        reason, most = "", self.limits.connections
        if addresses.has_too_many(address) and not addresses.make_room(self._idle(), address):
            reason = too_many(address, addresses.most)
        elif len(self._taken) >= most and not addresses.make_room(self._idle()):
            reason = f"the server is full: it has {most} connections"
        if reason:
            addresses.leave(address)
        else:
            self._taken[connection] = address
        return reason

    def leave(self, connection: LimitedConnection) -> None:
        """Give up the place of a connection, if it has one."""
        address = self._taken.pop(connection, None)
        if address is not None:
            self._addresses.leave(address)

    def _idle(self) -> list[Candidate]:
        """Return the connections that wait for a request, those without any request first."""
        idle = [(one, address) for one, address in self._taken.items() if one.is_idle]
        idle.sort(key=lambda pair: pair[0].has_asked)
        return [Candidate(address, partial(self._end, one)) for one, address in idle]

    def _end(self, connection: LimitedConnection) -> None:
        self.leave(connection)
        connection.transport.close()


class LimitedConnection(H11Protocol):
    """A connection of uvicorn that has one of the places of its server."""

    def __init__(self, places: ConnectionPlaces, **uvicorns: Any) -> None:
        super().__init__(**uvicorns)
        self._places = places
        self._is_rejected = False
        self._timer: asyncio.TimerHandle

    @property
    def has_asked(self) -> bool:
        """True if it has sent the head of a request."""
        return bool(self.cycle)

    @property
    def is_idle(self) -> bool:
        """True if no request is being answered."""
        return not self.has_asked or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's
        super().connection_made(transport)
        host, port = self.client or ("a client", 0)
        reason = self._places.take(self, f"{host}:{port}")
        if reason:
            logger.warning("%s:%d is rejected: %s", host, port, reason, extra={"kind": 503})
            self._is_rejected = True
            transport.write(_answer(reason))
            # What it has sent is read meanwhile: otherwise it could lose the answer.
            self._timer = self.loop.call_later(LEAVE, transport.close)
        else:
            seconds = self._places.limits.handshake
            self._timer = self.loop.call_later(seconds, self._close_silent)

    def _close_silent(self) -> None:
        if not self.has_asked:
            self.transport.close()

    def data_received(self, data: bytes) -> None:
        if not self._is_rejected:
            super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._places.leave(self)
        self._timer.cancel()
        super().connection_lost(exc)


def _answer(reason: str) -> bytes:
    """Return the answer to a connection that has no place."""
    body = f"{reason}\n".encode()
    head = (
        "HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nRetry-After: 1\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body
