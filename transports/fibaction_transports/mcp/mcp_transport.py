"""`McpTransport`: the part that MCP over stdio and over HTTP have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, ClassVar

from mcp.server import Server

from fibaction.border.gateway import Gateway, ServerGroup
from fibaction_transports._agents.agent_transport import AgentTransport
from fibaction_transports.mcp.tool_server import ToolServer


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
            yield _McpGateway(url, tools)


class _McpGateway(Gateway):
    """The tools of a gateway, and the URL where they are."""

    def __init__(self, url: str, tools: ToolServer) -> None:
        self._url = url
        self._tools = tools

    @property
    def url(self) -> str:
        return self._url

    @property
    def names(self) -> list[str]:
        return self._tools.names
