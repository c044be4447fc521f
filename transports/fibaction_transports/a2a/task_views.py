"""Goals as tasks of A2A, and their updates.

goal                            task
accepted                        submitted
executing, canceling            working
succeeded, canceled, aborted    completed, canceled, failed; the result is the artifact `result`
rejected                        rejected
forgotten by its server         failed

Each update has its position as text in its metadata, `event_id`: `17` for feedback, or `2.17` in
the second attempt at the goal, as in the events of the REST interface; `result` for the
artifact. An agent sends the last one that it has seen in the header `Last-Event-ID`.
"""

from __future__ import annotations

import math
import re

from a2a.types import (
    Artifact,
    ListTasksRequest,
    ListTasksResponse,
    Message,
    Part,
    Role,
    Task,
    TaskArtifactUpdateEvent,
    TaskState,
    TaskStatus,
    TaskStatusUpdateEvent,
)
from a2a.utils.errors import InvalidParamsError
from google.protobuf.timestamp_pb2 import Timestamp

from fibaction.border.abc import FeedbackItem
from fibaction.words.goals import GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.agent_goals import AgentGoal, KeptUpdate, Position
from fibaction_transports.a2a.agent_card import Skill
from fibaction_transports.a2a.documents import data_part, shown_text, struct_of

DEFAULT_PAGE = 50
LARGEST_PAGE = 100
RESULT = "result"
"""The ID of the artifact, and the position after it."""

AFTER_RESULT: Position = (math.inf, 0)
_POSITION = re.compile(r"(?:([1-9]\d{0,8})\.)?(\d{1,18})", re.ASCII)

STATES = {
    GoalStatus.UNKNOWN: TaskState.TASK_STATE_FAILED,
    GoalStatus.ACCEPTED: TaskState.TASK_STATE_SUBMITTED,
    GoalStatus.EXECUTING: TaskState.TASK_STATE_WORKING,
    GoalStatus.CANCELING: TaskState.TASK_STATE_WORKING,
    GoalStatus.SUCCEEDED: TaskState.TASK_STATE_COMPLETED,
    GoalStatus.CANCELED: TaskState.TASK_STATE_CANCELED,
    GoalStatus.ABORTED: TaskState.TASK_STATE_FAILED,
}


def position_of(text: str) -> Position:
    """Return the position in a header `Last-Event-ID`.

    Raises:
        InvalidParamsError: It is not one.
    """
    if text == RESULT:
        return AFTER_RESULT
    found = _POSITION.fullmatch(text)
    if found is None:
        raise InvalidParamsError(
            f"the header Last-Event-ID is the event_id of an update, such as 17, not {text!r}"
        )
    return int(found[1] or 1), int(found[2])


