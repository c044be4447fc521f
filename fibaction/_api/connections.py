"""`connect`: open a connection to the actions at a URL."""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, Generator
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar, Unpack, cast, overload

import anyio

from fibaction._runtime.async_only import AsyncBlock
from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.urls import transport_for
from fibaction.border.watchers import GoalTracer
from fibaction.client.client import ActionClient
from fibaction.client.goal import Blocks, leave_blocks
from fibaction.client.kept_connection import KeptConnection, keep_open
from fibaction.types.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import Arguments, P
from fibaction.words.goals import ActionPeers, WorkerInfo

if TYPE_CHECKING:
    from fibaction.server.functions.function_action import FunctionAction
    from fibaction_transports.keywords import ConnectKeywords


class ClientConnection(Connection):
    """An open connection, as `connect` returns it: the source of clients of all its actions.

    For example:

        async with connect("tcp://127.0.0.1:7400") as connection:
            drive, look = connection.client(DRIVE), connection.client(LOOK)
    """

    def __init__(
        self, connection: Connection, tracing: GoalTracer | None = None, where: str = ""
    ) -> None:
        self._connection = connection
        self._tracing = tracing
        self._where = where
        self._blocks: Blocks = connection.blocks if isinstance(connection, KeptConnection) else {}

    @overload
    def client(
        self, action: FunctionAction[P, FeedbackT, ResultT, Any]
    ) -> ActionClient[Arguments[P], FeedbackT, ResultT]: ...
    @overload
    def client(
        self, action: Action[GoalT, FeedbackT, ResultT]
    ) -> ActionClient[GoalT, FeedbackT, ResultT]: ...
    def client(self, action: Action[Any, Any, Any]) -> ActionClient[Any, Any, Any]:
        """Return a client of one action over this connection."""
        return ActionClient(self.endpoint(action), action, self._blocks, tracing=self._tracing)

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
            await leave_blocks(self._blocks)

    # For type checkers, each name would be an attribute.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __getattr__(self, name: str) -> NoReturn:
            what = f"a connection has no attribute {name!r}"
            if not hasattr(ActionClient, name):
                raise AttributeError(what)
            raise AttributeError(
                f"{what}, which clients of one action have: write `connect(url, ACTION)`, or"
                f" `connection.client(ACTION).{name}`"
            )

    async def aclose(self) -> None:
        """Close a connection that `await connect(...)` has opened, from any task.

        Goals of `call`, and of blocks of `send_goal`, that have not ended are canceled first.
        Closing twice does nothing.

        Raises:
            RuntimeError: The connection was opened by `async with connect(...)`.
        """
        if not isinstance(self._connection, KeptConnection):
            raise RuntimeError(
                "the block of `async with connect(...)` closes this connection: aclose() is for"
                " `connection = await connect(...)`"
            )
        await self._connection.aclose()

    async def peers(self, action: str) -> ActionPeers:
        """Return the servers and the clients of an action: see `Connection.peers`."""
        return await self._connection.peers(action)

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        """Return the texts of an action's interface files: see `Connection.interface_texts`."""
        return await self._connection.interface_texts(action)

    async def nodes(self) -> set[str]:
        """Return the names of the other nodes: see `Connection.nodes`."""
        return await self._connection.nodes()

    @property
    def release(self) -> str:
        """The version of the server: see `Connection.release`."""
        return self._connection.release

    async def workers(self) -> list[WorkerInfo]:
        """Return the workers of the fleet: see `Connection.workers`."""
        return await self._connection.workers()

    def __repr__(self) -> str:
        return f"<ClientConnection to {self._where}>"


ConnectedT = TypeVar("ConnectedT", covariant=True)


