"""The answers of tools: text for the model, and the same as data for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, TypeAlias

from mcp_types import CallToolResult, ImageContent, TextContent

from fibaction.border.peer_text import shortened
from fibaction.schema.payload import PayloadError, to_json
from fibaction.words.progress import Progress, ProgressMeter
from fibaction.words.statuses import GoalStatus
from fibaction_transports.mcp.tools.agent_goals import AgentGoal
from fibaction_transports.mcp.tools.images import Images
from fibaction_transports.mcp.tools.tool_names import CANCEL, STATUS

LONGEST_ANSWER = 50_000
"""Characters of data that a model gets; clients cut longer ones, or fail."""
LONGEST_FEEDBACK = 500
"""Characters of feedback in a notification of progress."""
_HEAD = ("goal_id", "action", "status")


def data_answer(
    data: dict[str, Any],
    sentence: str = "",
    *,
    error: bool = False,
    images: Sequence[ImageContent] = (),
) -> CallToolResult:
    """Return an answer with data, below a sentence if there is one, and with images after it.

    Of data that are too long, the text has the beginning, and the structured content which goal it
    is about.
    """
    text = json_text(data)
    structured: Any = None
    if len(text) > LONGEST_ANSWER:
        text = f"The first {LONGEST_ANSWER} of {len(text)} characters: {text[:LONGEST_ANSWER]}"
        structured = {name: data[name] for name in _HEAD if name in data} or None
    else:
        structured = json.loads(text)
    text = f"{sentence}\n{text}" if sentence else text
    return CallToolResult(
        content=[TextContent(type="text", text=text), *images],
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


ReportProgress: TypeAlias = Callable[[float, float | None, str | None], Awaitable[None]]
"""Sends the progress, the total if it is known, and a text."""


class ProgressReports:
    """The notifications of progress of one call: of each the progress is larger than before, as the
    protocol demands.
    """

    def __init__(self, send: ReportProgress) -> None:
        self._send = send
        self._meter = ProgressMeter()
        self._told = -math.inf

    async def report(self, number: int, feedback: Any) -> None:
        """Send the progress that a feedback tells, with its total; if it tells none, its number."""
        progress = self._meter.read(feedback) or Progress(number)
        if progress.done > self._told:
            self._told = progress.done
            await self._send(progress.done, progress.total, feedback_text(feedback))


def goal_answer(goal: AgentGoal, *, cancel_wanted: bool = False) -> CallToolResult:
    """Return what is known about a goal.

    It is an error if the goal did not succeed, so that the model does not overlook it; a canceled
    goal is none with `cancel_wanted`.
    """
    data: dict[str, Any] = {
        "goal_id": str(goal.goal_id),
        "action": goal.action.label,
        "status": goal.status.name,
    }
    outcome = goal.outcome
    images = Images()
    if goal.number and (outcome is None or outcome.status is not GoalStatus.SUCCEEDED):
        feedback = images.take(goal.feedback, goal.action.info.feedback)
        data |= {"feedback_count": goal.number, "feedback": feedback}
    if goal.error is not None:
        sentence = (
            f"The goal cannot be followed any more, and may continue: {goal.error}. Call {STATUS}"
            f" with its goal_id to try again."
        )
        return data_answer(data, sentence, error=True, images=images.found)
    if outcome is None:
        sentence = (
            f"The goal has not ended yet. To wait for it, call {STATUS} with its goal_id and wait;"
            f" to stop it, call {CANCEL}."
        )
        return data_answer(data, sentence, images=images.found)
    if outcome.result is not None or outcome.status is GoalStatus.SUCCEEDED:
        data["result"] = images.take(outcome.result, goal.action.info.result)
    if outcome.reason:
        data["reason"] = outcome.reason
    if outcome.status is GoalStatus.SUCCEEDED:
        return data_answer(data, images=images.found)
    reason = f": {outcome.reason}" if outcome.reason else "."
    if outcome.status is GoalStatus.CANCELED:
        sentence, error = f"The goal was canceled{reason}", not cancel_wanted
    else:
        what = "was aborted" if outcome.status is GoalStatus.ABORTED else "is unknown"
        sentence, error = f"The goal {what}{reason}", True
    return data_answer(data, sentence, error=error, images=images.found)
