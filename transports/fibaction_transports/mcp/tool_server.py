"""`ToolServer`: the actions of a group of servers as tools of a server of the SDK."""

from __future__ import annotations

from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from mcp.server import NotificationOptions, Server
from mcp.server.context import ServerRequestContext
from mcp.server.models import InitializationOptions
from mcp_types import (
    CallToolRequestParams,
    CancelTaskRequestParams,
    GetTaskRequestParams,
    ListResourcesResult,
    ListResourceTemplatesResult,
    ListToolsResult,
    PaginatedRequestParams,
    ReadResourceRequestParams,
    ReadResourceResult,
)

from fibaction import __version__
from fibaction.border.event_loop import Background
from fibaction.border.gateway import ServerGroup
from fibaction_transports._agents.agent_policy import AgentPolicy
from fibaction_transports.mcp.goal_resources import GoalResources
from fibaction_transports.mcp.list_changes import ListChanges
from fibaction_transports.mcp.tools.agent_goals import AgentGoals
from fibaction_transports.mcp.tools.calls import ToolCalls
from fibaction_transports.mcp.tools.goal_tasks import EXTENSION, GoalTasks, UpdateTaskParams
from fibaction_transports.mcp.tools.tool_actions import ToolAction, ToolActions
from fibaction_transports.mcp.tools.tool_list import instructions, tool_list
from fibaction_transports.mcp.tools.tool_names import CANCEL, SEND, STATUS

Context = ServerRequestContext[Any, Any]


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
        self._calls: ToolCalls
        self._tasks: GoalTasks
        self._resources: GoalResources
        self._block: AsyncExitStack
        self.server: Server[Any] = _McpServer(
            "fibaction",
            version=__version__,
            title="Actions",
            instructions=instructions(policy),
            lifespan=lambda _: self._changes.connection(),
            on_list_tools=self._list_tools,
            on_call_tool=self._call_tool,
            on_list_resources=self._list_resources,
            on_list_resource_templates=self._list_templates,
            on_read_resource=self._read_resource,
            on_subscriptions_listen=self._changes.listen,
        )
        """The server of the SDK."""
        self._serve_tasks(self.server)

    def _serve_tasks(self, server: Server[Any]) -> None:
        """Serve the methods of the extension for tasks."""
        server.extensions[EXTENSION] = {}
        server.add_request_handler("tasks/get", GetTaskRequestParams, self._get_task)
        server.add_request_handler("tasks/update", UpdateTaskParams, self._update_task)
        server.add_request_handler("tasks/cancel", CancelTaskRequestParams, self._cancel_task)

    @property
    def names(self) -> list[str]:
        """The names of the tools, in the order of the list."""
        return [tool.name for tool in tool_list(self._actions.by_label, self._policy)]

    async def __aenter__(self) -> Self:
        """Begin to follow the goals that are sent, and the list of tools."""
        async with AsyncExitStack() as stack:
            tasks = await stack.enter_async_context(Background())
            goals = AgentGoals(tasks)
            self._calls = ToolCalls(self._actions, goals, self._policy)
            self._tasks = GoalTasks(self._actions, goals, self._policy)
            self._resources = GoalResources(self._actions, goals)
            tasks.start_soon(self._resources.tell_changes, self._changes)
            tasks.start_soon(self._actions.follow)
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
        self, context: Context, _: PaginatedRequestParams | None
    ) -> ListToolsResult:
        self._changes.note(context)
        return ListToolsResult(tools=tool_list(self._actions.by_label, self._policy))

    async def _call_tool(
        self, context: Context, params: CallToolRequestParams
    ) -> Any:  # an answer, a question or a task: the SDK has no type for the latter
        return await self._calls.call(context, params)

    # What follows is asked of parts that are there while the block lasts only.

    async def _get_task(self, context: Context, params: GetTaskRequestParams) -> dict[str, Any]:
        return await self._tasks.get(context, params)

    async def _update_task(self, context: Context, params: UpdateTaskParams) -> dict[str, Any]:
        return await self._tasks.update(context, params)

    async def _cancel_task(
        self, context: Context, params: CancelTaskRequestParams
    ) -> dict[str, Any]:
        return await self._tasks.cancel(context, params)

    async def _list_resources(
        self, context: Context, _: PaginatedRequestParams | None
    ) -> ListResourcesResult:
        return await self._resources.running()

    async def _list_templates(
        self, context: Context, _: PaginatedRequestParams | None
    ) -> ListResourceTemplatesResult:
        return self._resources.templates()

    async def _read_resource(
        self, context: Context, params: ReadResourceRequestParams
    ) -> ReadResourceResult:
        return await self._resources.read(params.uri)
