"""Reconnecting: when a client connects again, with which back-off, and how long calls wait.

- The first attempt comes at once. After a failed one, the next comes after a pause that doubles
  from `FIRST_PAUSE` to `LONGEST_PAUSE`, shortened by chance to half at most, so that the clients of
  a server that comes back do not all come at the same moment.
- An open connection that is lost, since it was closed or its server was silent for 4 of its
  heartbeats (4 s by default, see `Heartbeat`), is opened again from `FIRST_PAUSE` on. Calls wait
  for it for `reconnect_timeout` seconds, *patience* here, and then end with `ConnectionLost`. The
  attempts continue after that; meanwhile new calls fail at once, with the last attempt's error.
- Without `reconnect`, and after an error that would come again (a rejected token, another protocol,
  an invalid URL), there is no next attempt: the connection is over.
"""

from __future__ import annotations

import random
import time
from collections.abc import Awaitable, Callable

import anyio
from anyio import CancelScope, create_task_group, current_time
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.endpoints import Absence
from fibaction.wire.link import naming
from fibaction.wire.settings import ClientSettings
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    ProtocolError,
    copy_of,
)

logger = clean_logger("fibaction.wire")

FIRST_PAUSE, LONGEST_PAUSE = 0.02, 2.0
"""Seconds between attempts to connect: short at first, for a line that only flickered, and long
later, for a server that is away for hours."""


class Reconnector:
    """Keeps one connection open: attempts, pauses between them, and the end of patience."""

    def __init__(
        self,
        url: str,
        settings: ClientSettings,
        attempt: Callable[[], Awaitable[ActionError]],
        fail_calls: Callable[[ActionError, ActionError], None],
    ) -> None:
        """Let `attempt` open a connection and return the error that ended it, or that prevented it;
        it calls `opened` in between. `fail_calls` ends the open calls with the first error, and
        lets new ones fail with the second, until the next connection is opened.
        """
        self._url = url
        self._settings = settings
        self._attempt = attempt
        self._fail_calls = fail_calls
        self._absent: ActionError | None = None  # why new calls fail at once
        self._patience: CancelScope | None = None  # while calls wait for a lost connection
        self._last_error: ActionError  # of the attempt before this one
        self._changed = Notifier()
        self.is_open = False
        """True if the server has let this client in, and the connection has not ended."""
        self.is_final = False
        """True if there will not be another connection: it was left, or no attempt is of use."""
        self.absence: Absence | None = None
        """The time since the connection was lost; None while there is one."""
        self.changes = 0
        """Count of connections that were opened or given up: see `changed`."""

    async def first_attempt(self) -> None:
        """Wait until the first attempt has succeeded or failed.

        Raises:
            ActionError: It failed, and there will not be another.
        """
        while not self.is_open and self._absent is None:
            await self._changed.wait()
        self._check()

    async def changed(self, since: int) -> None:
        """Wait until there is another connection than when `changes` was `since`.

        Raises:
            ActionError: There will not be another.
        """
        while self.changes == since and not self.is_final:
            await self._changed.wait()
        self._check()

    def _check(self) -> None:
        if self.is_final and self._absent is not None:
            raise copy_of(self._absent)

    async def run(self) -> None:
        """Connect, and connect again, until that is of no use."""
        async with create_task_group() as tasks:
            await self._keep_connecting(tasks)
            tasks.cancel_scope.cancel()

    def opened(self) -> None:
        """Note that the server has let this client in."""
        self.is_open = True
        self.absence = None
        self._absent = None
        self._end_patience()
        self._tell()

    def stop(self, error: ActionError | None = None) -> None:
        """End the connection for good, with that error, or because it was closed here."""
        closed = ConnectionLost(f"the connection to {self._url} was closed here")
        self.is_final = True
        self._give_up(error or closed)

    async def _keep_connecting(self, tasks: TaskGroup) -> None:
        pause = FIRST_PAUSE
        while True:
            error = self._last_error = await self._attempt()
            since = self.absence.since if self.absence else time.time()
            self.absence = Absence(since, str(error))
            if self.is_open:
                self.is_open, pause = False, FIRST_PAUSE
                self._patience = CancelScope()
                ends = current_time() + self._settings.reconnect_timeout
                tasks.start_soon(self._lose_patience, self._patience, ends)
                logger.info("%s", naming(self._url, error))
            if _would_come_again(error) or not self._settings.reconnect:
                self.is_final = True  # if the connection was left meanwhile, it is so already
            if self.is_final or self._patience is None:
                self._give_up(error)
            if self.is_final:
                return
            await anyio.sleep(pause * random.uniform(0.5, 1))  # not a secret
            pause = min(2 * pause, LONGEST_PAUSE)

    async def _lose_patience(self, patience: CancelScope, ends: float) -> None:
        # In a task beside the attempts, one of which may take longer than calls are to wait.
        with patience:
            await anyio.sleep_until(ends)
            if self._patience is patience:  # else there is a connection, since this moment
                self._give_up(self._last_error)

    def _end_patience(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _give_up(self, error: ActionError) -> None:
        self._absent = lost = error
        if self._patience is not None and not _would_come_again(error):
            # Open calls had a server, whatever the last attempt has found.
            lost = ConnectionLost(str(error))
        self._fail_calls(lost, error)
        self._end_patience()
        self._tell()

    def _tell(self) -> None:
        self.changes += 1
        self._changed.notify()


def _would_come_again(error: ActionError) -> bool:
    """Return whether another attempt would end with the same error."""
    return isinstance(error, AuthenticationFailed | InvalidURL | ProtocolError)
