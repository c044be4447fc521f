"""`serve` and `connect`: serve actions at a URL, and open connections to it."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

import anyio
from anyio import create_task_group

from fibaction.abc import Connection, Endpoint, Startable, Transport
from fibaction.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.client import ActionClient
from fibaction.goals import ActionPeers
from fibaction.urls import transport_for, without_settings
from fibaction.wire.settings import ClientKeywords, ServerKeywords

if TYPE_CHECKING:
    from ssl import SSLContext

    from fibaction.wire.tls_files import TlsFiles


class _RosKeywords(TypedDict, total=False):
    namespace: str
    domain_id: int | None
    arguments: Sequence[str] | None
    node: Any
    feedback_depth: int
    discovery_timeout: float


class ConnectKeywords(ClientKeywords, _RosKeywords, total=False):
    """The settings that `connect` passes on to the transport of a URL."""

    tls: TlsFiles | SSLContext | None


class ServeKeywords(ServerKeywords, _RosKeywords, total=False):
    """The settings that `serve` passes on to the transports of URLs."""

    tls: TlsFiles | SSLContext | None
    insecure: bool


class ClientConnection(Connection):
    """An open connection, as `connect` returns it: the source of clients of all its actions."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._clients: list[ActionClient[Any, Any, Any]] = []

    def client(
        self, action: Action[GoalT, FeedbackT, ResultT]
    ) -> ActionClient[GoalT, FeedbackT, ResultT]:
        """Return a client of one action over this connection."""
        client = ActionClient(self.endpoint(action), action)
        self._clients.append(client)
        return client

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """Return the endpoint of an action, for example to serve it at another address."""
        return self._connection.endpoint(action)

    async def actions(self) -> list[ActionInfo]:
        """Return the actions that can be reached now: see `Connection.actions`."""
        return await self._connection.actions()

    async def leave(self) -> None:
        """Cancel the goals of `call`, and of blocks of `send_goal`, that have not ended.

        The end of the block of `connect` calls this, before it closes the connection.
        """
        # Shielded: the goals must also be canceled if the block itself was canceled.
        with anyio.CancelScope(shield=True):
            async with create_task_group() as tasks:
                for client in self._clients:
                    tasks.start_soon(client.leave)

    async def peers(self, action: str) -> ActionPeers:
        """Return the servers and the clients of an action: see `Connection.peers`."""
        return await self._connection.peers(action)


@overload
def connect(
    where: str | Transport, **settings: Unpack[ConnectKeywords]
) -> AbstractAsyncContextManager[ClientConnection]: ...


@overload
def connect(
    where: str | Transport,
    action: Action[GoalT, FeedbackT, ResultT],
    **settings: Unpack[ConnectKeywords],
) -> AbstractAsyncContextManager[ActionClient[GoalT, FeedbackT, ResultT]]: ...


def connect(
    where: str | Transport,
    action: Action[Any, Any, Any] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> AbstractAsyncContextManager[Any]:
    """Connect to a URL, or by a transport, for as long as the block lasts.

    With an action, the block gets an `ActionClient`, without one a `ClientConnection`. `settings`
    are those of the transport's constructor, for example `reconnect=False`.

    Raises:
        TransportError: The URL cannot be used; the text says why.
        TypeError: The transport does not have such a setting, `where` is not an address, or
            `action` is not an `Action`.
        ServerNotFound: The server is not found, and the transport can tell at once.
        AuthenticationFailed: The server rejects this client.
    """
    transport = transport_for(where, **settings)
    check_is_action(action)
    return _connected(transport) if action is None else _connected_client(transport, action)


def check_is_action(action: object) -> None:
    """Raise TypeError for a second argument of `connect` that is not an action."""
    if not isinstance(action, Action | None):
        raise TypeError(
            f"connect() takes an address and, optionally, an Action; {action!r} is not an Action"
        )


@asynccontextmanager
async def _connected(transport: Transport) -> AsyncGenerator[ClientConnection, None]:
    async with transport.connect() as opened:
        connection = ClientConnection(opened)
        try:
            yield connection
        finally:
            await connection.leave()


@asynccontextmanager
async def _connected_client(
    transport: Transport, action: Action[GoalT, FeedbackT, ResultT]
) -> AsyncGenerator[ActionClient[GoalT, FeedbackT, ResultT], None]:
    async with _connected(transport) as connection:
        yield connection.client(action)


@asynccontextmanager
async def serve(
    endpoints: Endpoint | Iterable[Endpoint],
    *where: str | Transport,
    **settings: Unpack[ServeKeywords],
) -> AsyncGenerator[tuple[str, ...], None]:
    """Serve one endpoint or several, at one address or several, for as long as the block lasts.

    An address is a URL or a transport. `settings` are those of the constructors of the URLs'
    transports, for example `tokens={...}`. The block gets the URLs under which clients find the
    endpoints. Servers that are not running are started, and stopped at the end, while their clients
    can still be answered.

    Raises:
        TransportError: An address cannot be used.
        TypeError: A transport does not have such a setting, an argument is not a server or not an
            address, or the address is missing.
        RuntimeError: A server has been stopped; each runs once.
    """
    chosen = _chosen(endpoints)
    if not where:
        raise TypeError(
            "serve() needs at least one address: a URL such as tcp://127.0.0.1:7400, or a"
            " transport; to use a server without an address, enter it with `async with`, and give"
            " it to an ActionClient"
        )
    transports = [transport_for(one, **settings) for one in where]
    started: list[Startable] = []
    async with AsyncExitStack() as stack:
        for one in chosen:
            if isinstance(one, Startable) and not one.is_running:
                await stack.enter_async_context(one)
                started.append(one)
        urls = [await stack.enter_async_context(one.serve(*chosen)) for one in transports]
        stack.push_async_callback(_stop, started)
        yield tuple(urls)


def _chosen(endpoints: Endpoint | Iterable[Endpoint]) -> tuple[Endpoint, ...]:
    given: Iterable[object] = (endpoints,)
    if isinstance(endpoints, Iterable) and not isinstance(endpoints, Endpoint | str):
        given = endpoints
    chosen: list[Endpoint] = []
    for one in given:
        if not isinstance(one, Endpoint):
            # If the arguments are swapped, it is a URL, which may contain a token.
            shown = without_settings(one) if isinstance(one, str) else one
            raise TypeError(
                f"serve() takes servers, such as ActionServer(action, executor), and then"
                f" addresses; {shown!r} is not a server"
            )
        chosen.append(one)
    return tuple(chosen)


async def _stop(servers: Iterable[Startable]) -> None:
    async with create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(server.stop)
