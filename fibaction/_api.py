"""`serve` and `connect`: from a URL to a server that can be reached, and to clients of it."""

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
    """An open connection, as `connect` gives it: a client for each action that is wanted."""

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
        """The endpoint of an action, for instance to serve it somewhere else."""
        return self._connection.endpoint(action)

    async def actions(self) -> list[ActionInfo]:
        """What can be reached now: see `Connection.actions`."""
        return await self._connection.actions()

    async def leave(self) -> None:
        """Cancel the goals of `call`, and of blocks of `send_goal`, that have not ended. Leaving
        the block of `connect` does so, before the connection is closed.
        """
        # Shielded: if the block was canceled, the goals must be canceled all the same.
        with anyio.CancelScope(shield=True):
            async with create_task_group() as tasks:
                for client in self._clients:
                    tasks.start_soon(client.leave)

    async def peers(self, action: str) -> ActionPeers:
        """Who serves an action and who uses it: see `Connection.peers`."""
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
    transports, for instance `tokens={...}`. Gives the URLs under which clients find them. Servers
    that are not running are started, and stopped at the end while their clients can still be
    answered.

    Raises:
        TransportError: An address cannot be used.
        TypeError: A transport has no such setting, what is given is no server, or no address, or
            there is no address at all.
        RuntimeError: A server has been stopped; each runs once.
    """
    chosen = _chosen(endpoints)
    if not where:
        raise TypeError(
            "serve() needs an address, or nobody could reach the server: a URL such as"
            " tcp://127.0.0.1:7400, or a transport; without one, enter the server itself, and give"
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
            # Where the arguments are swapped it is a URL, and that may have a token.
            shown = without_settings(one) if isinstance(one, str) else one
            raise TypeError(
                f"serve() takes servers, such as ActionServer(action, executor), and then where to"
                f" serve them, and {shown!r} is no server"
            )
        chosen.append(one)
    return tuple(chosen)


async def _stop(servers: Iterable[Startable]) -> None:
    async with create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(server.stop)
