"""`McpBridge`: the actions of servers as tools of a Model Context Protocol server."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from mcp.server import NotificationOptions, Server
from mcp.server.context import ServerRequestContext
from mcp.server.models import InitializationOptions
from mcp_types import (
    CallToolRequestParams,
    CallToolResult,
    InputRequiredResult,
    ListToolsResult,
    PaginatedRequestParams,
)

from fibaction import __version__
from fibaction._runtime.tasks import Background
from fibaction.agents._agent_goals import AgentGoals
from fibaction.agents._list_changes import ListChanges
from fibaction.agents._robot_actions import RobotActions
from fibaction.agents._stdio_streams import stdio_streams
from fibaction.agents._tool_calls import ToolCalls
from fibaction.agents._tool_list import instructions, tool_list
from fibaction.agents.agent_policy import AgentPolicy
from fibaction.border.abc import Transport
from fibaction.border.urls import transport_for
from fibaction_transports.mcp._agent_goals import AgentGoals
from fibaction_transports.mcp._list_changes import ListChanges
from fibaction_transports.mcp._robot_actions import RobotActions
from fibaction_transports.mcp._stdio_streams import stdio_streams
from fibaction_transports.mcp._tool_calls import ToolCalls
from fibaction_transports.mcp._tool_list import instructions, tool_list
from fibaction_transports.mcp.agent_policy import AgentPolicy


def check_servers(servers: Mapping[str, str | Transport]) -> None:
    """Check the names and the addresses of servers. The name of a single one may be empty.

    Raises:
        TransportError: An address cannot be used; the text says why.
        ValueError: A name is not made of letters, digits and `_`, or there is no server.
    """
    if not servers:
        raise ValueError("a bridge needs at least one server")
    for name, where in servers.items():
        if not re.fullmatch(r"\w+", name, re.ASCII) and (name or len(servers) > 1):
            raise ValueError(f"the name of a server has letters, digits and _, not {name!r}")
        transport_for(where)


class _McpServer(Server[object]):
    """A server whose list of tools changes, which it tells every client."""

    def create_initialization_options(
        self,
        notification_options: NotificationOptions | None = None,
        experimental_capabilities: dict[str, dict[str, Any]] | None = None,
        extensions: dict[str, dict[str, Any]] | None = None,
    ) -> InitializationOptions:
        return super().create_initialization_options(
            notification_options or NotificationOptions(tools_changed=True),
            experimental_capabilities,
            extensions,
        )


class McpBridge:
    """A bridge from language models to actions, while its block lasts.

    Each action is a tool, with the schema of its goals. `server` is the server of the official SDK,
    to be run over stdio, HTTP or in memory. Goals whose tool a client cancels, or whose client goes
    while it waits, are canceled; those of `send_goal` go on.

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
        check_servers(named)
        self.policy = policy or AgentPolicy()
        """The rules for what a model may do."""
        self._actions = RobotActions(named, self.policy)
        self._changes = ListChanges()
        self._calls: ToolCalls
        self._block: AsyncExitStack
        self.server: Server[Any] = _McpServer(
            "fibaction",
            version=__version__,
            title="Actions",
            instructions=instructions(self.policy),
            lifespan=lambda _: self._changes.connection(),
            on_list_tools=self._list_tools,
            on_call_tool=self._call_tool,
            on_subscriptions_listen=self._changes.listen,
        )
        """The server of the SDK."""

    @property
    def tools(self) -> list[str]:
        """The names of the tools, in the order of the list."""
        return [tool.name for tool in tool_list(self._actions.tools, self.policy)]

    @property
    def problems(self) -> dict[str, str]:
        """For each server that cannot be reached now, by its name, the reason."""
        return {name: text for name, text in self._actions.problems.items() if text}

    async def __aenter__(self) -> Self:
        """Connect to the servers; those that are not there are waited for, in the background."""
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(self._actions.followed())
            tasks = await stack.enter_async_context(Background())
            self._calls = ToolCalls(self._actions, AgentGoals(tasks), self.policy)
            tasks.start_soon(self._tell_changes)
            self._block = stack.pop_all()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the servers; goals that run there go on."""
        await self._block.__aexit__(exc_type, exc, traceback)

    async def run_stdio(self) -> None:
        """Serve one client over stdin and stdout, until it closes stdin.

        Raises:
            RuntimeError: Something else serves over them already.
        """
        async with stdio_streams() as (messages, answers):
            await self.server.run(messages, answers, self.server.create_initialization_options())

    async def _tell_changes(self) -> None:
        while True:
            await self._actions.news.wait()
            await self._changes.tell()

    async def _list_tools(
        self, context: ServerRequestContext[Any, Any], _: PaginatedRequestParams | None
    ) -> ListToolsResult:
        self._changes.note(context)
        return ListToolsResult(tools=tool_list(self._actions.tools, self.policy))

    async def _call_tool(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> CallToolResult | InputRequiredResult:
        return await self._calls.call(context, params)
