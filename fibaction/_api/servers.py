"""`serve`: serve actions at URLs."""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, Generator, Iterable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack, cast

from anyio import create_task_group

from fibaction._runtime.async_only import AsyncBlock, OwnThread
from fibaction._runtime.log import clean_logger
from fibaction.border.abc import Endpoint, Startable, Transport
from fibaction.border.goal_store import GoalStore
from fibaction.border.urls import transport_for, without_settings
from fibaction.border.watchers import Watcher
from fibaction.client.kept_connection import KeptBlock
from fibaction.types.action import Action
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction.server import ActionServer
    from fibaction.server.functions.function_action import FunctionAction
    from fibaction_transports.keywords import ServeKeywords

logger = clean_logger("fibaction.server")

Served: TypeAlias = "Endpoint | FunctionAction[..., Any, Any, Any] | object"
"""A server or another endpoint, an action that is made of a function, or an object whose methods
are such actions."""


class Serving(AsyncBlock, AbstractAsyncContextManager[tuple[str, ...], None]):
    """Servers at their addresses, to be run by `async with`: see `serve`."""

    opened_by = "async with serve(...):"

    def __init__(self, block: AbstractAsyncContextManager[tuple[str, ...]]) -> None:
        self._block = block

    async def __aenter__(self) -> tuple[str, ...]:
        return await self._block.__aenter__()

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self._block.__aexit__(exc_type, exc, traceback)

    def __await__(self) -> Generator[Any, Any, KeptServers]:
        return self._kept().__await__()

    async def _kept(self) -> KeptServers:
        block = KeptBlock(self._block)
        await block.open("fibaction servers")
        return KeptServers(block)


class KeptServers:
    """Servers that `await serve(...)` has started, and that run until `aclose`."""

    def __init__(self, block: KeptBlock[tuple[str, ...]]) -> None:
        self._block = block
        self._thread = OwnThread()
        self.urls = block.value
        """The URLs under which clients find the servers."""

    async def aclose(self) -> None:
        """Stop the servers, from any task. Closing twice does nothing.

        Raises:
            StoreError: The store of a server has failed.
        """
        self._thread.check()
        self._block.close()
        await self._block.ended.wait()
        error, self._block.error = self._block.error, None
        if error is not None:
            raise error

    def __del__(self) -> None:
        if not self._block.is_closing:
            logger.warning(
                "the servers at %s stop, because the value of `await serve(...)` was dropped: keep"
                " it, and call its `aclose()`, or write `async with serve(...):`",
                ", ".join(self.urls),
            )
            self._block.close_soon()

    def __repr__(self) -> str:
        return f"<KeptServers at {', '.join(self.urls)}>"


def serve(
    endpoints: Served | Iterable[Served],
    *where: str | Transport,
    watchers: Iterable[Watcher] = (),
    **settings: Unpack[ServeKeywords],
) -> Serving:
    """Serve one endpoint or several, at one address or several, for as long as the block lasts.

    An endpoint is an `ActionServer`, or any other `Endpoint`. An action that is made of a function
    is served by an `ActionServer` with the default settings, and so is each action that is a method
    of an object: `serve(robot, url)`. An address is a URL or a transport.
    `settings` are those of the constructors of the URLs' transports, for example `tokens={...}`.
    The block gets the URLs under which clients find the endpoints. Servers that are not running are
    started, and stopped at the end, while their clients can still be answered. `watchers` are added
    to each of the servers.

        async with serve(ActionServer(DRIVE, drive), "tcp://127.0.0.1:7400"):
            await anyio.sleep_forever()

    Where a block is in the way, as in a notebook, write `server = await serve(...)`, and later, in
    any task, `await server.aclose()`; `server.urls` has the URLs.

    Raises:
        TransportError: An address cannot be used.
        TypeError: A transport does not have such a setting, an argument is not a server or not an
            address, the address is missing, or there are watchers and an endpoint is not an
            `ActionServer`.
        RuntimeError: A server has been stopped; each runs once.
    """
    return Serving(_served(endpoints, where, tuple(watchers), settings))


