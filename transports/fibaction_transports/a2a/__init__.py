"""Actions as skills of an agent, by the Agent2Agent protocol (A2A 1.0); with the extra `a2a`.

`a2a+http://host:port` is its URL, and `fibaction bridge` serves it in front of any server.
"""

from importlib import import_module

from fibaction.words.extras import NeedsExtra

with NeedsExtra("fibaction_transports.a2a", "fibaction[a2a]"):
    import_module("a2a")  # before what the SDK needs itself, so that its own name is told
    from fibaction_transports._agents.robot_actions import AgentPolicy as AgentPolicy
    from fibaction_transports.a2a.a2a_http_transport import A2aHttpTransport as A2aHttpTransport

__all__ = ["A2aHttpTransport", "AgentPolicy"]
