"""Actions as tools of language models, by the Model Context Protocol; with the extra `mcp`.

`fibaction mcp URL` is this as a program; `mcp+stdio://` and `mcp+http://host:port` are its URLs.
For example, in a test:

    from mcp import Client

    from fibaction_transports.mcp import AgentPolicy, McpBridge

    policy = AgentPolicy(unasked=("look",))
    async with McpBridge("tcp://127.0.0.1:7400", policy) as bridge, Client(bridge.server) as client:
        print(await client.call_tool("look", {"at": "door"}))
"""

from fibaction.words.extras import NeedsExtra

with NeedsExtra("fibaction_transports.mcp", "fibaction[mcp]"):
    from fibaction_transports._agents.robot_actions import AgentPolicy as AgentPolicy
    from fibaction_transports.mcp.mcp_transport import McpBridge as McpBridge
    from fibaction_transports.mcp.mcp_transport import McpHttpTransport as McpHttpTransport
    from fibaction_transports.mcp.mcp_transport import McpStdioTransport as McpStdioTransport
    from fibaction_transports.mcp.mcp_transport import McpTransport as McpTransport

__all__ = ["AgentPolicy", "McpBridge", "McpHttpTransport", "McpStdioTransport", "McpTransport"]
