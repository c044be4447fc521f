"""`KeptConnection`: a connection that is open until it is closed, without a block.

Theory of operation
-------------------

A connection has tasks, so it must be entered and left in one task, and `await connect(...)` has
none to offer. A background task (`_Host`) holds the block, and ends when it is told to. It does not
reference what the caller has: the `KeptConnection`, and the endpoints and goals that were made with
it. When the last of those is garbage collected, the connection closes, with a ResourceWarning, as a
file does.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import Any

from anyio import CancelScope, Event, get_cancelled_exc_class
from anyio.lowlevel import current_token

from fibaction._runtime.own_thread import OwnThread
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint, Transport
from fibaction.border.detached import start_outside
from fibaction.client.goal import Blocks, leave_blocks
from fibaction.types.action import Action, ActionInfo
from fibaction.words.goals import ActionPeers, WorkerInfo


class _Host:
    """The task that holds the block of a connection."""

    def __init__(self, transport: Transport) -> None:
        self.blocks: Blocks = {}
        """The open blocks of goals, which are canceled before the connection is closed."""
        self.connection: Connection
        self.error: BaseException | None = None
        self.opened, self.ended = Event(), Event()
        self.is_closing = False
        self._closing = Event()
        self._scope = CancelScope()
        self._transport = transport
        self._token = current_token()

    async def run(self) -> None:
        """Hold the connection open."""
        try:
            with self._scope:
                async with self._transport.connect() as self.connection:
                    self.opened.set()
                    try:
                        await self._closing.wait()
                    finally:
                        with CancelScope(shield=True):
                            await leave_blocks(self.blocks)
        except get_cancelled_exc_class():
            raise  # the event loop itself ends
        except BaseException as exc:
            self.error = exc
        finally:
            self.is_closing = True
            self.ended.set()
            self.opened.set()

    def close(self) -> None:
        """Let the task end."""
        self.is_closing = True
        self._closing.set()

    def close_soon(self) -> None:
        """Let the task end, from any thread."""
        with suppress(RuntimeError):  # the event loop has ended
            self._token.backend_class.run_sync_soon(self.close, (), self._token.native_token)

    async def cancel(self) -> None:
        """End the task before the connection is open."""
        self._scope.cancel()
        with CancelScope(shield=True):
            await self.ended.wait()


class KeptConnection(Connection):
    """A connection that is open until `aclose`, or until it is garbage collected."""

    def __init__(self, host: _Host) -> None:
        self._host = host
        self._thread = OwnThread()
        self.blocks = host.blocks
        """The open blocks of goals, which `aclose` cancels."""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return KeptEndpoint(self._host.connection.endpoint(action), self)

    async def actions(self) -> list[ActionInfo]:
        return await self._host.connection.actions()

    async def peers(self, action: str) -> ActionPeers:
        return await self._host.connection.peers(action)

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        return await self._host.connection.interface_texts(action)

    async def nodes(self) -> set[str]:
        return await self._host.connection.nodes()

    async def workers(self) -> list[WorkerInfo]:
        return await self._host.connection.workers()

    async def aclose(self) -> None:
        """Cancel the goals of blocks, close the connection, and wait until it is closed."""
        self._thread.check()
        self._host.close()
        await self._host.ended.wait()

    def __del__(self) -> None:
        if not self._host.is_closing:
            warnings.warn(
                "a connection of `await connect(...)` was not closed: call `await client.aclose()`",
                ResourceWarning,
                source=self,
                stacklevel=1,
            )
            self._host.close_soon()


class KeptEndpoint(ForwardingEndpoint):
    """An endpoint that keeps its connection from being collected while it is used."""

    def __init__(self, inner: Endpoint, connection: KeptConnection) -> None:
        super().__init__(inner)
        self.connection = connection
        """The connection that the endpoint belongs to."""


async def keep_open(transport: Transport) -> KeptConnection:
    """Open a connection that needs no block.

    Raises:
        ActionError: As for `Transport.connect`.
    """
    host = _Host(transport)
    start_outside(host.run, "fibaction connection")
    try:
        await host.opened.wait()
    except BaseException:
        await host.cancel()
        raise
    if host.error is not None:
        try:
            raise host.error
        finally:
            del host  # the traceback of its error references this frame
    return KeptConnection(host)
