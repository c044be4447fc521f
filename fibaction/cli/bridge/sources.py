"""The servers whose actions are served once more, each of them in a namespace of its own."""

from __future__ import annotations

import re
import time
from collections.abc import AsyncGenerator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any, Final
from urllib.parse import urlsplit

import anyio
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.abc import Absence, Transport
from fibaction.border.event_loop import Background
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.namespaces import Namespace
from fibaction.cli.arguments.options import reject_inproc
from fibaction.cli.bridge.actions import BridgedActions
from fibaction.cli.bridge.ends import BridgeEnd, open_end
from fibaction.cli.bridge.renames import AS_THEY_ARE, Renames
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import Failure, message_of
from fibaction.observe.action_listener import PERIOD
from fibaction.observe.sources import ListedServer, Sources
from fibaction.types import ros_messages
from fibaction.words.errors import ActionError, TransportError
from fibaction.words.goals import WorkerInfo

FIND_TOPIC: Final = 5.0
"""Seconds to find the type of a topic."""
ASK_WORKERS: Final = 1.0
"""Seconds for the list of the workers of a fleet."""

_NAMED = re.compile(r"([A-Za-z_]\w*)=(\w[\w+.-]*://.*)", re.ASCII)


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
