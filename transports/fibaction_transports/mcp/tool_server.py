"""`ToolServer`: the actions of a group of servers as tools of a server of the SDK."""

from __future__ import annotations

from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from mcp.server import NotificationOptions, Server
from mcp.server.context import ServerRequestContext
from mcp.server.models import InitializationOptions
from mcp_types import (
    CancelTaskRequestParams,
    GetTaskRequestParams,
    ListToolsResult,
    PaginatedRequestParams,
)

from fibaction import __version__
from fibaction.border.gateway import ServerGroup
from fibaction_transports._agents.agent_goals import AgentGoals
from fibaction_transports._agents.agent_policy import AgentPolicy
from fibaction_transports.mcp.calls import ToolCalls
from fibaction_transports.mcp.goal_resources import GoalChanges, GoalResources
from fibaction_transports.mcp.goal_tasks import EXTENSION, GoalTasks, UpdateTaskParams
from fibaction_transports.mcp.list_changes import ListChanges
from fibaction_transports.mcp.tool_list import (
    CANCEL,
    SEND,
    STATUS,
    ToolAction,
    ToolActions,
    instructions,
    tool_list,
)

MOST_PIECES = 256
"""Feedback messages of a goal that are kept, for the pieces of a text."""


class _McpServer(Server[object]):
    """A server whose list of tools changes, which it tells every client."""

    def create_initialization_options(
        self,
        notification_options: NotificationOptions | None = None,
        experimental_capabilities: dict[str, dict[str, Any]] | None = None,
        extensions: dict[str, dict[str, Any]] | None = None,
    ) -> InitializationOptions:
        return super().create_initialization_options(
            notification_options or NotificationOptions(tools_changed=True),
            experimental_capabilities,
            extensions,
        )


class ToolServer:
    """The tools for a group of servers, which can be called while the block lasts."""

    def __init__(self, group: ServerGroup, policy: AgentPolicy) -> None:
        self._policy = policy
        self._actions = ToolActions(group, policy, ToolAction, (SEND, STATUS, CANCEL))
        self._changes = ListChanges()
        self._goal_changes = GoalChanges(self._changes)
        self._goals = AgentGoals(
            self._actions, most_kept=MOST_PIECES, on_change=self._goal_changes.note
        )
        self._calls = ToolCalls(self._actions, self._goals, policy)
        resources = GoalResources(self._goals)
        self._block: AsyncExitStack
        self.server: Server[Any] = _McpServer(
            "fibaction",
            version=__version__,
            title="Actions",
            instructions=instructions(policy),
            lifespan=lambda _: self._changes.connection(),
            on_list_tools=self._list_tools,
            on_call_tool=self._calls.call,
            on_list_resources=resources.running,
            on_list_resource_templates=resources.templates,
            on_read_resource=resources.read,
            on_subscriptions_listen=self._changes.listen,
        )
        """The server of the SDK."""
        tasks = GoalTasks(self._goals, policy, self._calls.asked)
        self.server.extensions[EXTENSION] = {}
        self.server.add_request_handler("tasks/get", GetTaskRequestParams, tasks.get)
        self.server.add_request_handler("tasks/update", UpdateTaskParams, tasks.update)
        self.server.add_request_handler("tasks/cancel", CancelTaskRequestParams, tasks.cancel)

    @property
    def names(self) -> list[str]:
        """The names of the tools, in the order of the list."""
        return [tool.name for tool in tool_list(self._actions.by_label, self._policy)]

    async def __aenter__(self) -> Self:
        """Begin to follow the goals that are sent, and the list of tools."""
        async with AsyncExitStack() as stack:
            tasks = await stack.enter_async_context(self._goals.followed())
            tasks.start_soon(self._goal_changes.tell)
            tasks.start_soon(self._tell_changes)
            self._block = stack.pop_all()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Follow the goals no longer; they continue at their servers."""
        await self._block.__aexit__(exc_type, exc, traceback)

    async def _tell_changes(self) -> None:
        while True:
            await self._actions.news.wait()
            await self._changes.tell()

    async def _list_tools(
        self, context: ServerRequestContext[Any, Any], _: PaginatedRequestParams | None
    ) -> ListToolsResult:
        self._changes.note(context)
        return ListToolsResult(tools=tool_list(self._actions.by_label, self._policy))
