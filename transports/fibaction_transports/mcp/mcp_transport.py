"""`McpTransport`: the base of the transports of MCP, and the one over HTTP.

Its URLs are `mcp+http://host:port` and `mcp+https://host:port` ("streamable HTTP").
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, ClassVar

import anyio
from anyio.abc import TaskStatus
from mcp.server import Server
from mcp.server.transport_security import TransportSecuritySettings

from fibaction.border.event_loop import Background
from fibaction.border.gateway import Gateway, ServerGroup
from fibaction_transports._agents.agent_http_transport import AgentHttpTransport
from fibaction_transports._agents.agent_transport import AgentGateway, AgentTransport
from fibaction_transports._agents.document_app import LARGEST_REST, DocumentApp
from fibaction_transports.mcp.arguments import take_arguments
from fibaction_transports.mcp.tool_server import ToolServer

PATH = "/mcp"


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