@asynccontextmanager
async def _served(
    endpoints: Served | Iterable[Served],
    where: tuple[str | Transport, ...],
    watchers: tuple[Watcher, ...],
    settings: ServeKeywords,
) -> AsyncGenerator[tuple[str, ...], None]:
    from fibaction.server import ActionServer  # here, since clients do not need it

    chosen = _chosen(endpoints)
    if not where:
        raise TypeError(
            "serve() needs at least one address: a URL such as tcp://127.0.0.1:7400, or a"
            " transport; to use a server without an address, enter it with `async with`, and give"
            " it to an ActionClient"
        )
    transports = [transport_for(one, **settings) for one in where]
    for one in chosen if watchers else ():
        if not isinstance(one, ActionServer):
            raise TypeError(f"only an ActionServer can have watchers, and {one!r} is not one")
        one.watch_by(watchers)
    started: list[Startable] = []
    held = _new_servers(chosen)
    async with AsyncExitStack() as stack:
        for transport in transports:
            store = await stack.enter_async_context(transport.goal_store())
            if store is not None:
                _keep_in(store, chosen)
        for server in held:
            server.hold_executors()
        for one in chosen:
            if isinstance(one, Startable) and not one.is_running:
                await stack.enter_async_context(one)
                started.append(one)
        urls = [await stack.enter_async_context(one.serve(*chosen)) for one in transports]
        stack.push_async_callback(_stop, started)
        for server in held:
            server.start_executors()
        yield tuple(urls)


def _new_servers(endpoints: Iterable[Endpoint]) -> list[ActionServer[Any, Any, Any]]:
    from fibaction.server import ActionServer  # as above

    found: list[Any] = [one for one in endpoints if isinstance(one, ActionServer)]
    return [one for one in found if one.is_new]


def _keep_in(store: GoalStore, endpoints: Iterable[Endpoint]) -> None:
    """Let the servers among the endpoints keep their goals where their transport keeps them.

    Raises:
        TransportError: A server has a store of its own, or was started before.
    """
    from fibaction.server import ActionServer  # as above

    for one in endpoints:
        if not isinstance(one, ActionServer):
            continue
        if one.store is not None or not one.is_new:
            how = "was started before" if one.store is None else "has a store"
            raise TransportError(
                f"{one!r} {how}, and this address keeps the goals of its servers itself: give it a"
                f" server that is new and has no store"
            )
        one.keep_in(store)


def _chosen(endpoints: Served | Iterable[Served]) -> tuple[Endpoint, ...]:
    from fibaction.server import ActionServer, actions_of  # as above

    given: Iterable[Any] = (endpoints,)
    is_one = isinstance(endpoints, Endpoint | str) or actions_of(endpoints)
    if isinstance(endpoints, Iterable) and not is_one:
        given = cast("Iterable[Any]", endpoints)
    chosen: list[Endpoint] = []
    one: Any
    for one in given:
        if isinstance(one, Endpoint):
            chosen.append(one)
        elif actions := actions_of(one):
            chosen += map(ActionServer, actions)
        else:
            # If the arguments are swapped, it is a URL, which may contain a token.
            shown = without_settings(one) if isinstance(one, str) else one
            hint = ""
            if isinstance(one, Action):
                hint = f": write serve(ActionServer({one.name.upper()}, executor), ...)"
            elif inspect.isclass(one):
                hint = f": serve an object of it, as in serve({one.__name__}(), ...)"
            elif inspect.isroutine(one):
                hint = ": make an action of a function with @action, or give it to an ActionServer"
            raise TypeError(
                f"serve() takes servers, such as ActionServer(action, executor), and then"
                f" addresses; {shown!r} is not a server{hint}"
            )
    return tuple(chosen)


async def _stop(servers: Iterable[Startable]) -> None:
    async with create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(server.stop)
