"""All connections of one served transport: takes them in, within the limits, and lets them go."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Mapping
from contextlib import asynccontextmanager
from hmac import compare_digest

import anyio
from anyio.abc import TaskGroup

from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.exceptions import AuthenticationFailed, LimitReached, ProtocolError
from fibaction.wire.channel import Line
from fibaction.wire.link import Link, naming
from fibaction.wire.messages import Goodbye, Why, encode
from fibaction.wire.ownership import Owners
from fibaction.wire.session import Session
from fibaction.wire.settings import ServerSettings

LEAVE_TIMEOUT = 1.0
"""Seconds that a server which closes gives its clients to take what there still is to say."""

logger = logging.getLogger("fibaction.wire")


class WireServer:
    """Serves endpoints to whoever connects."""

    def __init__(
        self, tasks: TaskGroup, endpoints: Mapping[str, Endpoint], terms: ServerSettings
    ) -> None:
        self.tasks = tasks
        """The task group of the connections."""
        self._endpoints = endpoints
        self._terms = terms
        self._orphans = Owners(tasks, grace=terms.grace, then=terms.orphans)
        self._sessions: dict[Session, None] = {}  # in the order of their coming

    def start(self, line: Line) -> None:
        """Serve one client in a task of its own."""
        self.tasks.start_soon(self.serve, line)

    async def serve(self, line: Line) -> None:
        """Serve one client until its connection ends."""
        try:
            await self._serve(line)
        except Exception as exc:
            # A fault of this package: it is one client's affair, and not the end of all others.
            logger.error("%s: the connection failed", line.peer, exc_info=exc)
        finally:
            await line.aclose()

    async def _serve(self, line: Line) -> None:
        heartbeat, limits = self._terms.heartbeat, self._terms.limits
        if len(self._sessions) >= limits.connections:
            reason = f"the server is full: it has {limits.connections} connections"
            logger.warning("%s is turned away: %s", line.peer, reason)
            link = Link(line, heartbeat)
            await link.say_last(encode(Goodbye(reason, Why.LIMIT)))
            return
        link = Link(line, heartbeat, limits.queue)
        session = Session(
            link, self._endpoints, self._terms, self._orphans, self._clients_of, self._supersede
        )
        self._sessions[session] = None
        try:
            error = await session.run()
        finally:
            del self._sessions[session]
        wrong = isinstance(error, ProtocolError | AuthenticationFailed | LimitReached)
        logger.log(logging.WARNING if wrong else logging.INFO, "%s", naming(line.peer, error))

    def _supersede(self, client: bytes) -> None:
        for session in tuple(self._sessions):
            if session.session and compare_digest(session.session, client):
                session.end()

    def _clients_of(self, action: str) -> list[str]:
        return sorted(session.client for session in self._sessions if action in session.actions)

    async def drain(self) -> None:
        """Let every client know how its goals have ended, and say goodbye."""
        try:
            with anyio.move_on_after(LEAVE_TIMEOUT, shield=True):
                async with anyio.create_task_group() as tasks:
                    for session in tuple(self._sessions):
                        tasks.start_soon(session.drain)
        finally:  # asyncio can cancel the task itself, which no scope shields
            self._orphans.close()


@asynccontextmanager
async def open_server(
    endpoints: Mapping[str, Endpoint], settings: ServerSettings
) -> AsyncGenerator[WireServer, None]:
    """Open a server of these endpoints; at the end of the block its connections are closed."""
    async with Background() as tasks:
        server = WireServer(tasks, endpoints, settings)
        try:
            yield server
        finally:
            await server.drain()
