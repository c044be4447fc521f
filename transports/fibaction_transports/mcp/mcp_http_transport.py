"""`mcp+http://host:port` and `mcp+https://host:port`: MCP over HTTP ("streamable HTTP")."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager
from typing import Any, ClassVar

from mcp.server import Server
from mcp.server.transport_security import TransportSecuritySettings

from fibaction_transports._agents.agent_http_transport import AgentHttpTransport
from fibaction_transports.mcp.mcp_transport import McpTransport

PATH = "/mcp"


class McpHttpTransport(AgentHttpTransport, McpTransport):
    """MCP over HTTP, with or without TLS, for any number of clients. It runs on asyncio only.

    Each client needs a token, so that no other user of the machine can move a robot.
    """

    schemes: ClassVar[tuple[str, str]] = ("mcp+http", "mcp+https")
    tls_schemes: ClassVar[tuple[str, ...]] = ("mcp+https",)
    default_port: ClassVar[int] = 8090

    def offer(self, server: Server[Any]) -> AbstractAsyncContextManager[str]:
        # The rules of this transport are stricter.
        off = TransportSecuritySettings(enable_dns_rebinding_protection=False)
        app = server.streamable_http_app(
            streamable_http_path=PATH, transport_security=off, host=self.host
        )
        return self.serve_app(app, PATH)
