"""`ToolServer`: the actions of a group of servers as tools of a server of the SDK, and goals that
run as resources, which a client lists, reads and watches.

The resource of a goal is `goal://ID`. Its text is the data that `goal_status` tells. The goals of
all clients are listed while they run, and can be read for as long as a server knows them.

A client without a handshake may subscribe. It is told of the goals that the bridge follows, which
are those that it has sent, and those that someone has asked about: at most once in `PERIOD`.

Clients are told that the list of tools has changed (`ListChanges`). A client with a handshake (MCP
up to 2025-11-25) gets a notification on its connection. A client without one (from 2026-07-28 on)
asks for a stream of changes by `subscriptions/listen`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, Self

import anyio
from mcp.server import NotificationOptions, Server
from mcp.server.context import ServerRequestContext
from mcp.server.models import InitializationOptions
from mcp.server.session import ServerSession
from mcp.server.subscriptions import (
    InMemorySubscriptionBus,
    ListenHandler,
    ResourcesListChanged,
    ResourceUpdated,
    ServerEvent,
    ToolsListChanged,
)
from mcp.shared.exceptions import MCPError
from mcp_types import (
    CancelTaskRequestParams,
    GetTaskRequestParams,
    ListResourcesResult,
    ListResourceTemplatesResult,
    ListToolsResult,
    PaginatedRequestParams,
    ReadResourceRequestParams,
    ReadResourceResult,
    Resource,
    ResourceTemplate,
    TextResourceContents,
)
from mcp_types.jsonrpc import INVALID_PARAMS
from mcp_types.version import MODERN_PROTOCOL_VERSIONS

from fibaction import __version__
from fibaction.border.abc import Notifier
from fibaction.border.gateway import ServerGroup
from fibaction.words.goals import GoalID
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports._agents.robot_actions import AgentPolicy
from fibaction_transports.mcp.answers import ToolError, find_goal, goal_answer, json_text
from fibaction_transports.mcp.calls import ToolCalls
from fibaction_transports.mcp.goal_tasks import EXTENSION, GoalTasks, UpdateTaskParams
from fibaction_transports.mcp.tool_list import (
    CANCEL,
    SEND,
    STATUS,
    ToolAction,
    ToolActions,
    instructions,
    tool_list,
)

MOST_SESSIONS = 1000
"""Sessions that are told; the oldest of more are forgotten. Over HTTP a client may just vanish."""
TELL_TIMEOUT = 5.0
"""Seconds that a client has to take the notification."""
SESSION_HEADER = "mcp-session-id"
SCHEME = "goal://"
MOST_LISTED = 100
"""Goals that are listed: the newest ones."""
PERIOD = 1.0
"""Seconds between two notifications about the same goal, at least."""
JSON = "application/json"
MOST_PIECES = 256
"""Feedback messages of a goal that are kept, for the pieces of a text."""


class ListChanges:
    """The clients that know the list of tools."""

    def __init__(
        self, *, most_sessions: int = MOST_SESSIONS, tell_timeout: float = TELL_TIMEOUT
    ) -> None:
        self._most_sessions = most_sessions
        self._tell_timeout = tell_timeout
        self._bus = InMemorySubscriptionBus()
        self.listen = ListenHandler(self._bus)
        """The handler of `subscriptions/listen`."""
        self._sessions: dict[Any, ServerSession] = {}

    @asynccontextmanager
    async def connection(self) -> AsyncGenerator[object, None]:
        """Give a connection its identity, while it lasts."""
        identity = object()
        try:
            yield identity
        finally:
            self._sessions.pop(identity, None)

    def note(self, context: ServerRequestContext[Any, Any]) -> None:
        """Note that a client has read the list."""
        if context.protocol_version in MODERN_PROTOCOL_VERSIONS:
            return
        headers = getattr(context.request, "headers", {})
        key = headers.get(SESSION_HEADER, context.lifespan_context)
        self._sessions.pop(key, None)
        self._sessions[key] = context.session
        if len(self._sessions) > self._most_sessions:
            del self._sessions[next(iter(self._sessions))]

    async def publish(self, event: ServerEvent) -> None:
        """Tell the clients that have asked for a stream of such changes."""
        await self._bus.publish(event)

    async def tell(self) -> None:
        """Tell all clients that the list has changed."""
        await self.publish(ToolsListChanged())
        with anyio.move_on_after(self._tell_timeout):
            async with anyio.create_task_group() as tasks:
                for session in self._sessions.values():
                    tasks.start_soon(session.send_tool_list_changed)


class GoalResources:
    """The resources of one bridge."""

    def __init__(self, goals: AgentGoals[ToolAction]) -> None:
        self._goals = goals

    async def running(self, *_: object) -> ListResourcesResult:
        """List the goals that run."""
        found = await self._goals.listed()
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

    async def templates(self, *_: object) -> ListResourceTemplatesResult:
        """Tell how the address of a goal is made."""
        template = ResourceTemplate(
            uri_template=f"{SCHEME}{{goal_id}}",
            name="goal",
            title="A goal",
            description="The status of a goal, its newest feedback, and its result at the end.",
            mime_type=JSON,
        )
        return ListResourceTemplatesResult(resource_templates=[template])

    async def read(self, _: object, params: ReadResourceRequestParams) -> ReadResourceResult:
        """Tell about a goal.

        Raises:
            MCPError: There is no such goal.
        """
        uri = params.uri
        try:
            if not uri.startswith(SCHEME):
                raise ValueError(f"the address of a goal is {SCHEME}ID")
            goal = await find_goal(self._goals, uri.removeprefix(SCHEME))
        except (ValueError, ToolError) as exc:
            message = f"there is no such resource: {exc}"
            raise MCPError(INVALID_PARAMS, message, {"uri": uri}) from exc
        text = json_text(goal_answer(goal).structured_content)
        told = TextResourceContents(uri=uri, mime_type=JSON, text=text)
        return ReadResourceResult(contents=[told])


class GoalChanges:
    """Changes of goals that clients have not been told of yet."""

    def __init__(self, told: ListChanges) -> None:
        self._told = told
        self._running: set[GoalID] = set()
        self._changed: dict[GoalID, None] = {}
        self._is_other_list = False
        self._news = Notifier()

    def note(self, goal: AgentGoal[ToolAction]) -> None:
        """Note that a goal has changed."""
        goal_id = goal.goal_id
        is_running, was_running = not goal.ended.is_set(), goal_id in self._running
        self._changed[goal_id] = None
        if is_running != was_running:
            self._is_other_list = True
            (self._running.add if is_running else self._running.remove)(goal_id)
        self._news.notify()

    async def tell(self) -> None:
        """Tell the clients that watch when goals change, until canceled."""
        while True:
            while not self._changed:
                await self._news.wait()
            changed, is_other_list = self._changed, self._is_other_list
            self._changed, self._is_other_list = {}, False
            for goal_id in changed:
                await self._told.publish(ResourceUpdated(uri=f"{SCHEME}{goal_id}"))
            if is_other_list:
                await self._told.publish(ResourcesListChanged())
            await anyio.sleep(PERIOD)


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


class ToolServer(anyio.AsyncContextManagerMixin):
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

    @asynccontextmanager
    async def __asynccontextmanager__(self) -> AsyncGenerator[Self, None]:
        """Follow the list of tools, and the goals that are sent, which go on after the block."""
        async with self._goals.followed() as tasks:
            tasks.start_soon(self._goal_changes.tell)
            tasks.start_soon(self._tell_changes)
            yield self

    async def _tell_changes(self) -> None:
        while True:
            await self._actions.news.wait()
            await self._changes.tell()

    async def _list_tools(
        self, context: ServerRequestContext[Any, Any], _: PaginatedRequestParams | None
    ) -> ListToolsResult:
        self._changes.note(context)
        return ListToolsResult(tools=tool_list(self._actions.by_label, self._policy))
