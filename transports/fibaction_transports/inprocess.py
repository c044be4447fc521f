"""`inproc://name`: clients and servers in one process, on one event loop.

A client calls the server itself, which is looked up by name at each call. So nothing is copied or
queued on the way, and a server may be started after its clients.
"""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, Unpack
from urllib.parse import SplitResult
from weakref import WeakSet, WeakValueDictionary

import msgspec

from fibaction import __version__
from fibaction.border.abc import (
    Connection,
    Endpoint,
    GoalRequest,
    GoalStream,
    LogLine,
    Notifier,
    StatusStream,
)
from fibaction.border.settings import TransportSettings
from fibaction.types.action import Action, ActionInfo
from fibaction.wire.settings import ClientSettings
from fibaction.wire.transport import ConfiguredTransport
from fibaction.words.errors import (
    ConnectionLost,
    InvalidURL,
    ServerNotFound,
    TransportError,
    copy_of,
)
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import UNKNOWN_SENDER, CancelAnswer, GoalID, GoalInfo, Sender
from fibaction.words.intake import Intake, IntakeChange

if TYPE_CHECKING:
    from fibaction_transports.keywords import ClientKeywords

StreamT = TypeVar("StreamT", bound=GoalStream | StatusStream)

MOST_NAMED = 10
"""Actions that are served, and that the error for another one names."""
_URL = re.compile(r"inproc://([\w.-]+)", re.ASCII)


class _Directory:
    """The endpoints that are served under one name."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.endpoints: dict[str, Endpoint] = {}
        self.changed = Notifier()

    def find(self, action: str) -> Endpoint:
        try:
            return self.endpoints[action]
        except KeyError:
            served = ", ".join(sorted(self.endpoints)[:MOST_NAMED])
            more = ", and others" if len(self.endpoints) > MOST_NAMED else ""
            raise ServerNotFound(
                f"the action {action!r} is not served at {self.url}: start its server in this"
                f" process, or wait for it with wait_for_server()"
                f"{served and f'; served there: {served}{more}'}"
            ) from None


_directories: WeakValueDictionary[str, _Directory] = WeakValueDictionary()


class InProcessTransport(ConfiguredTransport):
    """The transport between clients and servers in one process.

    Without a name it makes a unique URL, for example for one test; clients and servers then need
    this object, or that URL. The settings of clients of other transports are accepted and have no
    effect, since there is no connection to lose: a program changes only the address.
    """

    settings_type: ClassVar[type[TransportSettings]] = ClientSettings

    shares_event_loop = True
    shares_address = True

    def __init__(self, name: str | None = None, **settings: Unpack[ClientKeywords]) -> None:
        """Take a name of letters, digits and `_.-`.

        Raises:
            InvalidURL: The name has other characters.
            TypeError: There is no such setting.
            ValueError: A setting is out of range.
        """
        ClientSettings.of(self, settings)
        url = f"inproc://{name or uuid.uuid4().hex}"
        if not _URL.fullmatch(url):
            raise InvalidURL(f"an in-process URL is like inproc://robot, not {url!r}")
        self._place = _directories.setdefault(url, _Directory(url))

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the name in a URL, which has nothing else."""
        return {"name": f"{parts.netloc}{parts.path}" or "/"}

    @property
    def url(self) -> str:
        """The address as a URL."""
        return self._place.url

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`."""
        place = self._place
        served: dict[str, Endpoint] = {}
        for endpoint in endpoints:
            name = endpoint.info.name
            if name in place.endpoints or name in served:
                raise TransportError(f"the action {name!r} is already served at {place.url}")
            served[name] = endpoint
        place.endpoints.update(served)
        place.changed.notify()
        try:
            yield place.url
        finally:
            for name in served:
                del place.endpoints[name]

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. It never fails, since servers may be started later."""
        connection = _InProcessConnection(self._place)
        try:
            yield connection
        finally:
            connection.close()


class _InProcessConnection(Connection):
    """An open connection, which ends its streams when it is closed."""

    def __init__(self, place: _Directory) -> None:
        self.place = place
        self._streams: WeakSet[GoalStream | StatusStream] = WeakSet()
        self._closed: ConnectionLost | None = None
        self.sender = Sender(owner=os.urandom(16))
        """The client of this connection, which has no name."""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return _NamedEndpoint(self, action.info if isinstance(action, Action) else action)

    async def actions(self) -> list[ActionInfo]:
        return [endpoint.info for endpoint in self.place.endpoints.values()]

    @property
    def release(self) -> str:
        return __version__

    def check_is_open(self) -> None:
        """Raise ConnectionLost if the connection was closed."""
        if self._closed is not None:
            raise copy_of(self._closed)

    def opened(self, stream: StreamT) -> StreamT:
        """Add a stream that is to end with the connection, and return it."""
        self._streams.add(stream)
        return stream

    def close(self) -> None:
        """End all streams of this connection."""
        self._closed = ConnectionLost(f"the connection to {self.place.url} was closed here")
        for stream in tuple(self._streams):
            stream.fail(self._closed)


class _NamedEndpoint(Endpoint):
    """The server of an action at a place, looked up at each call."""

    def __init__(self, connection: _InProcessConnection, info: ActionInfo) -> None:
        self._connection = connection
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info

    def offer_goal(self, request: GoalRequest) -> GoalStream | Coroutine[Any, Any, GoalStream]:
        if request.sender == UNKNOWN_SENDER:
            request = msgspec.structs.replace(request, sender=self._connection.sender)
        offered = self._server.offer_goal(request)
        if isinstance(offered, GoalStream):
            return self._connection.opened(offered)
        return self._opened(offered)

    async def _opened(self, offered: Coroutine[Any, Any, GoalStream]) -> GoalStream:
        return self._connection.opened(await offered)

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> GoalStream:
        stream = await self._server.feedback(goal_id, after=after, own=own, attempt=attempt)
        return self._connection.opened(stream)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        return await self._server.cancel_goals(goal_id, stamp)

    async def status(self) -> StatusStream:
        return self._connection.opened(await self._server.status())

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return await self._server.past_goals(page)

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        await self._server.read_past(wanted, take)

    async def intake(self) -> Intake:
        return await self._server.intake()

    async def change_intake(self, change: IntakeChange) -> Intake:
        return await self._server.change_intake(change)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return await self._server.rerun(goal_id)

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return await self._server.log_lines(goal_id)

    async def wait_for_server(self) -> None:
        name, place = self._info.name, self._connection.place
        while True:
            served = place.endpoints.get(name)
            if served is not None:
                with suppress(ServerNotFound):  # it has stopped, and another one may be started
                    return await served.wait_for_server()
            if place.endpoints.get(name) is served:
                await place.changed.wait()

    def owner_of(self, goal_id: GoalID) -> bytes:
        served = self._connection.place.endpoints.get(self._info.name)
        return b"" if served is None else served.owner_of(goal_id)

    @property
    def _server(self) -> Endpoint:
        self._connection.check_is_open()
        return self._connection.place.find(self._info.name)