def task_of(goal: AgentGoal[Skill], *, is_whole: bool = True) -> Task:
    """Return a task as it is now; unless it is whole, without what its updates tell."""
    status = status_of(STATES[goal.status], goal.updated_at)
    task = Task(id=str(goal.goal_id), context_id=goal.context_id, status=status)
    task.metadata.CopyFrom(
        struct_of({"skill": goal.action.label, "accepted_at": goal.stamp // 1_000_000})
    )
    if not is_whole:
        return task
    if goal.outcome is not None:
        task.status.CopyFrom(ended_event(goal).status)
        if (artifact := artifact_of(goal)) is not None:
            task.artifacts.append(artifact)
    elif goal.newest is not None:
        update = feedback_event(goal, goal.newest)
        task.status.message.CopyFrom(update.status.message)
        task.metadata.MergeFrom(update.metadata)
    return task


def listed_task(skill: Skill, info: GoalInfo, context_id: str) -> Task:
    """Return a task made of only a line of the server's list."""
    seconds = (info.ended_at or info.stamp) / 1e9
    task = Task(
        id=str(info.goal_id),
        context_id=context_id,
        status=status_of(STATES[info.status], seconds, info.reason),
    )
    task.metadata.CopyFrom(
        struct_of(
            {
                "skill": skill.label,
                "accepted_at": info.stamp // 1_000_000,
                "number": info.feedback_count,
                "attempt": info.attempt,
            }
        )
    )
    return task


def status_of(state: TaskState, seconds: float, text: str = "") -> TaskStatus:
    """Return a status at a time in seconds since 1970, with a message if there is a text."""
    status = TaskStatus(state=state, timestamp=_timestamp(seconds))
    if text:
        status.message.CopyFrom(agent_message(Part(text=text)))
    return status


def agent_message(part: Part, message_id: str = "status") -> Message:
    """Return a message of the agent, with one part."""
    return Message(message_id=message_id, role=Role.ROLE_AGENT, parts=[part])


def update_event(goal: AgentGoal[Skill], entry: KeptUpdate) -> TaskStatusUpdateEvent:
    """Return the update that tells what is kept."""
    if isinstance(entry.update, FeedbackItem):
        return feedback_event(goal, entry.update)
    text = "canceling" if entry.update is GoalStatus.CANCELING else ""
    return _event(goal, status_of(STATES[entry.update], entry.time, text))


def feedback_event(goal: AgentGoal[Skill], item: FeedbackItem) -> TaskStatusUpdateEvent:
    """Return the update of a feedback: its data, time, number, and where to continue after it."""
    where = str(item.number) if item.attempt == 1 else f"{item.attempt}.{item.number}"
    status = status_of(TaskState.TASK_STATE_WORKING, item.at / 1e9)
    part = data_part(goal.action.feedback, item.payload)
    status.message.CopyFrom(agent_message(part, f"feedback-{where}"))
    event = _event(goal, status)
    event.metadata.CopyFrom(
        struct_of({"number": item.number, "attempt": item.attempt, "event_id": where})
    )
    return event


def artifact_of(goal: AgentGoal[Skill]) -> Artifact | None:
    """Return the result of a goal that has ended; None if it has none."""
    outcome = goal.outcome
    if outcome is None or outcome.result is None:
        return None
    codec = goal.action.result
    parts = [data_part(codec, outcome.result)]
    if parts[0].HasField("data") and (text := shown_text(codec, outcome.result)):
        parts.append(Part(text=text))  # many agents read no data
    is_partial = outcome.status is not GoalStatus.SUCCEEDED
    name = "partial result" if is_partial else "result"
    return Artifact(artifact_id=RESULT, name=name, parts=parts)


def artifact_event(goal: AgentGoal[Skill]) -> TaskArtifactUpdateEvent | None:
    """Return the update of the result; None if there is none."""
    if (artifact := artifact_of(goal)) is None:
        return None
    return TaskArtifactUpdateEvent(
        task_id=str(goal.goal_id),
        context_id=goal.context_id,
        artifact=artifact,
        last_chunk=True,
        metadata=struct_of({"event_id": RESULT}),
    )


def ended_event(goal: AgentGoal[Skill]) -> TaskStatusUpdateEvent:
    """Return the last update of a goal that has ended, with the reason."""
    assert goal.outcome is not None
    outcome = goal.outcome
    return _event(goal, status_of(STATES[outcome.status], goal.updated_at, outcome.reason))


def _event(goal: AgentGoal[Skill], status: TaskStatus) -> TaskStatusUpdateEvent:
    return TaskStatusUpdateEvent(
        task_id=str(goal.goal_id), context_id=goal.context_id, status=status
    )


def _timestamp(seconds: float) -> Timestamp:
    timestamp = Timestamp()
    timestamp.FromMilliseconds(int(seconds * 1000))
    return timestamp


# Pages of the list of tasks


def page_of(tasks: list[Task], request: ListTasksRequest) -> ListTasksResponse:
    """Return the page of a list that a request asks for: the newest tasks first.

    Raises:
        InvalidParamsError: The size or the token of the page is invalid.
    """
    size = request.page_size if request.HasField("page_size") else DEFAULT_PAGE
    if not 0 < size <= LARGEST_PAGE:
        raise InvalidParamsError(f"pageSize must be between 1 and {LARGEST_PAGE}, not {size}")
    wanted = [task for task in tasks if _is_wanted(task, request)]
    wanted.sort(key=_key, reverse=True)
    rest = wanted
    if token := request.page_token:
        time, _, task_id = token.partition("-")
        if not time.isdecimal() or len(time) > 20:
            raise InvalidParamsError("pageToken is the nextPageToken of the page before")
        rest = [task for task in wanted if _key(task) < (int(time), task_id)]
    page = rest[:size]
    more = f"{_key(page[-1])[0]}-{page[-1].id}" if len(rest) > size else ""
    return ListTasksResponse(
        tasks=page, next_page_token=more, page_size=size, total_size=len(wanted)
    )


def _is_wanted(task: Task, request: ListTasksRequest) -> bool:
    if request.context_id and request.context_id != task.context_id:
        return False
    if request.status not in (TaskState.TASK_STATE_UNSPECIFIED, task.status.state):
        return False
    after = request.status_timestamp_after.ToMilliseconds()
    return not after or task.status.timestamp.ToMilliseconds() >= after


def _key(task: Task) -> tuple[int, str]:
    return task.status.timestamp.ToMilliseconds(), task.id
