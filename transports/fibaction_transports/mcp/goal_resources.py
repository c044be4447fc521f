"""`GoalResources`: goals that run, as resources that a client lists, reads and watches.

The resource of a goal is `goal://ID`. Its text is the data that `goal_status` tells. The goals of
all clients are listed while they run, and can be read for as long as a server knows them.

A client without a handshake may subscribe. It is told of the goals that the bridge follows, which
are those that it has sent, and those that someone has asked about: at most once in `PERIOD`.
"""

from __future__ import annotations

import anyio
from mcp.server.subscriptions import ResourcesListChanged, ResourceUpdated
from mcp.shared.exceptions import MCPError
from mcp_types import (
    ListResourcesResult,
    ListResourceTemplatesResult,
    ReadResourceResult,
    Resource,
    ResourceTemplate,
    TextResourceContents,
)
from mcp_types.jsonrpc import INVALID_PARAMS

from fibaction.words.goals import GoalID
from fibaction_transports.mcp.list_changes import ListChanges
from fibaction_transports.mcp.tools.agent_goals import AgentGoals, goals_of
from fibaction_transports.mcp.tools.answers import goal_answer, json_text
from fibaction_transports.mcp.tools.tool_actions import ToolActions
from fibaction_transports.mcp.tools.tool_error import ToolError

SCHEME = "goal://"
MOST_LISTED = 100
"""Goals that are listed: the newest ones."""
PERIOD = 1.0
"""Seconds between two notifications about the same goal, at least."""
JSON = "application/json"


class GoalResources:
    """The resources of one bridge."""

    def __init__(self, actions: ToolActions, goals: AgentGoals) -> None:
        self._actions = actions
        self._goals = goals

    async def running(self) -> ListResourcesResult:
        """List the goals that run."""
        found = await goals_of(list(self._actions.by_label.values()))
        running = [
            (info.stamp, action, info)
            for action, infos in found.items()
            for info in infos
            if not info.status.is_terminal
        ]
        newest = sorted(running, key=lambda one: one[0], reverse=True)[:MOST_LISTED]
        resources = [
            Resource(
                uri=f"{SCHEME}{info.goal_id}",
                name=f"{action.label} {str(info.goal_id)[:8]}",
                title=f"A goal of {action.title}",
                description=f"{info.status.name}; {info.feedback_count} feedback messages so far.",
                mime_type=JSON,
            )
            for _, action, info in newest
        ]
        return ListResourcesResult(resources=resources)

    def templates(self) -> ListResourceTemplatesResult:
        """Tell how the address of a goal is made."""
        template = ResourceTemplate(
            uri_template=f"{SCHEME}{{goal_id}}",
            name="goal",
            title="A goal",
            description="The status of a goal, its newest feedback, and its result at the end.",
            mime_type=JSON,
        )
        return ListResourceTemplatesResult(resource_templates=[template])

    async def read(self, uri: str) -> ReadResourceResult:
        """Tell about a goal.

        Raises:
            MCPError: There is no such goal.
        """
        try:
            if not uri.startswith(SCHEME):
                raise ValueError(f"the address of a goal is {SCHEME}ID")
            goal_id = GoalID.parse(uri.removeprefix(SCHEME))
            goal = await self._goals.find(goal_id, list(self._actions.by_label.values()))
        except (ValueError, ToolError) as exc:
            raise MCPError(INVALID_PARAMS, f"there is no such resource: {exc}") from exc
        text = json_text(goal_answer(goal).structured_content)
        told = TextResourceContents(uri=uri, mime_type=JSON, text=text)
        return ReadResourceResult(contents=[told])

    async def tell_changes(self, changes: ListChanges) -> None:
        """Tell the clients that watch when goals change, until canceled."""
        while True:
            while not self._goals.has_changes:
                await self._goals.news.wait()
            changed, is_other_list = self._goals.take_changes()
            for goal_id in changed:
                await changes.publish(ResourceUpdated(uri=f"{SCHEME}{goal_id}"))
            if is_other_list:
                await changes.publish(ResourcesListChanged())
            await anyio.sleep(PERIOD)
