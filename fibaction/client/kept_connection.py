"""`KeptConnection`: a connection that is open until it is closed, without a block.

Connections and servers have tasks, so their blocks must be entered and left in one task, and
`await connect(...)` has none to offer. A background task enters the block (`KeptBlock`), and leaves
it when it is told to. It does not reference what the caller has: when the last endpoint or goal
that was made with a connection is garbage collected, the connection closes, with a ResourceWarning,
as a file does.
"""

from __future__ import annotations

import warnings
from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from typing import Any, Generic, TypeVar

from anyio import CancelScope, Event, get_cancelled_exc_class
from anyio.lowlevel import current_token

from fibaction._runtime.async_only import OwnThread
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint, Transport
from fibaction.border.detached import start_outside
from fibaction.client.goal import Blocks, leave_blocks
from fibaction.types.action import Action, ActionInfo
from fibaction.words.goals import ActionPeers, WorkerInfo

T = TypeVar("T")


class KeptBlock(Generic[T]):
    """The background task of one block."""

    def __init__(self, block: AbstractAsyncContextManager[T]) -> None:
        self.value: T
        """The value of the block, once it is open."""
        self.error: BaseException | None = None
        """The error with which the block has ended; None if it has none."""
        self.ended = Event()
        self.is_closing = False
        """True if the block was told to end, or has ended by itself."""
        self._block = block
        self._opened, self._closing = Event(), Event()
        self._scope = CancelScope()
        self._token = current_token()

    async def open(self, name: str) -> None:
        """Enter the block in a task of that name.

        Raises:
            Exception: As the block does.
        """
        start_outside(self._run, name)
        try:
            await self._opened.wait()
        except BaseException:
            self._scope.cancel()
            with CancelScope(shield=True):
                await self.ended.wait()
            raise
        if self.error is not None:
            try:
                raise self.error
            finally:
                del self  # the traceback of its error references this frame

    async def _run(self) -> None:
        try:
            with self._scope:
                async with self._block as self.value:
                    self._opened.set()
                    await self._closing.wait()
        except get_cancelled_exc_class():
            raise  # the event loop itself ends
        except BaseException as exc:
            self.error = exc
        finally:
            self.is_closing = True
            self.ended.set()
            self._opened.set()

    def close(self) -> None:
        """Let the block end."""
        self.is_closing = True
        self._closing.set()

    def close_soon(self) -> None:
        """Let the block end, from any thread."""
        with suppress(RuntimeError):  # the event loop has ended
            self._token.backend_class.run_sync_soon(self.close, (), self._token.native_token)


@asynccontextmanager
async def _connected(transport: Transport, blocks: Blocks) -> AsyncGenerator[Connection, None]:
    """Connect, and cancel the goals of open blocks before the end."""
    async with transport.connect() as connection:
        try:
            yield connection
        finally:
            with CancelScope(shield=True):
                await leave_blocks(blocks)


class KeptConnection(Connection):
    """A connection that is open until `aclose`, or until it is garbage collected."""

    def __init__(self, block: KeptBlock[Connection], blocks: Blocks) -> None:
        self._block = block
        self._thread = OwnThread()
        self.blocks = blocks
        """The open blocks of goals, which `aclose` cancels."""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return KeptEndpoint(self._block.value.endpoint(action), self)

    async def actions(self) -> list[ActionInfo]:
        return await self._block.value.actions()

    async def peers(self, action: str) -> ActionPeers:
        return await self._block.value.peers(action)

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        return await self._block.value.interface_texts(action)

    async def nodes(self) -> set[str]:
        return await self._block.value.nodes()

    @property
    def release(self) -> str:
        return self._block.value.release

    async def workers(self) -> list[WorkerInfo]:
        return await self._block.value.workers()

    async def aclose(self) -> None:
        """Cancel the goals of blocks, close the connection, and wait until it is closed."""
        self._thread.check()
        self._block.close()
        await self._block.ended.wait()

    def __del__(self) -> None:
        if not self._block.is_closing:
            warnings.warn(
                "a connection of `await connect(...)` was not closed: call `await client.aclose()`",
                ResourceWarning,
                source=self,
                stacklevel=1,
            )
            self._block.close_soon()


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
    blocks: Blocks = {}
    block = KeptBlock(_connected(transport, blocks))
    await block.open("fibaction connection")
    return KeptConnection(block, blocks)
