"""The overview of servers, actions and goals that `goal_status` gives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

from fibaction.border.peer_text import excerpt
from fibaction.words.goals import GoalInfo
from fibaction_transports.mcp.tools.tool_actions import ToolAction

MOST_GOALS = 20
"""Goals of one action that are listed: the newest ones."""


def overview(
    problems: Mapping[str, str],
    actions: Iterable[ToolAction],
    goals: Mapping[ToolAction, list[GoalInfo]],
) -> dict[str, Any]:
    """Return the servers with their problems, and the actions with their newest goals."""
    return {
        "servers": [_server(name, problem) for name, problem in problems.items()],
        "actions": [_action(one, goals.get(one)) for one in actions],
    }


def _server(name: str, problem: str) -> dict[str, Any]:
    told: dict[str, Any] = {"name": name} if name else {}
    told["reachable"] = not problem
    return {**told, "problem": problem} if problem else told


def _action(action: ToolAction, goals: list[GoalInfo] | None) -> dict[str, Any]:
    told: dict[str, Any] = {"tool": action.label, "action": excerpt(action.info.name)}
    if action.server:
        told["server"] = action.server
    if goals is None:
        return {**told, "problem": "its server does not tell its goals"}
    newest = sorted(goals, key=lambda info: info.stamp, reverse=True)[:MOST_GOALS]
    return {**told, "goals": [_goal(info) for info in newest], "goal_count": len(goals)}


def _goal(info: GoalInfo) -> dict[str, Any]:
    accepted = datetime.fromtimestamp(info.stamp // 10**9, UTC)
    told: dict[str, Any] = {
        "goal_id": str(info.goal_id),
        "status": info.status.name,
        "accepted": accepted.isoformat(),
        "feedback_count": info.feedback_count,
    }
    if info.parent is not None:
        step = excerpt(info.parent.step)
        told["parent"] = {"goal_id": str(info.parent.goal_id), "step": step}
    return {**told, "client": excerpt(info.client)} if info.client else told
