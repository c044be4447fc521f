"""`Consents` and `AskedTasks`: the questions to the user before something moves.

Theory of operation
-------------------

A question is an elicitation of MCP: the client shows a text, and the user accepts or declines. How
it travels depends on the protocol that the client speaks.

- With a handshake (versions up to 2025-11-25), the server asks the client while the tool runs.
- Without one (from 2026-07-28 on), the tool answers that input is required, and the client calls
  it again with the user's answer and with a `requestState`. That is a random number here, which
  stands for one question of one client, with exactly this text, tool and arguments, and is valid
  once and for a limited time: an answer cannot be used for another goal, nor by another client.
- A client that takes tasks gets one that is `input_required`, whose ID is that of the goal to come
  (`AskedTasks`). It answers by `tasks/update`. With a yes, the goal is sent, and the task is a view
  of it; without one, or if the goal is rejected, the task ends with the answer that the tool would
  have given. Other clients know no task of that ID.

A client says by its capabilities whether it can ask. One that cannot gets an error, so nothing
moves; the error does not tell the model how that is changed, since some models can run commands. A
client that answers in place of its user is not noticed: that is a matter of trust.

Whether the user is asked is in `AgentPolicy.asks`, and what the question shows in `ToolCalls`.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Awaitable, Callable
from time import time
from typing import Any

import anyio
from mcp.server.context import ServerRequestContext
from mcp.shared.exceptions import MCPError
from mcp_types import (
    CallToolRequestParams,
    CallToolResult,
    ClientCapabilities,
    ElicitRequest,
    ElicitRequestFormParams,
    ElicitResult,
    InputRequiredResult,
    TaskStatus,
)
from mcp_types.version import MODERN_PROTOCOL_VERSIONS
from pydantic import ValidationError

from fibaction.words.goals import GoalID
from fibaction_transports._agents.agent_goals import AgentGoal
from fibaction_transports._agents.robot_actions import QUESTION_TIMEOUT, OpenQuestions
from fibaction_transports.mcp.answers import ToolError, error_answer
from fibaction_transports.mcp.tool_list import client_of

KEY = "consent"
FORM: dict[str, Any] = {"type": "object", "properties": {}}
"""The form of the question: it has no fields, only the answer itself."""


class Consents:
    """The questions of one bridge, and their answers."""

    def __init__(self) -> None:
        self._open: OpenQuestions[str] = OpenQuestions()
        """The calls that were asked about, by the state of their requests."""

    async def ask(
        self, context: ServerRequestContext[Any, Any], params: CallToolRequestParams, question: str
    ) -> InputRequiredResult | None:
        """Ask the user whether the call of a tool may continue; return None if it may.

        Otherwise return the answer to this call, after which the client asks and calls again.

        Raises:
            ToolError: The user does not agree, or cannot be asked.
        """
        check_can_ask(context)
        if context.protocol_version in MODERN_PROTOCOL_VERSIONS:
            return self._asked_again(client_of(context), params, question)
        try:
            with anyio.fail_after(QUESTION_TIMEOUT):
                answer = await context.session.elicit_form(question, FORM, context.request_id)
        except TimeoutError as exc:
            raise _cannot_ask(f"there was no answer in {QUESTION_TIMEOUT:g} s") from exc
        except (MCPError, ValidationError) as exc:
            raise _cannot_ask(f"the client failed to ask ({type(exc).__name__})") from exc
        check_answer(answer)
        return None

    def _asked_again(
        self, client: str, params: CallToolRequestParams, question: str
    ) -> InputRequiredResult | None:
        call, given = _call_of(client, params, question), params.request_state or ""
        answer = (params.input_responses or {}).get(KEY)
        asked = self._open.find(given)
        self._open.close(given)
        if asked == call:
            if not isinstance(answer, ElicitResult):
                raise _cannot_ask("the client has not answered the question")
            check_answer(answer)
            return None
        # The first call, or an answer to another question, or to an old one: it is asked again.
        state = secrets.token_urlsafe(16)
        self._open.add(state, call)
        form = ElicitRequestFormParams(message=question, requested_schema=FORM)
        return InputRequiredResult(
            input_requests={KEY: ElicitRequest(params=form)}, request_state=state
        )


def check_can_ask(context: ServerRequestContext[Any, Any]) -> None:
    """Check that a client can ask its user.

    Raises:
        ToolError: It cannot.
    """
    if not _can_ask(context.session.client_capabilities):
        raise _cannot_ask("this client cannot ask")


def _can_ask(capabilities: ClientCapabilities | None) -> bool:
    """Return whether a client can show a form to its user."""
    elicitation = capabilities.elicitation if capabilities else None
    return elicitation is not None and (elicitation.form is not None or elicitation.url is None)


def _cannot_ask(reason: str) -> ToolError:
    return ToolError(
        f"Nothing was sent: the user must agree to it first, and {reason}. Tell the user, who finds"
        f" in the documentation of fibaction, on the page Agents, how goals can be permitted."
    )


def check_answer(answer: ElicitResult) -> None:
    """Check that the user has agreed.

    Raises:
        ToolError: The user has not.
    """
    if answer.action == "decline":
        raise ToolError(
            "Nothing was sent: the user has declined. Do not try it again unless the user asks you"
            " to."
        )
    if answer.action != "accept":
        raise ToolError("Nothing was sent: the user has closed the question without an answer.")


def _call_of(client: str, params: CallToolRequestParams, question: str) -> str:
    """Return the text that is the same for the same call and question of a client only."""
    return json.dumps([client, params.name, params.arguments, question], sort_keys=True)


# Tasks that wait for the consent of a user, before there is a goal

Send = Callable[[GoalID], Awaitable[AgentGoal[Any]]]
"""Sends the goal; raises `ToolError` if it was not accepted."""


class AskedTask:
    """A task before its goal."""

    def __init__(self, client: str, question: str, send: Send) -> None:
        self.goal_id = GoalID.random()
        self.client = client
        self.question = question
        self.created = self.updated = time()
        self.status: TaskStatus = "input_required"
        """The status; with `working`, the goal is being sent."""
        self.answer: CallToolResult | None = None
        """The answer of a task that was completed without a goal."""
        self._send = send
        self._is_cancel_wanted = False

    def cancel(self) -> None:
        """End without a goal; if it is being sent, cancel it as soon as it is accepted."""
        if self.status == "working":
            self._is_cancel_wanted = True
        elif self.status == "input_required":
            self.status, self.updated = "cancelled", time()

    async def take(self, answer: ElicitResult) -> bool:
        """Take the answer of the user: with a yes, send the goal. Return whether it was sent."""
        try:
            check_answer(answer)
            self.status = "working"
            goal = await self._send(self.goal_id)
        except ToolError as exc:
            self.answer, self.status, self.updated = error_answer(str(exc)), "completed", time()
            return False
        except BaseException:  # the request was cut; a goal that is accepted then was canceled
            self.status, self.updated = "cancelled", time()
            raise
        if self._is_cancel_wanted:
            await goal.leave()
        return True


class AskedTasks:
    """The tasks of one bridge that wait for an answer, or have ended without a goal."""

    def __init__(self) -> None:
        self._open: OpenQuestions[AskedTask] = OpenQuestions()

    def ask(self, context: ServerRequestContext[Any, Any], question: str, send: Send) -> AskedTask:
        """Begin to wait for an answer."""
        task = AskedTask(client_of(context), question, send)
        self._open.add(str(task.goal_id), task)
        return task

    def find(self, context: ServerRequestContext[Any, Any], task_id: str) -> AskedTask | None:
        """Return a task of this client; None if there is none, or it was asked too long ago."""
        task = self._open.find(task_id)
        return None if task is None or task.client != client_of(context) else task

    async def take(self, task: AskedTask, responses: dict[str, Any] | None) -> None:
        """Take the answer of the user, if it is among the responses; with a yes, send the goal."""
        try:
            answer = ElicitResult.model_validate((responses or {}).get(KEY))
        except ValidationError:
            return
        if task.status == "input_required" and await task.take(answer):
            self._open.close(str(task.goal_id))  # from now on it is a goal


def input_requests(task: AskedTask) -> dict[str, Any]:
    """Return the question of a task."""
    form = ElicitRequestFormParams(message=task.question, requested_schema=FORM)
    asked = ElicitRequest(params=form).model_dump(by_alias=True, mode="json", exclude_none=True)
    return {KEY: asked}
