"""`FollowedServers`: the servers of a gateway, which come and go.

Theory of operation
-------------------

A task for each server connects, and looks for actions again and again. While the server does not
answer, its actions stay as they were known: a client that sees them flicker is not helped, and a
goal that is sent meanwhile gets the reason as its answer. When a connection is over, the task opens
another one, and the actions are those of the new connection from the next look on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Self

import anyio

from fibaction._api import ClientConnection, connect
from fibaction._runtime.log import clean_logger
from fibaction.border.abc import Transport
from fibaction.border.event_loop import Background
from fibaction.border.gateway import SeenServer, ServerGroup
from fibaction.border.urls import transport_for
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    ProtocolError,
    ServerNotFound,
)

PERIOD = 1.0
"""Seconds between two looks for actions."""
LOOK_TIMEOUT = 5.0
"""Seconds that a server has to answer a look."""
NEXT_CONNECTION = 2.0
"""Seconds between two attempts to connect."""
FIRST_LOOK = 3.0
"""Seconds that the start waits for the actions of all servers."""

_OVER = (AuthenticationFailed, ConnectionLost, InvalidURL, ProtocolError, ServerNotFound)
"""Errors after which a connection, and all that was open over it, is of no more use."""

logger = clean_logger("fibaction.border.gateway")


def check_servers(servers: Mapping[str, str | Transport]) -> None:
    """Check the names and the addresses of servers. The name of a single one may be empty.

    Raises:
        TransportError: An address cannot be used; the text says why.
        ValueError: A name is not made of letters, digits and `_`, or there is no server.
    """
    if not servers:
        raise ValueError("a gateway needs at least one server")
    for name, where in servers.items():
        if not re.fullmatch(r"\w+", name, re.ASCII) and (name or len(servers) > 1):
            raise ValueError(f"the name of a server has letters, digits and _, not {name!r}")
        transport_for(where)


class FollowedServers(ServerGroup):
    """Servers by their names, which are followed while the block lasts.

    For example, with any `GatewayTransport`:

        servers = {"left": "tcp://left:7400", "right": "tcp://right:7400"}
        async with FollowedServers(servers) as group, transport.serve_group(group):
            await anyio.sleep_forever()
    """

    def __init__(self, servers: Mapping[str, str | Transport]) -> None:
        """Map the names of the servers to their addresses; the name of a single one may be empty.

        Raises:
            TransportError: An address cannot be used; the text says why.
            ValueError: A name is not made of letters, digits and `_`, or there is no server.
        """
        super().__init__()
        check_servers(servers)
        self.problems = dict.fromkeys(servers, "it has not answered yet")
        self._addresses = dict(servers)
        self._looked = {name: anyio.Event() for name in servers}
        self._block: AsyncExitStack

    async def __aenter__(self) -> Self:
        """Begin to follow the servers, and wait until all have answered, though not for long."""
        async with AsyncExitStack() as stack:
            tasks = await stack.enter_async_context(Background())
            for server, where in self._addresses.items():
                tasks.start_soon(self._follow, server, where)
            with anyio.move_on_after(FIRST_LOOK):
                for looked in self._looked.values():
                    await looked.wait()
            self._block = stack.pop_all()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the servers; goals that run there continue."""
        await self._block.__aexit__(exc_type, exc, traceback)

    async def _follow(self, server: str, where: str | Transport) -> None:
        while True:
            try:
                async with connect(where) as connection:
                    await self._look(server, connection)
            except ActionError as exc:
                self._note(server, str(exc))
            await anyio.sleep(NEXT_CONNECTION)

    async def _look(self, server: str, connection: ClientConnection) -> None:
        """Look for actions that have come or gone, until the connection is over.

        Raises:
            ActionError: It is.
        """
        while True:
            problem = "it does not answer"
            with anyio.move_on_after(LOOK_TIMEOUT):
                try:
                    self._take(server, SeenServer(connection, tuple(await connection.actions())))
                    problem = ""
                except _OVER:
                    raise
                except ActionError as exc:
                    problem = str(exc)
            self._note(server, problem)
            await anyio.sleep(PERIOD)

    def _take(self, server: str, seen: SeenServer) -> None:
        before = self.servers.get(server)
        # Replaced in any case: who could not use an action may try it again after each look.
        self.servers[server] = seen
        if before != seen:
            self.news.notify()

    def _note(self, server: str, problem: str) -> None:
        if problem != self.problems[server] and (problem or self._looked[server].is_set()):
            name = f"server {server}" if server else "the server"
            logger.warning("%s: %s", name, problem or "it answers again")
        self.problems[server] = problem
        self._looked[server].set()
