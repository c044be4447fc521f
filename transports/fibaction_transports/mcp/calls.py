"""`ToolCalls`: the tools, as they are called."""

from __future__ import annotations

from functools import partial
from typing import Any

import anyio
import msgspec
from mcp.server.context import ServerRequestContext
from mcp_types import CallToolRequestParams, CallToolResult, InputRequiredResult

from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction.schema.turns import in_turn
from fibaction.words.errors import ActionError, ConnectionLost, GoalRejected
from fibaction.words.goals import GoalID
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports._agents.robot_actions import AgentPolicy, UnshownGoal, question_about
from fibaction_transports.mcp.answers import (
    ProgressReports,
    ToolError,
    data_answer,
    error_answer,
    find_goal,
    goal_answer,
    message_in,
    overview,
)
from fibaction_transports.mcp.consent import AskedTasks, Consents, check_can_ask
from fibaction_transports.mcp.goal_tasks import asked_task, created, wants_task
from fibaction_transports.mcp.tool_list import (
    CANCEL,
    GOAL,
    SEND,
    STATUS,
    ToolAction,
    ToolActions,
    client_of,
    tool_list,
    with_arguments,
)

PROGRESS_PERIOD = 0.2
"""Seconds between two reports of progress, at least."""

Answer = CallToolResult | InputRequiredResult | dict[str, Any]
"""The answer of a tool; a task of the extension is a mapping."""