class Connecting(AsyncBlock, AbstractAsyncContextManager[ConnectedT, None]):
    """A connection to be opened, by `async with` or `await`: see `connect`."""

    opened_by = "async with connect(...) as client:"

    def __init__(
        self,
        transport: Transport,
        action: Action[Any, Any, Any] | None,
        tracing: GoalTracer | None = None,
    ) -> None:
        self._transport = transport
        self._action = action
        self._tracing = tracing
        self._block: AsyncExitStack

    def __await__(self) -> Generator[Any, Any, ConnectedT]:
        return self._kept().__await__()

    async def __aenter__(self) -> ConnectedT:
        async with AsyncExitStack() as stack:
            connection = await stack.enter_async_context(_connected(self._transport, self._tracing))
            client = self._client_of(connection)  # not every connection can have every action
            self._block = stack.pop_all()
        return client

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self._block.__aexit__(exc_type, exc, traceback)

    async def _kept(self) -> ConnectedT:
        connection = await keep_open(self._transport)
        try:
            where = _name_of(self._transport)
            return self._client_of(ClientConnection(connection, self._tracing, where))
        except BaseException:
            await connection.aclose()
            raise

    def _client_of(self, connection: ClientConnection) -> ConnectedT:
        value = connection if self._action is None else connection.client(self._action)
        return cast("ConnectedT", value)

    # For type checkers, each name would be an attribute.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __getattr__(self, name: str) -> NoReturn:
            raise AttributeError(
                f"connect() has no attribute {name!r}, because it has not connected: write"
                f" `async with connect(...) as client`, or `client = await connect(...)`"
            )


@overload
def connect(
    where: str | Transport,
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Connecting[ClientConnection]: ...


@overload
def connect(
    where: str | Transport,
    action: FunctionAction[P, FeedbackT, ResultT, Any],
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Connecting[ActionClient[Arguments[P], FeedbackT, ResultT]]: ...


@overload
def connect(
    where: str | Transport,
    action: Action[GoalT, FeedbackT, ResultT],
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Connecting[ActionClient[GoalT, FeedbackT, ResultT]]: ...


def connect(
    where: str | Transport,
    action: Action[Any, Any, Any] | None = None,
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Connecting[Any]:
    """Connect to a URL, or by a transport.

        async with connect("tcp://127.0.0.1:7400", ACTION) as client:
            ...

    The connection is open for as long as the block lasts. Where a block is in the way, as in a
    notebook, write `client = await connect(...)`, and later, in any task, `await client.aclose()`.
    With an action, the value is an `ActionClient`, without one a `ClientConnection`. `settings` are
    those of the transport's constructor, for example `reconnect=False`. `tracing` makes a span for
    each goal that is sent: see `fibaction.observe.Tracing`.

    Raises:
        TransportError: The URL cannot be used; the text says why.
        TypeError: The transport does not have such a setting, `where` is not an address, or
            `action` is not an `Action`.
        ServerNotFound: The server is not found, and the transport can tell at once.
        AuthenticationFailed: The server rejects this client.
    """
    transport = transport_for(where, **settings)
    check_is_action(action, "connect")
    return Connecting(transport, action, tracing)


def check_is_action(action: object, caller: Literal["connect", "call"]) -> None:
    """Raise TypeError for a second argument of `connect` or `call` that is not an action."""
    if isinstance(action, Action) or (action is None and caller == "connect"):
        return
    takes = "an address and, optionally, an Action"
    if caller == "call":
        takes = "an address, an Action and its goal"
    hint = ""
    if inspect.isfunction(action):
        hint = f": make one of it with @action({action.__name__!r})"
    raise TypeError(f"{caller}() takes {takes}; {action!r} is not an Action{hint}")


@asynccontextmanager
async def _connected(
    transport: Transport, tracing: GoalTracer | None
) -> AsyncGenerator[ClientConnection, None]:
    async with transport.connect() as opened:
        connection = ClientConnection(opened, tracing, _name_of(transport))
        try:
            yield connection
        finally:
            await connection.leave()


def _name_of(transport: Transport) -> str:
    """Return the URL of a transport that has one, without its settings, or its class."""
    return getattr(transport, "url", type(transport).__name__)
