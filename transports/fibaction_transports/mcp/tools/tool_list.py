"""The tools of a bridge, as clients list them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mcp_types import Tool, ToolAnnotations

from fibaction.border.peer_text import excerpt, shortened
from fibaction_transports._agents.agent_policy import AgentPolicy
from fibaction_transports.mcp.tools.tool_actions import ToolAction
from fibaction_transports.mcp.tools.tool_names import CANCEL, SEND, STATUS
from fibaction_transports.mcp.tools.tool_schema import GOAL

LONGEST_DESCRIPTION = 1000
"""Characters of a description that a server gives."""

INSTRUCTIONS = """\
These tools send goals to machines: robots, devices, long jobs. A goal may move something, so send \
one only if the user wants it, and never the same one again without a reason.
A tool answers when its goal has ended, or after {patience:g} s with the note that it still runs: \
then call goal_status with its goal_id, or cancel_goal to stop it. An error says why, for example \
why the goal was rejected."""
READ_ONLY = "You can look at the goals of machines here with goal_status, and send none."

_GOAL_ID = {"type": "string", "description": "The goal's ID, 32 hexadecimal digits."}


def instructions(policy: AgentPolicy) -> str:
    """Return the text that introduces the tools to the model."""
    return READ_ONLY if policy.read_only else INSTRUCTIONS.format(patience=policy.patience)


def tool_list(actions: Mapping[str, ToolAction], policy: AgentPolicy) -> list[Tool]:
    """Return all tools, in an order that does not change."""
    if policy.read_only:
        return [_status_tool(policy)]
    own = [_action_tool(actions[name], policy) for name in sorted(actions)]
    return [*own, _send_tool(sorted(actions)), _status_tool(policy), _cancel_tool(policy)]


def _action_tool(action: ToolAction, policy: AgentPolicy) -> Tool:
    info = action.info
    kind = f", of the type {excerpt(info.type_name)}" if info.type_name else ""
    text = f"Send a goal to the action {action.title}{kind}, and wait for its result."
    described: Any = action.input.schema.get("description", "")
    if isinstance(described, str) and described:
        text += f" {shortened(described, LONGEST_DESCRIPTION)}"
    if policy.asks(action.server, info.name):
        text += " The user is asked before the goal is sent."
    return Tool(
        name=action.label,
        title=action.title,
        description=text,
        input_schema=action.input.schema,
        output_schema=action.output,
        annotations=_moves(),
    )


def _send_tool(names: list[str]) -> Tool:
    tool: dict[str, Any] = {"type": "string", "description": "The name of the action's tool."}
    if names:
        tool["enum"] = names
    return Tool(
        name=SEND,
        title="Send a goal",
        description=(
            f"Send a goal that takes long, and answer at once with its goal_id. Follow it with"
            f" {STATUS}, stop it with {CANCEL}."
        ),
        input_schema=_object(
            {
                "tool": tool,
                GOAL: {"description": "The input of that tool.", "type": "object"},
            },
            required=["tool", GOAL],
        ),
        annotations=_moves(),
    )


def _status_tool(policy: AgentPolicy) -> Tool:
    return Tool(
        name=STATUS,
        title="Goal status",
        description=(
            "Tell how a goal is doing, with its newest feedback, and its result when it has ended."
            " Without a goal_id, list the servers, their actions and the goals of all clients."
        ),
        input_schema=_object({"goal_id": _GOAL_ID, "wait": _wait(policy, 0)}),
        annotations=ToolAnnotations(read_only_hint=True, open_world_hint=False),
    )


def _cancel_tool(policy: AgentPolicy) -> Tool:
    return Tool(
        name=CANCEL,
        title="Cancel a goal",
        description=(
            "Stop a goal before its end. The user is asked if you have not sent it yourself."
        ),
        input_schema=_object({"goal_id": _GOAL_ID, "wait": _wait(policy, 5)}, required=["goal_id"]),
        annotations=ToolAnnotations(
            read_only_hint=False, destructive_hint=True, idempotent_hint=True, open_world_hint=False
        ),
    )


def _wait(policy: AgentPolicy, default: float) -> dict[str, Any]:
    return {
        "type": "number",
        "minimum": 0,
        "maximum": policy.patience,
        "default": min(default, policy.patience),
        "description": "Seconds to wait for the end of the goal.",
    }


def _object(properties: dict[str, Any], required: list[str] | None = None) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "object", "properties": properties}
    if required:
        schema["required"] = required
    return {**schema, "additionalProperties": False}


def _moves() -> ToolAnnotations:
    return ToolAnnotations(
        read_only_hint=False, destructive_hint=True, idempotent_hint=False, open_world_hint=True
    )
