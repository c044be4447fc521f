"""`GoalTasks`: goals as tasks of MCP, by the extension `io.modelcontextprotocol/tasks`.

Theory of operation
-------------------

A client of the protocol from 2026-07-28 on may declare the extension with a request. Then a tool
that sends a goal answers with a task as soon as the goal is accepted, or the user is to be asked,
and the client asks for it:

    tasks/get       the newest status, and at the end the answer that the tool would have given
    tasks/cancel    cancels the goal
    tasks/update    answers the question whether the goal may be sent, see `consent`

The ID of a task is the ID of its goal, and all else is asked of the server of the action. So a task
with a goal needs no memory here: it outlives its client, and this bridge, too, for as long as its
server knows the goal. With a store, that is also after a restart of the server.

    goal                            task
    accepted, executing, canceling  working, with the newest feedback as its message
    succeeded, aborted              completed: an aborted goal is an answer with `isError`
    canceled                        cancelled; the partial result is in `result`
    forgotten by its server         failed

A goal that cannot be followed now, because its server is away, is still working: what is final must
stay true. A task whose goal no server knows is an error, but only if all servers can be asked.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from mcp.server.context import ServerRequestContext
from mcp.shared.exceptions import MCPError
from mcp.shared.inbound import MCP_NAME_HEADER, decode_header_value
from mcp_types import (
    CallToolResult,
    CancelTaskRequestParams,
    GetTaskRequestParams,
    RequestParams,
)
from mcp_types.jsonrpc import (
    HEADER_MISMATCH,
    INTERNAL_ERROR,
    INVALID_PARAMS,
    METHOD_NOT_FOUND,
    MISSING_REQUIRED_CLIENT_CAPABILITY,
)
from mcp_types.version import MODERN_PROTOCOL_VERSIONS

from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports._agents.robot_actions import QUESTION_TIMEOUT, AgentPolicy
from fibaction_transports.mcp.answers import (
    ToolError,
    feedback_text,
    find_goal,
    goal_answer,
    message_in,
)
from fibaction_transports.mcp.consent import (
    AskedTask,
    AskedTasks,
    input_requests,
)
from fibaction_transports.mcp.tool_list import CANCEL, ToolAction, client_of

EXTENSION = "io.modelcontextprotocol/tasks"
"""The identifier of the extension."""
POLL_INTERVAL = 1000
"""Milliseconds between two requests for a task, as the client is told."""

Context = ServerRequestContext[Any, Any]


class UpdateTaskParams(RequestParams):
    """The parameters of `tasks/update`."""

    task_id: str
    input_responses: dict[str, Any] | None = None


def wants_task(context: Context) -> bool:
    """Return whether a client takes a task in place of an answer."""
    if context.protocol_version not in MODERN_PROTOCOL_VERSIONS:
        return False
    capabilities = context.session.client_capabilities
    return capabilities is not None and EXTENSION in (capabilities.extensions or {})


class GoalTasks:
    """The tasks of one bridge."""

    def __init__(
        self, goals: AgentGoals[ToolAction], policy: AgentPolicy, asked: AskedTasks
    ) -> None:
        self._goals = goals
        self._policy = policy
        self._asked = asked

    async def get(self, context: Context, params: GetTaskRequestParams) -> dict[str, Any]:
        """Return the newest status of a task.

        Raises:
            MCPError: There is none of that ID, or the client takes no tasks.
        """
        if (task := self._asked_task(context, params.task_id)) is not None:
            return _asked_members(task)
        return detailed(await self._find(params.task_id))

    async def update(self, context: Context, params: UpdateTaskParams) -> dict[str, Any]:
        """Take the answer of a user; any other input is acknowledged.

        Raises:
            MCPError: There is none of that ID, or the client takes no tasks.
        """
        if (task := self._asked_task(context, params.task_id)) is not None:
            await self._asked.take(task, params.input_responses)
            return {}
        await self._find(params.task_id)
        return {}

    async def cancel(self, context: Context, params: CancelTaskRequestParams) -> dict[str, Any]:
        """Cancel the goal of a task.

        Raises:
            MCPError: There is none of that ID, the client takes no tasks, or the goal may not be
                canceled so, or continues.
        """
        if (task := self._asked_task(context, params.task_id)) is not None:
            task.cancel()
            return {}
        goal = await self._find(params.task_id)
        if goal.outcome is not None:
            return {}
        action = goal.action
        if self._policy.read_only:
            raise MCPError(INVALID_PARAMS, "this bridge is read-only: nothing can be canceled")
        if goal.owner != client_of(context) and self._policy.asks(action.server, action.info.name):
            raise MCPError(
                INVALID_PARAMS,
                f"another client has sent the goal {goal.goal_id}, or this one before a restart:"
                f" the tool {CANCEL} asks the user",
            )
        try:
            rejected = await goal.cancel()
        except ActionError as exc:
            raise MCPError(INTERNAL_ERROR, f"the goal may continue: {exc}") from exc
        if rejected:
            raise MCPError(INTERNAL_ERROR, f"the server rejects the cancel: {rejected}")
        return {}

    def _asked_task(self, context: Context, task_id: str) -> AskedTask | None:
        """Return a task that has no goal yet, if there is one of this ID."""
        if context.protocol_version not in MODERN_PROTOCOL_VERSIONS:
            raise MCPError(METHOD_NOT_FOUND, "tasks need the protocol 2026-07-28 or later")
        if not wants_task(context):
            raise MCPError(
                MISSING_REQUIRED_CLIENT_CAPABILITY,
                f"a request about a task must declare the extension {EXTENSION}",
                {"requiredCapabilities": {"extensions": {EXTENSION: {}}}},
            )
        named = context.request and context.request.headers.get(MCP_NAME_HEADER)
        if named and decode_header_value(named) != task_id:  # a proxy may have read it
            reason = f"the header {MCP_NAME_HEADER} names another task than the request"
            raise MCPError(HEADER_MISMATCH, reason)
        return self._asked.find(context, task_id)

    async def _find(self, task_id: str) -> AgentGoal[ToolAction]:
        try:
            return await find_goal(self._goals, task_id)
        except ToolError as exc:
            if isinstance(exc.__cause__, ValueError | UnknownGoal):
                raise MCPError(INVALID_PARAMS, f"there is no task of this ID: {exc}") from exc
            raise MCPError(INTERNAL_ERROR, str(exc.__cause__)) from exc


def created(goal: AgentGoal[ToolAction]) -> dict[str, Any]:
    """Return the answer to a call that has become a task."""
    return {"resultType": "task", **_members(goal, "working")}


def asked_task(task: AskedTask) -> dict[str, Any]:
    """Return the answer to a call that has become a task whose user is asked first."""
    return {"resultType": "task", **_asked_members(task)}


def _asked_members(task: AskedTask) -> dict[str, Any]:
    members = {
        "taskId": str(task.goal_id),
        "status": task.status,
        "createdAt": _time_text(task.created),
        "lastUpdatedAt": _time_text(task.updated),
        "ttlMs": int(QUESTION_TIMEOUT * 1000),
        "pollIntervalMs": POLL_INTERVAL,
    }
    if task.status == "input_required":
        return {**members, "inputRequests": input_requests(task)}
    if task.answer is None:
        return members
    return {**members, "result": _dumped(task.answer)}


def _dumped(answer: CallToolResult) -> dict[str, Any]:
    return answer.model_dump(by_alias=True, mode="json", exclude_none=True)


def detailed(goal: AgentGoal[ToolAction]) -> dict[str, Any]:
    """Return a task with its answer, once it has ended."""
    outcome = goal.outcome
    if lost := _loss_of(goal):
        error = {"code": INTERNAL_ERROR, "message": f"the result is lost: {lost}"}
        return {**_members(goal, "failed"), "error": error}
    if outcome is None:
        return _members(goal, "working")
    is_canceled = outcome.status is GoalStatus.CANCELED
    members = _members(goal, "cancelled" if is_canceled else "completed")
    if is_canceled and outcome.result is None:
        return members
    answer = goal_answer(goal, cancel_wanted=True)
    return {**members, "result": _dumped(answer)}


def _loss_of(goal: AgentGoal[ToolAction]) -> str:
    """Return why no result of a goal will come any more; empty if one may come, or is there."""
    if isinstance(goal.error, UnknownGoal):
        return str(goal.error)
    outcome = goal.outcome
    return outcome.reason if outcome and outcome.status is GoalStatus.UNKNOWN else ""


def _members(goal: AgentGoal[ToolAction], status: str) -> dict[str, Any]:
    members = {
        "taskId": str(goal.goal_id),
        "status": status,
        "createdAt": _time_text(goal.stamp / 1e9),
        "lastUpdatedAt": _time_text(max(goal.updated_at, goal.stamp / 1e9)),
        "ttlMs": None,  # the server of the action decides
        "pollIntervalMs": POLL_INTERVAL,
    }
    message = _message(goal)
    return members | {"statusMessage": message} if message else members


def _message(goal: AgentGoal[ToolAction]) -> str:
    """Return what people read about the state of a goal; empty if there is nothing to say."""
    if goal.outcome is not None:
        return goal.outcome.reason
    if goal.error is not None:
        return f"The goal cannot be followed now: {goal.error}"
    return "" if goal.newest is None else feedback_text(message_in(goal.newest.payload))


def _time_text(seconds: float) -> str:
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
