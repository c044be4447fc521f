"""`ToolAction`: an action as a tool."""

from __future__ import annotations

from fibaction.border.abc import Connection
from fibaction.client.client import ActionClient
from fibaction.types.action import Action, ActionInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.robot_actions import RobotAction, RobotActions
from fibaction_transports.mcp.tools.tool_schema import tool_input, tool_output


class ToolAction(RobotAction):
    """One action that is served now, and its tool, whose name is the label."""

    def __init__(self, server: str, info: ActionInfo, connection: Connection, label: str):
        super().__init__(server, info, connection, label)
        self.input = tool_input(info.goal)
        self.output = tool_output(info.result, (status.name for status in GoalStatus))
        self.client = ActionClient(self.endpoint, Action.untyped(info))


ToolActions = RobotActions[ToolAction]
