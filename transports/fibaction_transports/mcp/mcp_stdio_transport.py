"""`mcp+stdio://`: MCP over stdin and stdout of this process, which its client has started."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, Unpack
from urllib.parse import SplitResult

import anyio
from anyio.abc import TaskStatus
from mcp.server import Server

from fibaction.border.event_loop import Background
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_keywords import PolicyKeywords
from fibaction_transports.mcp.mcp_transport import McpTransport
from fibaction_transports.mcp.stdio_streams import stdio_streams

STDIO_URL = "mcp+stdio://"


class McpStdioTransport(McpTransport):
    """MCP over stdin and stdout, for one client, which starts the process.

    For example:

        transport = McpStdioTransport(unasked=("look",))
        async with serve(ActionServer(LOOK, look), transport):
            await transport.wait_end()
    """

    def __init__(self, **settings: Unpack[PolicyKeywords]) -> None:
        """Take the rules for what an agent may do: see `AgentPolicy`.

        Raises:
            TypeError: There is no such setting.
            ValueError: The patience is not a number of seconds, or a pattern is empty.
        """
        super().__init__(**settings)
        self._ended = anyio.Event()

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Check that there is no address.

        Raises:
            ValueError: There is one.
        """
        if parts.netloc or parts.path:
            raise ValueError(f"it has no host and no path: write {STDIO_URL}")
        return {}

    @property
    def url(self) -> str:
        return STDIO_URL

    async def wait_end(self) -> None:
        """Wait until the client closes stdin."""
        await self._ended.wait()

    @asynccontextmanager
    async def offer(self, server: Server[Any]) -> AsyncGenerator[str, None]:
        async with Background() as tasks:
            try:
                await tasks.start(self._run, server)
            except RuntimeError as exc:
                raise TransportError(f"{STDIO_URL} is served already by this process") from exc
            yield STDIO_URL

    async def _run(self, server: Server[Any], *, task_status: TaskStatus[None]) -> None:
        # The streams are left by a cancellation only, while their reader waits for a line.
        async with stdio_streams() as (messages, answers):
            task_status.started()
            await server.run(messages, answers, server.create_initialization_options())
        self._ended.set()
