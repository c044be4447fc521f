"""`serve`: servers and transports, started and stopped in the right order."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

from anyio import create_task_group

from fibaction.abc import Endpoint, Transport
from fibaction.server import ActionServer
from fibaction.urls import transport_for, without_settings


@asynccontextmanager
async def serve(
    endpoints: Endpoint | Iterable[Endpoint], *where: str | Transport, **settings: Any
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
    servers: list[ActionServer[Any, Any, Any]] = [
        one for one in chosen if isinstance(one, ActionServer) and not one.is_running
    ]
    async with AsyncExitStack() as stack:
        for server in servers:
            await stack.enter_async_context(server)
        urls = [await stack.enter_async_context(one.serve(*chosen)) for one in transports]
        stack.push_async_callback(_stop, servers)
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


async def _stop(servers: Iterable[ActionServer[Any, Any, Any]]) -> None:
    async with create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(server.stop)
