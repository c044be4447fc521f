"""`KeptConnection`: a connection that is open until it is closed, without a block.

A background task holds its block: see `KeptBlock`. When the last endpoint or goal that was made
with it is garbage collected, the connection closes, with a ResourceWarning, as a file does.
"""

from __future__ import annotations

import warnings
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from anyio import CancelScope

from fibaction._runtime.own_thread import OwnThread
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint, Transport
from fibaction.client.goal import Blocks, leave_blocks
from fibaction.client.kept_block import KeptBlock
from fibaction.types.action import Action, ActionInfo
from fibaction.words.goals import ActionPeers, WorkerInfo


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
