"""The servers whose actions are served once more, each in a namespace, as they come and go."""

from __future__ import annotations

import re
import time
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

import anyio
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.abc import Absence, Connection, Endpoint, Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.names import Namespace, shown
from fibaction.cli.arguments.options import reject_inproc
from fibaction.cli.bridge.ends import AS_THEY_ARE, BridgeEnd, Renames, clash, open_end
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import Failure, message_of
from fibaction.observe.action_listener import PERIOD
from fibaction.observe.sources import ListedServer, Sources
from fibaction.types import ros_messages
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError, TransportError
from fibaction.words.goals import WorkerInfo

LOOKS = 3
"""Consecutive looks without an action after which it counts as gone. A graph of ROS may lose an
action for a moment, and its clients are to notice nothing."""
FIND_TOPIC: Final = 5.0
"""Seconds to find the type of a topic."""
ASK_WORKERS: Final = 1.0
"""Seconds for the list of the workers of a fleet."""

_NAMED = re.compile(r"([A-Za-z_]\w*)=(\w[\w+.-]*://.*)", re.ASCII)


class _Bridged(NamedTuple):
    """An action that is served by the bridge."""

    info: ActionInfo
    """Its description, with its old name."""
    endpoint: Endpoint
    """Its endpoint, under its new name."""


class BridgedActions:
    """The actions that a bridge serves now."""

    def __init__(self, connection: Connection, renames: Renames, end: BridgeEnd) -> None:
        """Serve actions of a connection at an end."""
        self._connection = connection
        self._renames = renames
        self._end = end
        self._served: dict[str, _Bridged] = {}
        self._owners: dict[str, str] = {}  # the old names of what is served, by the new ones
        self._missing: dict[str, int] = {}  # the looks since which a served action is missing
        self._unusable: dict[str, ActionInfo] = {}
        self._clashing: set[str] = set()
        self.absence: Absence | None = None
        """The time in which the server does not say which actions it has."""

    @property
    def endpoints(self) -> list[Endpoint]:
        """The endpoints that are served, under their new names."""
        return [one.endpoint for one in self._served.values()]

    async def follow(self, period: float = PERIOD) -> None:
        """Look for actions that have come or gone, until canceled."""
        while True:
            await anyio.sleep(period)
            await self.look()

    async def look(self) -> None:
        """Serve what has come, and stop serving what has gone."""
        try:
            infos = await self._connection.actions()
        except ActionError as exc:
            # The server is away; its goals can be followed again when it is back.
            since = self.absence.since if self.absence else time.time()
            self.absence = Absence(since, str(exc))
            return
        self.absence = None
        before = dict(self._served)
        await self.take(infos)
        self._tell_changes(before)

    def _tell_changes(self, before: Mapping[str, _Bridged]) -> None:
        for name in before:
            if name not in self._served:
                note(f"{excerpt(shown(name))} has gone")
        for name, one in self._served.items():
            if one is before.get(name):
                continue
            new = shown(one.endpoint.info.name)
            renamed = "" if new == shown(name) else f" as {excerpt(new)}"
            types = " with other types" if name in before else ""
            note(f"{excerpt(shown(name))} has come{types}, and is served{renamed}")

    async def take(self, infos: Sequence[ActionInfo]) -> None:
        """Serve these actions from now on, and stop serving others that are missing for long."""
        named = {info.name: info for info in infos}
        for name in self._unusable.keys() - named.keys():
            del self._unusable[name]
        self._clashing &= named.keys()
        for name in self._served.keys() - named.keys():
            self._missing[name] = self._missing.get(name, 0) + 1
            if self._missing[name] >= LOOKS:
                await self._remove(name)
        for name, info in named.items():
            self._missing.pop(name, None)
            served = self._served.get(name)
            if served is not None and served.info != info:  # with other types
                await self._remove(name)
            if name not in self._served and self._unusable.get(name) != info:
                await self._add(info)

    async def _remove(self, name: str) -> None:
        self._missing.pop(name, None)
        new = self._served.pop(name).endpoint.info.name
        del self._owners[new]
        await self._end.remove(new)

    async def _add(self, info: ActionInfo) -> None:
        name = self._renames.new_name(info.name)
        owner = self._owners.get(name)
        if owner is not None:
            if info.name not in self._clashing:
                note(f"{excerpt(shown(info.name))} is left out: {clash(name, info.name, owner)}")
            self._clashing.add(info.name)
            return
        try:
            endpoint = self._renames.endpoint(self._connection.endpoint(info))
            await self._end.add(endpoint)
        except TransportError as exc:
            self._unusable[info.name] = info
            note(f"{excerpt(shown(info.name))} is left out: {message_of(exc)}")
            return
        self._served[info.name] = _Bridged(info, endpoint)
        self._owners[endpoint.info.name] = info.name
        self._unusable.pop(info.name, None)
        self._clashing.discard(info.name)


def named_urls(texts: Sequence[str]) -> dict[str, str]:
    """Read URLs of servers with the names of their namespaces: `arm=tcp://10.0.0.7:7400`.

    A single URL needs no name. Of several, one without a name has that of its host, or its scheme
    if that is not a name.

    Raises:
        Failure: Two have the same name, or one is not a URL.
    """
    found: dict[str, str] = {}
    for text in texts:
        match = _NAMED.fullmatch(text)
        name, url = match.groups() if match else ("", text)
        if "://" not in url:
            raise Failure(f"{excerpt(text)} is not a URL, nor NAME=URL as in arm=tcp://10.0.0.7")
        reject_inproc(url)
        if name in found:
            raise Failure(f"two servers have the name {name}: give one another name, as NAME=URL")
        if not name and len(texts) > 1:
            name = _new_name(url, found)
        found[name] = url
    return found


