"""The answers of tools: text for the model, and the same as data for programs."""

from __future__ import annotations

import json
from typing import Any

from mcp_types import CallToolResult, TextContent

from fibaction.border.peer_text import shortened
from fibaction.schema.payload import PayloadError, to_json
from fibaction.words.statuses import GoalStatus
from fibaction_transports.mcp.tools.agent_goals import AgentGoal
from fibaction_transports.mcp.tools.tool_names import CANCEL, STATUS

LONGEST_ANSWER = 50_000
"""Characters of data that a model gets; clients cut longer ones, or fail."""
LONGEST_FEEDBACK = 500
"""Characters of feedback in a notification of progress."""


def data_answer(data: dict[str, Any], sentence: str = "", *, error: bool = False) -> CallToolResult:
    """Return an answer with data, below a sentence if there is one."""
    text = json_text(data)
    structured: Any = None
    if len(text) > LONGEST_ANSWER:
        text = f"The first {LONGEST_ANSWER} of {len(text)} characters: {text[:LONGEST_ANSWER]}"
    else:
        structured = json.loads(text)
    text = f"{sentence}\n{text}" if sentence else text
    return CallToolResult(
        content=[TextContent(type="text", text=text)],
        structured_content=structured,
        is_error=error,
    )


def error_answer(text: str) -> CallToolResult:
    """Return the answer that something did not work."""
    return CallToolResult(content=[TextContent(type="text", text=text)], is_error=True)


def json_text(value: Any) -> str:
    """Return plain data as JSON on one line; if JSON cannot express it, the reason."""
    try:
        return to_json(value)
    except PayloadError as exc:
        return to_json({"error": str(exc)})


def feedback_text(feedback: Any) -> str:
    """Return feedback as a short text."""
    return shortened(json_text(feedback), LONGEST_FEEDBACK)


def goal_answer(goal: AgentGoal, *, cancel_wanted: bool = False) -> CallToolResult:
    """Return what is known about a goal.

    It is an error if the goal did not succeed, so that the model does not overlook it; a canceled
    goal is none with `cancel_wanted`.
    """
    data: dict[str, Any] = {
        "goal_id": str(goal.goal_id),
        "action": goal.action.tool,
        "status": goal.status.name,
    }
    outcome = goal.outcome
    if goal.number and (outcome is None or outcome.status is not GoalStatus.SUCCEEDED):
        data |= {"feedback_count": goal.number, "feedback": goal.feedback}
    if goal.error is not None:
        sentence = (
            f"The goal cannot be followed any more, and may go on: {goal.error}. Call {STATUS} with"
            f" its goal_id to try again."
        )
        return data_answer(data, sentence, error=True)
    if outcome is None:
        sentence = (
            f"The goal has not ended yet. To wait for it, call {STATUS} with its goal_id and wait;"
            f" to stop it, call {CANCEL}."
        )
        return data_answer(data, sentence)
    if outcome.result is not None or outcome.status is GoalStatus.SUCCEEDED:
        data["result"] = outcome.result
    if outcome.reason:
        data["reason"] = outcome.reason
    if outcome.status is GoalStatus.SUCCEEDED:
        return data_answer(data)
    reason = f": {outcome.reason}" if outcome.reason else "."
    if outcome.status is GoalStatus.CANCELED:
        return data_answer(data, f"The goal was canceled{reason}", error=not cancel_wanted)
    what = "was aborted" if outcome.status is GoalStatus.ABORTED else "is unknown"
    return data_answer(data, f"The goal {what}{reason}", error=True)
