"""Actions as tools of language models, by the Model Context Protocol; with the extra `mcp`.

`fibaction mcp URL` is this as a program. For example, in a test:

    from mcp import Client

    from fibaction_transports.mcp import AgentPolicy, McpBridge

    policy = AgentPolicy(unasked=("look",))
    async with McpBridge("tcp://127.0.0.1:7400", policy) as bridge, Client(bridge.server) as client:
        print(await client.call_tool("look", {"at": "door"}))
"""

from fibaction_transports.mcp.agent_policy import AgentPolicy as AgentPolicy
from fibaction_transports.mcp.mcp_bridge import McpBridge as McpBridge

__all__ = ["AgentPolicy", "McpBridge"]
