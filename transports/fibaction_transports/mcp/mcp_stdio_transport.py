"""`mcp+stdio://`: MCP over stdin and stdout of this process, which its client has started.

The reader of the SDK waits for a line in a thread, and cannot be canceled meanwhile: a signal would
end the program only when the client sends something. So the reader here can be canceled.
"""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Unpack, cast
from urllib.parse import SplitResult

import anyio
from anyio import AsyncFile, to_thread
from anyio.abc import TaskStatus
from mcp.server import Server
from mcp.server.stdio import stdio_server

from fibaction.border.event_loop import Background
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_policy import AgentPolicy
from fibaction_transports.mcp.mcp_transport import McpTransport

if TYPE_CHECKING:
    from fibaction_transports.keywords import AgentPolicyKeywords

STDIO_URL = "mcp+stdio://"
HALF_CHARACTER = "\\ud"
"""The begin of an escape in JSON text that may be half of a character."""


class McpStdioTransport(McpTransport):
    """MCP over stdin and stdout, for one client, which starts the process.

    For example:

        transport = McpStdioTransport(unasked=("look",))
        async with serve(ActionServer(LOOK, look), transport):
            await transport.wait_end()
    """

    def __init__(self, **settings: Unpack[AgentPolicyKeywords]) -> None:
        """Take the rules for what an agent may do: see `AgentPolicy`.

        Raises:
            TypeError: There is no such setting.
            ValueError: The patience is not a number of seconds, or a pattern is empty.
        """
        super().__init__(AgentPolicy.of(self, settings))
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


class _Lines:
    """The lines of stdin. After a cancellation, a thread may still wait for one."""

    def __init__(self) -> None:
        self._read = sys.stdin.buffer.readline

    def __aiter__(self) -> _Lines:
        return self

    async def __anext__(self) -> str:
        line: bytes = await to_thread.run_sync(self._read, abandon_on_cancel=True)
        if not line:
            raise StopAsyncIteration
        text = line.decode(errors="replace")
        return _with_whole_characters(text) if HALF_CHARACTER in text.lower() else text


def _with_whole_characters(line: str) -> str:
    """Return a message without escapes of lone surrogates: the SDK would drop it, and the client
    would wait for its answer.
    """
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return line
    return json.dumps(message, ensure_ascii=False).encode(errors="replace").decode()


@asynccontextmanager
async def stdio_streams() -> AsyncGenerator[tuple[Any, Any], None]:
    """Give the streams of messages and of answers.

    Meanwhile, what else is written to stdout goes to stderr, so that it does not disturb.

    Raises:
        RuntimeError: Something else serves over stdout already.
    """
    async with stdio_server(stdin=cast("AsyncFile[str]", _Lines())) as streams:
        yield streams
