"""The border between gateways and the transports that serve them.

Any transport can serve the endpoints of another one: `serve(connection.endpoint(info), url)`. A
`GatewayTransport` serves more than that: a group of servers whose actions come and go, with their
names, and with the reasons why some of them cannot be reached.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Iterable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, NamedTuple

import anyio

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import TransportError


class SeenServer(NamedTuple):
    """A server, with the actions that it served when it was last asked."""

    connection: Connection
    actions: tuple[ActionInfo, ...]


class ServerGroup:
    """Servers by their names, with what each of them serves now."""

    def __init__(self) -> None:
        self.news = Notifier()
        """Notified when an action has come or gone, or a server has another connection."""
        self.servers: dict[str, SeenServer] = {}
        """The servers that have answered. One that answers no more stays as it was."""
        self.problems: dict[str, str] = {}
        """For each server, the reason why it cannot be reached now; empty if it can. The name of a
        single server may be empty."""


class Gateway(ABC):
    """The serving end of a gateway, while it serves."""

    @property
    @abstractmethod
    def url(self) -> str:
        """The URL under which clients find the actions."""

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """The names that clients can use now; a transport may have its own names for actions."""


class GatewayTransport(Transport):
    """A transport that can serve a group of servers, as their actions come and go."""

    @abstractmethod
    def serve_group(self, group: ServerGroup) -> AbstractAsyncContextManager[Gateway]:
        """Serve the actions of a group for as long as the block lasts.

        Raises:
            TransportError: The address cannot be used.
        """

    async def wait_end(self) -> None:
        """Wait until no client can come any more. Most transports wait for as long as they serve;
        one that has a single client waits for its end.
        """
        await anyio.sleep_forever()

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`."""
        async with self.serve_group(group_of(endpoints)) as gateway:
            yield gateway.url


def group_of(endpoints: Iterable[Endpoint]) -> ServerGroup:
    """Return the group of a single server, without a name, that serves these endpoints.

    Raises:
        TransportError: Two of them serve actions of the same name.
    """
    connection = _FixedConnection()
    for endpoint in endpoints:
        connection.add(endpoint)
    group = ServerGroup()
    group.servers[""] = SeenServer(connection, tuple(connection.infos))
    group.problems[""] = ""
    return group


class _FixedConnection(Connection):
    """A connection to endpoints of this process."""

    def __init__(self) -> None:
        self._endpoints: dict[str, Endpoint] = {}

    def add(self, endpoint: Endpoint) -> None:
        """Add an endpoint.

        Raises:
            TransportError: There is one for an action of that name.
        """
        if endpoint.info.name in self._endpoints:
            raise TransportError("two of the endpoints serve actions of the same name")
        self._endpoints[endpoint.info.name] = endpoint

    @property
    def infos(self) -> list[ActionInfo]:
        """The descriptions of the actions."""
        return [endpoint.info for endpoint in self._endpoints.values()]

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return self._endpoints[action.name]

    async def actions(self) -> list[ActionInfo]:
        return self.infos
