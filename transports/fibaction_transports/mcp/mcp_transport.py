"""`McpTransport`: the base of the transports of MCP, and both of them; and `McpBridge`, which is a
server of MCP in a program that follows other servers.

- `mcp+http://host:port` and `mcp+https://host:port` ("streamable HTTP").
- `mcp+stdio://`: stdin and stdout of this process, which its client has started.

The reader of the SDK for stdin waits for a line in a thread, and cannot be canceled meanwhile: a
signal would end the program only when the client sends something. The reader here can be canceled.
"""

from __future__ import annotations

import json
import sys
from abc import abstractmethod
from collections.abc import AsyncGenerator, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Self, Unpack, cast
from urllib.parse import SplitResult

import anyio
from anyio import AsyncContextManagerMixin, AsyncFile, to_thread
from anyio.abc import TaskStatus
from mcp.server import Server
from mcp.server.stdio import stdio_server
from mcp.server.transport_security import TransportSecuritySettings

from fibaction.border.abc import Transport
from fibaction.border.event_loop import Background
from fibaction.border.gateway import Gateway, ServerGroup
from fibaction.observe.followed_servers import FollowedServers
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_http_transport import (
    LARGEST_REST,
    AgentGateway,
    AgentHttpTransport,
    AgentTransport,
    DocumentApp,
)
from fibaction_transports._agents.robot_actions import AgentPolicy
from fibaction_transports.mcp.tool_list import take_arguments
from fibaction_transports.mcp.tool_server import ToolServer

if TYPE_CHECKING:
    from fibaction_transports.keywords import AgentPolicyKeywords

PATH = "/mcp"
STDIO_URL = "mcp+stdio://"
HALF_CHARACTER = "\\ud"
"""The begin of an escape in JSON text that may be half of a character."""


class McpTransport(AgentTransport):
    """Actions as tools of language models, by the Model Context Protocol. It only serves."""

    clients: ClassVar[str] = "language models"

    @abstractmethod
    def offer(self, server: Server[Any]) -> AbstractAsyncContextManager[str]:
        """Let clients reach a server of the SDK for as long as the block lasts, which gets the URL.

        Raises:
            TransportError: The address cannot be used.
        """

    @asynccontextmanager
    async def serve_group(self, group: ServerGroup) -> AsyncGenerator[Gateway, None]:
        """See `GatewayTransport.serve_group`. The names are those of the tools."""
        async with ToolServer(group, self.policy) as tools, self.offer(tools.server) as url:
            yield AgentGateway(url, lambda: tools.names)


class McpHttpTransport(AgentHttpTransport, McpTransport):
    """MCP over HTTP, with or without TLS, for any number of clients. It runs on asyncio only.

    Each client needs a token, so that no other user of the machine can move a robot.
    """

    schemes: ClassVar[tuple[str, str]] = ("mcp+http", "mcp+https")
    tls_schemes: ClassVar[tuple[str, ...]] = ("mcp+https",)
    default_port: ClassVar[int] = 8090

    @asynccontextmanager
    async def offer(self, server: Server[Any]) -> AsyncGenerator[str, None]:
        # The rules of this transport are stricter.
        off = TransportSecuritySettings(enable_dns_rebinding_protection=False)
        app = server.streamable_http_app(
            streamable_http_path=PATH,
            max_request_body_size=LARGEST_REST,
            transport_security=off,
            host=self.host,
        )

        async def run(*, task_status: TaskStatus[None]) -> None:
            async with app.router.lifespan_context(app):
                task_status.started()
                await anyio.sleep_forever()

        async with Background() as tasks:  # a task of its own, so no error of the block is in it
            await tasks.start(run)
            async with self.serve_app(DocumentApp(app, take_arguments, 400), PATH) as url:
                yield url


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


class McpBridge(AsyncContextManagerMixin):
    """A bridge from language models to actions, while its block lasts.

    Each action is a tool, with the schema of its goals. `server` is the server of the official SDK,
    to be run over stdio, HTTP or in memory. Goals whose tool a client cancels, or whose client goes
    while it waits, are canceled; those of `send_goal` continue.

    For example:

        async with McpBridge("tcp://127.0.0.1:7400") as bridge:
            async with mcp.Client(bridge.server) as client:
                print(await client.list_tools())
    """

    def __init__(
        self,
        servers: str | Transport | Mapping[str, str | Transport],
        policy: AgentPolicy | None = None,
    ) -> None:
        """Take the address of a server, or the addresses of several by their names.

        Raises:
            TransportError: An address cannot be used; the text says why.
            ValueError: A name is not made of letters, digits and `_`.
        """
        named = servers if isinstance(servers, Mapping) else {"": servers}
        self.policy = policy or AgentPolicy()
        """The rules for what a model may do."""
        self._group = FollowedServers(named)
        self._tools = ToolServer(self._group, self.policy)

    @property
    def server(self) -> Server[Any]:
        """The server of the SDK."""
        return self._tools.server

    @property
    def tools(self) -> list[str]:
        """The names of the tools, in the order of the list."""
        return self._tools.names

    @property
    def problems(self) -> dict[str, str]:
        """For each server that cannot be reached now, by its name, the reason."""
        return {name: text for name, text in self._group.problems.items() if text}

    @asynccontextmanager
    async def __asynccontextmanager__(self) -> AsyncGenerator[Self, None]:
        """Connect to the servers; those that are not there are waited for, in the background. Goals
        that run there continue after the block.
        """
        async with self._group, self._tools:
            yield self

    async def run_stdio(self) -> None:
        """Serve one client over stdin and stdout, until it closes stdin.

        Raises:
            RuntimeError: Something else serves over them already.
        """
        async with stdio_streams() as (messages, answers):
            await self.server.run(messages, answers, self.server.create_initialization_options())
