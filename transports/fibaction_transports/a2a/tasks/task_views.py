"""Goals as tasks of A2A, and their updates.

goal                            task
accepted                        submitted
executing, canceling            working
succeeded, canceled, aborted    completed, canceled, failed; the result is the artifact `result`
rejected                        rejected
forgotten by its server         failed
"""

from __future__ import annotations

from a2a.types import (
    Artifact,
    Message,
    Part,
    Role,
    Task,
    TaskArtifactUpdateEvent,
    TaskState,
    TaskStatus,
    TaskStatusUpdateEvent,
)
from google.protobuf.timestamp_pb2 import Timestamp

from fibaction.border.abc import FeedbackItem
from fibaction.words.goals import GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.a2a.tasks.a2a_values import data_part, struct_of
from fibaction_transports.a2a.tasks.feedback_position import RESULT
from fibaction_transports.a2a.tasks.followed_task import FollowedTask, KeptUpdate, position
from fibaction_transports.a2a.tasks.skills import Skill

STATES = {
    GoalStatus.UNKNOWN: TaskState.TASK_STATE_FAILED,
    GoalStatus.ACCEPTED: TaskState.TASK_STATE_SUBMITTED,
    GoalStatus.EXECUTING: TaskState.TASK_STATE_WORKING,
    GoalStatus.CANCELING: TaskState.TASK_STATE_WORKING,
    GoalStatus.SUCCEEDED: TaskState.TASK_STATE_COMPLETED,
    GoalStatus.CANCELED: TaskState.TASK_STATE_CANCELED,
    GoalStatus.ABORTED: TaskState.TASK_STATE_FAILED,
}


def task_of(goal: FollowedTask, *, is_whole: bool = True) -> Task:
    """Return a task as it is now; unless it is whole, without what its updates tell."""
    status = status_of(STATES[goal.status], goal.updated_at)
    task = Task(id=str(goal.goal_id), context_id=goal.context_id, status=status)
    task.metadata.CopyFrom(
        struct_of({"skill": goal.skill.label, "accepted_at": goal.stamp // 1_000_000})
    )
    if not is_whole:
        return task
    if goal.outcome is not None:
        task.status.CopyFrom(ended_event(goal).status)
        if (artifact := artifact_of(goal)) is not None:
            task.artifacts.append(artifact)
    elif goal.newest is not None:
        update = feedback_event(goal, goal.newest, goal.updated_at)
        task.status.message.CopyFrom(update.status.message)
        task.metadata.MergeFrom(update.metadata)
    return task


def listed_task(skill: Skill, info: GoalInfo, context_id: str) -> Task:
    """Return a task of which only a line of the server's list is known."""
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


def update_event(goal: FollowedTask, entry: KeptUpdate) -> TaskStatusUpdateEvent:
    """Return the update that tells what is kept."""
    if isinstance(entry.update, FeedbackItem):
        return feedback_event(goal, entry.update, entry.time)
    text = "canceling" if entry.update is GoalStatus.CANCELING else ""
    return _event(goal, status_of(STATES[entry.update], entry.time, text))


def feedback_event(goal: FollowedTask, item: FeedbackItem, seconds: float) -> TaskStatusUpdateEvent:
    """Return the update of a feedback: its data, its number, and where to continue after it."""
    where = str(position(item))
    status = status_of(TaskState.TASK_STATE_WORKING, seconds)
    part = data_part(goal.skill.feedback, item.payload)
    status.message.CopyFrom(agent_message(part, f"feedback-{where}"))
    event = _event(goal, status)
    event.metadata.CopyFrom(
        struct_of({"number": item.number, "attempt": item.attempt, "event_id": where})
    )
    return event


def artifact_of(goal: FollowedTask) -> Artifact | None:
    """Return the result of a goal that has ended; None if it has none."""
    outcome = goal.outcome
    if outcome is None or outcome.result is None:
        return None
    part = data_part(goal.skill.result, outcome.result)
    is_partial = outcome.status is not GoalStatus.SUCCEEDED
    name = "partial result" if is_partial else "result"
    return Artifact(artifact_id=RESULT, name=name, parts=[part])


def artifact_event(goal: FollowedTask) -> TaskArtifactUpdateEvent | None:
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


def ended_event(goal: FollowedTask) -> TaskStatusUpdateEvent:
    """Return the last update of a goal that has ended, with the reason."""
    assert goal.outcome is not None
    outcome = goal.outcome
    return _event(goal, status_of(STATES[outcome.status], goal.updated_at, outcome.reason))


def _event(goal: FollowedTask, status: TaskStatus) -> TaskStatusUpdateEvent:
    return TaskStatusUpdateEvent(
        task_id=str(goal.goal_id), context_id=goal.context_id, status=status
    )


def _timestamp(seconds: float) -> Timestamp:
    timestamp = Timestamp()
    timestamp.FromMilliseconds(int(seconds * 1000))
    return timestamp
