"""`McpBridge`: the actions of servers as tools of a Model Context Protocol server, in a program."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from contextlib import asynccontextmanager
from typing import Any, Self

from anyio import AsyncContextManagerMixin
from mcp.server import Server

from fibaction.border.abc import Transport
from fibaction.observe.followed_servers import FollowedServers
from fibaction_transports._agents.agent_policy import AgentPolicy
from fibaction_transports.mcp.mcp_transport import stdio_streams
from fibaction_transports.mcp.tool_server import ToolServer


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
