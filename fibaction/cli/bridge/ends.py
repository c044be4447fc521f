"""The serving end of a bridge: its actions, which come and go, and their new names."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Iterable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, NamedTuple, Self

import anyio
import msgspec
from anyio.abc import TaskGroup, TaskStatus

from fibaction._api import serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint, Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.output.escape import excerpt
from fibaction.cli.process.exit_codes import Failure
from fibaction.types.action import ActionInfo
from fibaction.wire.server.requests import ChangingEndpoints
from fibaction.wire.transport import WireTransport
from fibaction.wire.wire_server import open_server


class BridgeEnd(ABC):
    """The actions that are served at one address."""

    where = ""
    """The URL under which clients find the actions."""
    can_change = True
    """True if actions can be added after `begin`, and removed."""

    @abstractmethod
    async def add(self, endpoint: Endpoint) -> None:
        """Serve one more action.

        Raises:
            TransportError: It cannot be served.
        """

    @abstractmethod
    async def remove(self, name: str) -> None:
        """Stop serving the action. Goals of its clients go on at their server."""

    async def begin(self) -> None:  # noqa: B027  # most serve from the first action on
        """Serve what has been added.

        Raises:
            TransportError: The address cannot be used.
        """


class _WireEnd(BridgeEnd):
    """One server of the wire protocol, which looks up its actions with each request."""

    def __init__(self) -> None:
        self.endpoints = ChangingEndpoints()

    async def add(self, endpoint: Endpoint) -> None:
        self.endpoints.add(endpoint)

    async def remove(self, name: str) -> None:
        del self.endpoints[name]


class _SingleServers(BridgeEnd):
    """A server for each action.

    Each server runs in a task of its own, since a block of `serve` must be left in its own task.
    """

    def __init__(self, address: str | Transport, tasks: TaskGroup) -> None:
        self._address = address
        self._tasks = tasks
        self._stops: dict[str, anyio.Event] = {}
        self._ended: dict[str, anyio.Event] = {}

    async def add(self, endpoint: Endpoint) -> None:
        name = endpoint.info.name
        stop, ended = anyio.Event(), anyio.Event()
        self.where = await self._tasks.start(self._serve, endpoint, stop, ended)
        self._stops[name], self._ended[name] = stop, ended

    async def _serve(
        self,
        endpoint: Endpoint,
        stop: anyio.Event,
        ended: anyio.Event,
        *,
        task_status: TaskStatus[Any] = anyio.TASK_STATUS_IGNORED,
    ) -> None:
        try:
            async with serve(endpoint, self._address) as (where,):
                task_status.started(where)
                await stop.wait()
        finally:
            ended.set()

    async def remove(self, name: str) -> None:
        self._stops.pop(name).set()
        await self._ended.pop(name).wait()

    async def aclose(self) -> None:
        """Stop all servers, and wait until they have stopped."""
        for stop in self._stops.values():
            stop.set()
        for ended in self._ended.values():
            await ended.wait()


class _FixedServer(BridgeEnd):
    """One server, whose actions stay the same: that of a worker in a fleet, for example."""

    can_change = False

    def __init__(self, address: str | Transport, block: AsyncExitStack) -> None:
        self._address = address
        self._block = block
        self._endpoints: list[Endpoint] = []

    async def add(self, endpoint: Endpoint) -> None:
        self._endpoints.append(endpoint)

    async def remove(self, name: str) -> None:
        self._endpoints = [one for one in self._endpoints if one.info.name != name]

    async def begin(self) -> None:
        block = serve(self._endpoints, self._address)
        (self.where,) = await self._block.enter_async_context(block)


@asynccontextmanager
async def open_end(where: str | Transport) -> AsyncGenerator[BridgeEnd, None]:
    """Open the serving end of a bridge, which serves nothing yet.

    Raises:
        TransportError: The address cannot be used.
    """
    transport = transport_for(where)
    if isinstance(transport, WireTransport):
        end = _WireEnd()
        async with (
            open_server(end.endpoints, transport.settings) as server,
            transport.accept_lines(server) as end.where,
        ):
            yield end
    elif transport.shares_address:
        async with Background() as tasks:
            servers = _SingleServers(where, tasks)
            try:
                yield servers
            finally:
                with anyio.CancelScope(shield=True):
                    await servers.aclose()
    else:
        async with AsyncExitStack() as block:
            yield _FixedServer(where, block)


_RENAME = re.compile(r"([\w/~]+):?=(/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*)", re.ASCII)


class Renames(NamedTuple):
    """The rules by which the actions of a namespace get new names."""

    source: Namespace = ROOT
    """The namespace from which the actions are taken."""
    target: Namespace | None = None
    """The namespace that takes the place of `source`; None if names stay as they are."""
    names: Mapping[str, str] = {}
    """New names by old ones, both with a slash in front."""

    @classmethod
    def parse(cls, rules: Iterable[str], source: Namespace, target: Namespace | None) -> Self:
        """Read rules `OLD=NEW`, or `OLD:=NEW`, as ROS writes it.

        OLD without a slash in front is relative to `source`, and NEW to `target`.

        Raises:
            Failure: A rule is malformed, or two are about the same action.
        """
        found: dict[str, str] = {}
        for rule in rules:
            match = _RENAME.fullmatch(rule)
            if match is None:
                text = f"a rename is like OLD=NEW, for example pick=grasp, unlike {excerpt(rule)!r}"
                raise Failure(text)
            old = shown(source.absolute(match[1]))
            if old in found:
                raise Failure(f"the action {old} is renamed twice")
            found[old] = shown((source if target is None else target).absolute(match[2]))
        return cls(source, target, found)

    def new_name(self, name: str) -> str:
        """Return the name under which an action is served.

        A new name has no slash in front: at `ros2://` it is relative to the namespace of the URL,
        as the names of all actions of servers are.
        """
        if renamed := self.names.get(shown(name)):
            return renamed.removeprefix("/")
        if self.target is None:
            return name
        rest = self.source.relative(name).lstrip("/")
        return f"{self.target.path}/{rest}".lstrip("/")

    def unknown(self, names: Iterable[str]) -> str:
        """Return an old name of a rule that is not among these; empty if all are."""
        known = set(map(shown, names))
        return next((old for old in self.names if old not in known), "")

    def check(self, names: Iterable[str]) -> None:
        """Check that no two of these actions get the same name by the rules.

        Raises:
            Failure: Two do.
        """
        owners: dict[str, str] = {}
        for name in names:
            new = shown(self.new_name(name))
            other = owners.setdefault(new, name)
            if other != name and (self.names or self.target is not None):
                raise Failure(clash(new, name, other))

    def endpoint(self, endpoint: Endpoint) -> Endpoint:
        """Return an endpoint under its new name."""
        name = self.new_name(endpoint.info.name)
        return endpoint if name == endpoint.info.name else _RenamedEndpoint(endpoint, name)


AS_THEY_ARE = Renames()
"""No rules: all actions keep their names."""


def clash(new: str, name: str, other: str) -> str:
    """Return the sentence about two actions with the same new name."""
    first, second = sorted(excerpt(shown(one)) for one in (name, other))
    taken = excerpt(shown(new))
    return f"{first} and {second} cannot both be served as {taken}: give one another name"


class _RenamedEndpoint(ForwardingEndpoint):
    """An endpoint that is served under another name."""

    def __init__(self, inner: Endpoint, name: str) -> None:
        super().__init__(inner)
        self._info = msgspec.structs.replace(inner.info, name=name)

    @property
    def info(self) -> ActionInfo:
        return self._info
