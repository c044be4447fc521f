"""`connect`: from a URL to an open connection, and to clients over it."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, overload

from fibaction.abc import Connection, Endpoint, Transport
from fibaction.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.client import ActionClient
from fibaction.goals import ActionPeers
from fibaction.urls import transport_for


class ClientConnection(Connection):
    """An open connection, as `connect` gives it: a client for each action that is wanted."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def client(
        self, action: Action[GoalT, FeedbackT, ResultT]
    ) -> ActionClient[GoalT, FeedbackT, ResultT]:
        """A client of one action over this connection."""
        return ActionClient(self.endpoint(action), action)

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """The endpoint of an action, for instance to serve it somewhere else."""
        return self._connection.endpoint(action)

    async def actions(self) -> list[ActionInfo]:
        """What can be reached now: see `Connection.actions`."""
        return await self._connection.actions()

    async def peers(self, action: str) -> ActionPeers:
        """Who serves an action and who uses it: see `Connection.peers`."""
        return await self._connection.peers(action)


@overload
def connect(
    where: str | Transport, **settings: Any
) -> AbstractAsyncContextManager[ClientConnection]: ...


@overload
def connect(
    where: str | Transport, action: Action[GoalT, FeedbackT, ResultT], **settings: Any
) -> AbstractAsyncContextManager[ActionClient[GoalT, FeedbackT, ResultT]]: ...


def connect(
    where: str | Transport, action: Action[Any, Any, Any] | None = None, **settings: Any
) -> AbstractAsyncContextManager[Any]:
    """Connect to a URL, or by a transport, for as long as the block lasts.

    With an action it gives an `ActionClient`, without one a `ClientConnection`. `settings` are
    those of the transport's constructor, for instance `reconnect=False`.

    Raises:
        TransportError: The URL cannot be used; the text says why.
        TypeError: The transport has no such setting, or `where` is no address, or `action` none.
        ServerNotFound: There is nobody, and the transport can tell at once.
        AuthenticationFailed: There is, but it does not let this client in.
    """
    transport = transport_for(where, **settings)
    _check_is_action(action)
    return _connected(transport) if action is None else _connected_client(transport, action)


def _check_is_action(action: object) -> None:
    if not isinstance(action, Action | None):
        raise TypeError(
            f"connect() takes an address, and then an Action or nothing, and not {action!r}"
        )


@asynccontextmanager
async def _connected(transport: Transport) -> AsyncGenerator[ClientConnection, None]:
    async with transport.connect() as connection:
        yield ClientConnection(connection)


@asynccontextmanager
async def _connected_client(
    transport: Transport, action: Action[GoalT, FeedbackT, ResultT]
) -> AsyncGenerator[ActionClient[GoalT, FeedbackT, ResultT], None]:
    async with _connected(transport) as connection:
        yield connection.client(action)