class ToolCalls:
    """The calls of the tools of one bridge."""

    def __init__(
        self, actions: ToolActions, goals: AgentGoals[ToolAction], policy: AgentPolicy
    ) -> None:
        self._actions = actions
        self._goals = goals
        self._policy = policy
        self._consents = Consents()
        self.asked = AskedTasks()
        """The tasks that wait for the consent of a user."""
        inputs = {tool.name: tool.input_schema for tool in tool_list({}, policy)}
        self._inputs = {name: JsonCodec(schema, "input") for name, schema in inputs.items()}

    async def call(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> Any:  # an answer, a question or a task: the SDK has no type for the latter
        """Call a tool; an error is an answer, too."""
        own = {SEND: self._send, STATUS: self._status, CANCEL: self._cancel}
        params = with_arguments(context, params)
        try:
            handle = own.get(params.name, self._run)
            return await handle(context, params)
        except ToolError as exc:
            return error_answer(str(exc))

    async def _run(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> Answer:
        """Send a goal, and wait for its end; cancel it if the client cancels the call.

        A client that takes tasks gets one as soon as the goal is accepted.
        """
        action = self._action(params.name)
        message = await _message(action, params.arguments or {})
        if wants_task(context) and (question := self._question(action, message)):
            check_can_ask(context)
            send = partial(self._send_goal, client_of(context), action, message)
            return asked_task(self.asked.ask(context, question, send))
        if (asked := await self._ask_to_send(context, params, action, message)) is not None:
            return asked
        goal = await self._send_goal(client_of(context), action, message)
        if wants_task(context):
            return created(goal)
        try:
            await self._wait(context, goal, self._policy.patience)
        except anyio.get_cancelled_exc_class():
            await goal.leave()
            raise
        return goal_answer(goal)

    async def _send(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> Answer:
        """Send a goal, and answer as soon as it is accepted."""
        given = await self._input(params)
        action = self._action(given["tool"])
        message = await _message(action, given[GOAL])
        if (asked := await self._ask_to_send(context, params, action, message)) is not None:
            return asked
        return goal_answer(await self._send_goal(client_of(context), action, message))

    async def _status(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> Answer:
        """Tell about one goal, or about everything."""
        given = await self._input(params)
        if "goal_id" not in given:
            listed = await self._goals.listed()
            actions = list(self._actions.by_label.values())
            return data_answer(overview(self._actions.problems, actions, listed))
        goal = await find_goal(self._goals, given["goal_id"])
        await self._wait(context, goal, given["wait"])
        return goal_answer(goal)

    async def _cancel(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams
    ) -> Answer:
        """Cancel a goal; ask the user first if it is another client's."""
        given = await self._input(params)
        goal = await find_goal(self._goals, given["goal_id"])
        action = goal.action
        if goal.owner != client_of(context) and self._policy.asks(action.server, action.info.name):
            question = (
                f"Cancel the goal {goal.goal_id} of the action {action.title}, which another"
                f" client has sent?"
            )
            if (asked := await self._consents.ask(context, params, question)) is not None:
                return asked
        if not goal.ended.is_set():
            await _cancel(goal)
        await self._wait(context, goal, given["wait"])
        return goal_answer(goal, cancel_wanted=True)

    # Their parts

    async def _ask_to_send(
        self,
        context: ServerRequestContext[Any, Any],
        params: CallToolRequestParams,
        action: ToolAction,
        message: Any,
    ) -> InputRequiredResult | None:
        """Ask the user before a goal, if that is the policy; return the answer if it is a question.

        Raises:
            ToolError: The goal may not be sent.
        """
        question = self._question(action, message)
        return await self._consents.ask(context, params, question) if question else None

    def _question(self, action: ToolAction, message: Any) -> str:
        """Return the question to the user before a goal; empty if none is asked.

        Raises:
            ToolError: The goal cannot be shown.
        """
        if not self._policy.asks(action.server, action.info.name):
            return ""
        try:
            return question_about(action, message)
        except UnshownGoal as exc:
            raise ToolError(str(exc)) from exc

    async def _wait(
        self,
        context: ServerRequestContext[Any, Any],
        goal: AgentGoal[ToolAction],
        seconds: float,
    ) -> None:
        """Wait for the end for so long, and report the feedback meanwhile: the newest one only, but
        all pieces of a text, since they are parts of one answer.
        """
        reports = ProgressReports(context.session.report_progress)
        reported = 0

        async def report() -> None:
            nonlocal reported
            if items := goal.feedback_after(reported):
                reported = goal.count
                message = message_in(items[-1].payload)
                if isinstance(message, str):
                    pieces = (message_in(item.payload) for item in items)
                    message = "".join(one for one in pieces if isinstance(one, str))
                await reports.report(reported, message)

        with anyio.move_on_after(seconds):
            while not goal.ended.is_set():
                if goal.count == reported:
                    await goal.news.wait()
                    continue
                await report()
                with anyio.move_on_after(PROGRESS_PERIOD):
                    await goal.ended.wait()
            await report()

    def _action(self, tool: str) -> ToolAction:
        """Return the action of a tool.

        Raises:
            ToolError: There is none now, or goals cannot be sent.
        """
        if self._policy.read_only:
            raise ToolError("Nothing was sent: this bridge is read-only. Only goal_status is here.")
        tools = self._actions.by_label
        if tool in tools:
            return tools[tool]
        text = f"There is no tool {tool!r} now; there are {', '.join(sorted(tools)) or 'none'}."
        for server, problem in self._actions.problems.items():
            if problem:
                text += f" The server {server} cannot be reached: {problem}.".replace("  ", " ")
        raise ToolError(text)

    async def _send_goal(
        self, owner: str, action: ToolAction, message: Any, goal_id: GoalID | None = None
    ) -> AgentGoal[ToolAction]:
        """Send a goal of a client.

        Raises:
            ToolError: It was not accepted, or may not have been.
        """
        try:
            payload = msgspec.msgpack.encode(message)
            goal_id = goal_id or GoalID.random()
            return await self._goals.send(action, goal_id, payload, owner=owner)
        except GoalRejected as exc:
            reason = exc.reason or "the server gave no reason"
            advice = ". You may try again later." if exc.code.is_temporary else ""
            raise ToolError(
                f"The goal was rejected, and nothing was done: {reason}{advice}"
            ) from exc
        except ConnectionLost as exc:
            raise ToolError(
                f"The connection was lost, and the goal may have been accepted: {exc}. Call"
                f" {STATUS} without a goal_id before you send it again."
            ) from exc
        except ActionError as exc:
            raise ToolError(f"The goal was not sent: {exc}") from exc

    async def _input(self, params: CallToolRequestParams) -> dict[str, Any]:
        """Return the input of one of the bridge's own tools, with its defaults.

        Raises:
            ToolError: It is invalid, or there is no such tool here.
        """
        if params.name not in self._inputs:
            raise ToolError("Nothing was done: this bridge is read-only. Only goal_status is here.")
        try:
            codec, arguments = self._inputs[params.name], params.arguments or {}
            given: dict[str, Any] = await in_turn(None, partial(codec.complete, arguments))
        except PayloadError as exc:
            raise ToolError(f"Nothing was done: {exc}.") from exc
        return given


async def _message(action: ToolAction, arguments: dict[str, Any]) -> Any:
    """Return the goal in the arguments of a call, with its defaults.

    Raises:
        ToolError: It is not a goal of the action.
    """
    surplus = set(arguments) - {GOAL}
    is_missing = GOAL not in arguments and action.goals.needs_goal
    if action.input.is_wrapped and (surplus or is_missing):
        raise ToolError(f"The goal was not sent: the input has the field {GOAL!r} and no other.")
    try:
        goal = action.input.goal_in(arguments)
        return await in_turn(None, lambda pause: action.goals.complete(goal, pause))
    except PayloadError as exc:
        raise ToolError(f"The goal was not sent: {exc}.") from exc


async def _cancel(goal: AgentGoal[ToolAction]) -> None:
    """Ask the server to cancel a goal.

    Raises:
        ToolError: The goal continues.
    """
    try:
        rejected = await goal.cancel()
    except ActionError as exc:
        raise ToolError(f"The goal was not canceled, and may continue: {exc}") from exc
    if rejected:
        raise ToolError(f"The server rejects the cancel, and the goal continues: {rejected}")
