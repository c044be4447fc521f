"""`WorkerConnections`: the connections of a client to the workers that have goals of it.

Each is opened when it is first needed, and closed when it was not used for a while. All of them
have one session, so that a client owns its goals at each worker, and the IDs of calls are unique
over all of them, so that a goal can move from one to another.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Protocol, TypeAlias

import anyio
from anyio import CancelScope
from anyio.abc import TaskGroup

from fibaction.wire.channel import Line
from fibaction.wire.client.connection import RemoteConnection, new_session
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import ActionError, ConnectionLost, ServerNotFound
from fibaction_transports.nats.records import LeaseEntry

IDLE = 30.0
"""Seconds after which a connection that is not used is closed, at least; twice that at most."""


OnLost: TypeAlias = Callable[[RemoteGoal, ActionError, float | None], None]
"""Takes a goal that a connection cannot continue with, and the time at which its line was lost;
None if it was not lost."""


class Lines(Protocol):
    """The lines of one client to workers."""

    async def dial(self, worker: str) -> Line:
        """Open a line to a worker.

        Raises:
            ServerNotFound: The worker is not there.
            TransportError: It has not answered.
        """
        ...


class _Opened:
    """A connection to one worker."""

    def __init__(
        self,
        worker: str,
        lines: Lines,
        settings: ClientSettings,
        session: bytes,
        ids: Iterator[int],
        on_lost: OnLost,
    ) -> None:
        self._worker = worker
        self._lines = lines
        self._on_lost = on_lost
        self.connection = RemoteConnection(
            self._dial, f"worker {worker!r}", settings, session=session, ids=ids
        )
        self.scope = CancelScope()
        self.is_idle = False
        """True if it was not used when it was last looked at."""

    def lose(self, goal: RemoteGoal, error: ActionError) -> None:
        """Give a goal to the routes that this connection cannot continue with."""
        self._on_lost(goal, error, self.connection.lost_at)

    async def _dial(self) -> Line:
        try:
            return await self._lines.dial(self._worker)
        except ServerNotFound as exc:
            # What the worker has not answered can go elsewhere at once; the rest waits for it, or
            # for the end of its lease.
            lost = ConnectionLost(str(exc))
            self.connection.calls.fail_unanswered(lost)
            raise lost from exc


class WorkerConnections:
    """The open connections of one client."""

    def __init__(
        self, lines: Lines, settings: ClientSettings, tasks: TaskGroup, on_lost: OnLost
    ) -> None:
        """Open connections in tasks of this group; `on_lost` gets the goals that are kept in a
        record, and with which a connection cannot continue.
        """
        self._lines = lines
        self._settings = settings
        self._tasks = tasks
        self._session = new_session()
        self._ids = itertools.count(1)
        self._opened: dict[str, _Opened] = {}
        self._on_lost = on_lost

    def adopt(self, worker: str, goal: RemoteGoal) -> None:
        """Continue with a goal at its owner."""
        opened = self._of(worker)
        opened.connection.calls.adopt(goal, opened.lose)

    def calls_of(self, worker: str) -> OpenCalls:
        """Return the calls that are open at a worker, for another request."""
        return self._of(worker).connection.calls

    def lose_at(self, worker: str) -> Callable[[RemoteGoal, ActionError], None]:
        """Return the function for a goal of a worker that is kept in a record, and with which the
        connection cannot continue.
        """
        return self._of(worker).lose

    def next_id(self) -> int:
        """Return the ID of a call that is not opened at any worker."""
        return next(self._ids)

    def _of(self, worker: str) -> _Opened:
        """Return the connection to a worker, which is opened if need be."""
        opened = self._opened.get(worker)
        if opened is None:
            opened = self._opened[worker] = _Opened(
                worker, self._lines, self._settings, self._session, self._ids, self._on_lost
            )
            self._tasks.start_soon(self._run, worker, opened)
        opened.is_idle = False
        return opened

    def end(self, lease: LeaseEntry) -> None:
        """End the connection to a worker whose lease has ended."""
        opened = self._opened.pop(lease.worker, None)
        if opened is not None:
            opened.connection.end(ConnectionLost(f"worker {lease.worker!r} is gone"))
            opened.scope.cancel()

    async def close_idle(self) -> None:
        """Close the connections that are not used, again and again."""
        while True:
            await anyio.sleep(IDLE)
            for worker, opened in tuple(self._opened.items()):
                was_idle, opened.is_idle = opened.is_idle, opened.connection.calls.is_empty
                if was_idle and opened.is_idle:
                    del self._opened[worker]
                    await self._leave(opened)

    async def leave(self) -> None:
        """Say goodbye to all workers."""
        opened, self._opened = self._opened, {}
        async with anyio.create_task_group() as tasks:
            for one in opened.values():
                tasks.start_soon(self._leave, one)

    async def _leave(self, opened: _Opened) -> None:
        await opened.connection.leave()
        opened.scope.cancel()

    async def _run(self, worker: str, opened: _Opened) -> None:
        with opened.scope:
            await opened.connection.run()
        if self._opened.get(worker) is opened:
            del self._opened[worker]