def _new_name(url: str, taken: dict[str, str]) -> str:
    parts = urlsplit(url)
    host = parts.hostname or ""
    name = host if re.match(r"[A-Za-z_]", host) else parts.scheme
    name = re.sub(r"\W", "_", name, flags=re.ASCII)
    number = 1
    while (numbered := name if number == 1 else f"{name}_{number}") in taken:
        number += 1
    return numbered


class SourceServer:
    """One server, whose actions are served at an end as they come and go."""

    def __init__(self, name: str, url: str) -> None:
        self.name = name
        self.url = url
        self.node: Any = None
        """The node of ROS through which the actions are reached; None at other servers."""
        self._absence = Absence(time.time(), "it was not reached yet")
        self._connection: ClientConnection | None = None
        self._actions: BridgedActions | None = None
        self._workers: list[WorkerInfo] = []

    @property
    def absence(self) -> Absence | None:
        """The absence of the server; None if it can be reached, as far as that is known."""
        if self._actions is None:
            return self._absence
        absences = (one.absence for one in self._actions.endpoints)
        return next(filter(None, absences), self._actions.absence)

    async def serve(self, end: BridgeEnd) -> None:
        """Serve the actions until canceled; a server that is not there is tried again."""
        while True:
            try:
                async with self.open() as connection:
                    actions = await self.begin(connection, end)
                    await actions.follow()
            except ActionError as exc:
                if self._absence.reason != str(exc):
                    note(f"{self.name} is tried again: {message_of(exc)}")
                self._absence = Absence(self._absence.since, str(exc))
            await anyio.sleep(PERIOD)

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[ClientConnection, None]:
        """Connect to the server: through one node for actions and topics, where there are nodes."""
        opener = getattr(transport_for(self.url), "open_node", None)
        if opener is None:
            async with connect(self.url) as connection:
                yield connection
            return
        async with opener() as node, connect(node) as connection:
            self.node = node
            try:
                yield connection
            finally:
                self.node = None

    async def begin(self, connection: ClientConnection, end: BridgeEnd) -> BridgedActions:
        """Serve the actions that an open connection has now, and return them."""
        renames = Renames(target=Namespace.parse(self.name)) if self.name else AS_THEY_ARE
        self._connection = connection
        actions = BridgedActions(connection, renames, end)
        await actions.look()
        self._actions = actions  # not before: it counts as reached from now on
        return actions

    async def info(self) -> ListedServer:
        """Return the line of the list of servers."""
        if self._connection is not None:
            with anyio.move_on_after(ASK_WORKERS):
                try:
                    self._workers = await self._connection.workers()
                except ActionError:
                    self._workers = []
        names = [one.info.name for one in self._actions.endpoints] if self._actions else []
        url = without_settings(self.url)
        version = self._connection.release if self._connection is not None else ""
        return ListedServer(self.name, url, sorted(names), self.absence, self._workers, version)


class BridgedSources(Sources):
    """All servers of a page."""

    def __init__(self, urls: dict[str, str]) -> None:
        """Take them by their names."""
        self.all = [SourceServer(name, url) for name, url in urls.items()]

    def __str__(self) -> str:
        return ", ".join(without_settings(one.url) for one in self.all)

    @asynccontextmanager
    async def served_at(self, where: str | Transport) -> AsyncGenerator[BridgeEnd, None]:
        """Serve their actions at an address while the block lasts. A server that is not there is
        tried again, unless it is the only one.

        Raises:
            TransportError: It cannot be used, or the only server is not there.
        """
        async with AsyncExitStack() as block:
            if len(self.all) == 1:
                connection = await block.enter_async_context(self.all[0].open())
                await connection.actions()
                end = await block.enter_async_context(open_end(where))
                serving = [(await self.all[0].begin(connection, end)).follow]
            else:
                end = await block.enter_async_context(open_end(where))
                serving = [partial(source.serve, end) for source in self.all]
            tasks = await block.enter_async_context(Background())
            for serve in serving:
                tasks.start_soon(serve)
            yield end

    async def infos(self) -> list[ListedServer]:
        found: dict[str, ListedServer] = {}

        async def ask(source: SourceServer) -> None:
            found[source.name] = await source.info()

        async with anyio.create_task_group() as tasks:
            for source in self.all:
                tasks.start_soon(ask, source)
        return [found[source.name] for source in self.all]

    def reached(self) -> dict[str, bool]:
        return {source.name: source.absence is None for source in self.all}

    def topics(self) -> dict[str, str]:
        return {
            f"{source.name}{topic}".lstrip("/"): kind
            for source in self.all
            if source.node is not None
            for topic, kind in source.node.topics().items()
        }

    async def messages(self, topic: str) -> AsyncGenerator[bytes, None]:
        name, _, rest = topic.partition("/")
        for source in self.all:
            if source.node is not None and source.name in ("", name):
                wanted = f"/{rest if source.name else topic}"
                break
        else:
            raise TransportError(f"there is no topic {excerpt(topic)}")
        try:
            kind = await source.node.type_of(wanted, timeout=FIND_TOPIC)
        except TimeoutError as exc:
            raise TransportError(str(exc)) from exc
        with source.node.subscribe(wanted, kind, qos="sensor_data", depth=1) as messages:
            message = await messages.next()
            yield msgspec.msgpack.encode([kind, ros_messages.schema(type(message))])
            while True:
                yield ros_messages.encode(message)
                message = await messages.next()
