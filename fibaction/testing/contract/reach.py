"""`Reach`: brings a server and its client together over the transport under test."""

from __future__ import annotations

import uuid
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any, Protocol, TypeAlias

import anyio

from fibaction import (
    ActionClient,
    ActionServer,
    ClientConnection,
    Endpoint,
    Transport,
    connect,
    serve,
)
from fibaction.types.action import FeedbackT, GoalT, ResultT

Servers: TypeAlias = tuple[Endpoint, ...]
NewAddress: TypeAlias = Callable[[], str | Transport]
"""Returns an address where no server is."""


class Way(Protocol):
    """A way to serve at an address, which gives the URL for clients."""

    def __call__(
        self, servers: Servers, address: str | Transport, **settings: Any
    ) -> AbstractAsyncContextManager[str]: ...


class Reach:
    """Brings a server and its client together on one of the ways."""

    def __init__(self, way: Way, address: NewAddress, *, patience: float = 30.0) -> None:
        self._way = way
        self.address = address
        self.patience = patience
        """Seconds after which a test that hangs fails."""

    @asynccontextmanager
    async def __call__(
        self, server: ActionServer[GoalT, FeedbackT, ResultT]
    ) -> AsyncGenerator[ActionClient[GoalT, FeedbackT, ResultT], None]:
        """Serve, and give a client. At the end, nothing may be left running."""
        async with self.connection(server) as connection:
            yield connection.client(server.action)

    @asynccontextmanager
    async def connection(self, *servers: Endpoint) -> AsyncGenerator[ClientConnection, None]:
        """Serve, and give a connection."""
        async with self.url(*servers) as url, connect(url) as connection:
            yield connection

    @asynccontextmanager
    async def two_clients(
        self, server: ActionServer[GoalT, FeedbackT, ResultT]
    ) -> AsyncGenerator[tuple[ActionClient[GoalT, FeedbackT, ResultT], ...], None]:
        """Serve, and give two clients, each with a connection of its own."""
        action = server.action
        async with (
            self.url(server) as url,
            connect(url, action) as one,
            connect(url, action) as other,
        ):
            yield one, other

    @asynccontextmanager
    async def named_clients(
        self, server: ActionServer[GoalT, FeedbackT, ResultT], *names: str
    ) -> AsyncGenerator[list[ActionClient[GoalT, FeedbackT, ResultT]], None]:
        """Serve with a token for each name, and give a client with each of the tokens."""
        tokens = {f"token of {name}": name for name in names}
        async with self.url(server, tokens=tokens) as url, AsyncExitStack() as stack:
            opening = [connect(url, server.action, token=token) for token in tokens]
            yield [await stack.enter_async_context(client) for client in opening]

    @asynccontextmanager
    async def url(self, *servers: Endpoint, **settings: Any) -> AsyncGenerator[str, None]:
        """Serve, and give the URL. At the end, nothing may be left running."""
        before = running()
        with anyio.fail_after(self.patience):
            async with self._way(servers, self.address(), **settings) as url:
                yield url
        assert running() <= before, "tasks are left behind"


def running() -> set[int]:
    """Return the tasks that run."""
    return {task.id for task in anyio.get_running_tasks()}


@asynccontextmanager
async def directly(
    servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve servers at the address."""
    async with serve(servers, address, **settings) as (url,):
        yield url


@asynccontextmanager
async def through_a_gateway(
    servers: Servers, address: str | Transport, **settings: Any
) -> AsyncGenerator[str, None]:
    """Serve what a gateway, which knows no types, reaches in this process."""
    async with AsyncExitStack() as stack:
        (url,) = await stack.enter_async_context(serve(servers, f"inproc://{uuid.uuid4().hex}"))
        behind = await stack.enter_async_context(connect(url))
        endpoints = [behind.endpoint(info) for info in await behind.actions()]
        (url,) = await stack.enter_async_context(serve(endpoints, address, **settings))
        yield url
