"""The answers of tools: text for the model, and the same as data for programs.

Images in the feedback and the results of goals are shown to the model as images. An image is bytes
whose schema has an image in `contentMediaType`, or which begin as a file of one of the common
formats does. In the data it is replaced by its name, since a model can do nothing with base64 text.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, TypeAlias, cast

from mcp_types import CallToolResult, ImageContent, TextContent

from fibaction.border.peer_text import excerpt, shortened
from fibaction.schema.payload import PayloadError, to_json
from fibaction.types.action import Codec
from fibaction.words.errors import ActionError, ProtocolError, ServerNotFound, UnknownGoal
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.plain_data import is_list, is_map
from fibaction.words.progress import Progress, ProgressMeter
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports.mcp.tool_list import CANCEL, STATUS, ToolAction

LONGEST_ANSWER = 50_000
"""Characters of data that a model gets; clients cut longer ones, or fail."""
LONGEST_FEEDBACK = 500
"""Characters of feedback in a notification of progress."""
LONGEST_TEXT = 10_000
"""Characters of feedback that is text, for example some pieces of an answer."""
MOST_IMAGES = 4
"""Images of one answer."""
LARGEST_IMAGE = 5 * 2**20
"""Bytes of an image; models take no larger ones."""
DEEPEST = 32
"""Levels of a message in which images are looked for."""

_DEFINITION = "#/$defs/"
_BEGINNINGS = {
    b"\x89PNG\r\n\x1a\n": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"GIF87a": "image/gif",
    b"GIF89a": "image/gif",
}
MOST_GOALS = 20
"""Goals of one action that are listed: the newest ones."""
_PLAIN: Codec[Any] = Codec(cast("Any", Any), "a message")
_HEAD = ("goal_id", "action", "status")


class ToolError(Exception):
    """The answer of a tool that did not do what it was asked for.

    The text is for the model: it says what happened, and what to do next.
    """


async def find_goal(goals: AgentGoals[ToolAction], text: str) -> AgentGoal[ToolAction]:
    """Return the goal of an ID; also one that cannot be followed any more.

    Raises:
        ToolError: The text is not the ID of a goal that is known now.
    """
    try:
        goal_id = GoalID.parse(text)
    except ValueError as exc:
        raise ToolError(f"{exc}.") from exc
    try:
        return await goals.find(goal_id)
    except (ServerNotFound, UnknownGoal) as exc:
        if (known := goals.get(goal_id)) is not None:
            return known
        raise ToolError(
            f"There is no goal {goal_id}: it was never accepted, its server has forgotten it or"
            f" cannot be reached, or its action is not allowed here. Call {STATUS} without a"
            f" goal_id for a list."
        ) from exc
    except ActionError as exc:
        raise ToolError(f"The goal cannot be followed: {exc}") from exc


def data_answer(
    data: dict[str, Any],
    sentence: str = "",
    *,
    error: bool = False,
    images: Sequence[ImageContent] = (),
) -> CallToolResult:
    """Return an answer with data, below a sentence if there is one, and with images after it.

    If the data are too long, the text is their beginning, and the structured content only names the
    goal.
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
    """Return feedback as a short text; one that is text stays as it is, so that a client can join
    the pieces, and may be longer.
    """
    if isinstance(feedback, str):
        return shortened(feedback, LONGEST_TEXT)
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


def message_in(payload: bytes) -> Any:
    """Return the message in a payload as plain data; if there is none, the reason."""
    try:
        return _PLAIN.decode(payload)
    except ProtocolError as exc:
        return {"error": str(exc)}


def goal_answer(goal: AgentGoal[ToolAction], *, cancel_wanted: bool = False) -> CallToolResult:
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
    newest, info = goal.newest, goal.action.info
    if newest is not None and (outcome is None or outcome.status is not GoalStatus.SUCCEEDED):
        feedback = images.take(message_in(newest.payload), info.feedback)
        data |= {"feedback_count": newest.number, "feedback": feedback}
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
        result = None if outcome.result is None else message_in(outcome.result)
        data["result"] = images.take(result, info.result)
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


def overview(
    problems: Mapping[str, str],
    actions: Iterable[ToolAction],
    goals: Mapping[ToolAction, list[GoalInfo]],
) -> dict[str, Any]:
    """Return the servers with their problems, and the actions with their newest goals."""
    return {
        "servers": [_server_entry(name, problem) for name, problem in problems.items()],
        "actions": [_action_entry(one, goals.get(one)) for one in actions],
    }


def _server_entry(name: str, problem: str) -> dict[str, Any]:
    told: dict[str, Any] = {"name": name} if name else {}
    told["reachable"] = not problem
    return {**told, "problem": problem} if problem else told


def _action_entry(action: ToolAction, goals: list[GoalInfo] | None) -> dict[str, Any]:
    told: dict[str, Any] = {"tool": action.label, "action": excerpt(action.info.name)}
    if action.server:
        told["server"] = action.server
    if goals is None:
        return {**told, "problem": "its server does not tell its goals"}
    newest = sorted(goals, key=lambda info: info.stamp, reverse=True)[:MOST_GOALS]
    return {**told, "goals": [_goal_entry(info) for info in newest], "goal_count": len(goals)}


def _goal_entry(info: GoalInfo) -> dict[str, Any]:
    accepted = datetime.fromtimestamp(info.stamp // 10**9, UTC)
    told: dict[str, Any] = {
        "goal_id": str(info.goal_id),
        "status": info.status.name,
        "accepted": accepted.isoformat(),
        "feedback_count": info.feedback_count,
    }
    if info.parent is not None:
        step = excerpt(info.parent.step)
        told["parent"] = {"goal_id": str(info.parent.goal_id), "step": step}
    return {**told, "client": excerpt(info.client)} if info.client else told


# Images


class Images:
    """The images of one answer."""

    def __init__(self) -> None:
        self.found: list[ImageContent] = []
        """The images, in the order of their numbers."""

    def take(self, message: Any, schema: Mapping[str, Any]) -> Any:
        """Return a message of that schema with the names of its images in place of them."""
        return self._take(message, schema, schema.get("$defs", {}), DEEPEST)

    def _take(self, value: Any, part: Any, definitions: Mapping[str, Any], levels: int) -> Any:
        if is_map(part) and isinstance(part.get("$ref"), str):
            part = definitions.get(part["$ref"].removeprefix(_DEFINITION))
        known: Mapping[Any, Any] = part if is_map(part) else {}
        if isinstance(value, bytes):
            return self._named(value, known.get("contentMediaType"))
        if levels == 0:
            return value
        if is_map(value):
            fields = known.get("properties", {})
            return {
                name: self._take(one, fields.get(name), definitions, levels - 1)
                for name, one in value.items()
            }
        if is_list(value):
            items = known.get("items")
            return [self._take(one, items, definitions, levels - 1) for one in value]
        return value

    def _named(self, value: bytes, declared: Any) -> Any:
        """Return the name of an image; the bytes themselves if they are not one."""
        kind = _kind_of(value, declared)
        if not kind or not 0 < len(value) <= LARGEST_IMAGE or len(self.found) == MOST_IMAGES:
            return value
        data = base64.b64encode(value).decode()
        self.found.append(ImageContent(type="image", data=data, mime_type=kind))
        return f"image {len(self.found)}: {kind}, {len(value)} bytes"


def _kind_of(value: bytes, declared: Any) -> str:
    """Return the media type of an image; empty if the bytes are not one."""
    if isinstance(declared, str) and declared.startswith("image/"):
        return declared
    if value[:4] == b"RIFF" and value[8:12] == b"WEBP":
        return "image/webp"
    return next((kind for start, kind in _BEGINNINGS.items() if value.startswith(start)), "")
