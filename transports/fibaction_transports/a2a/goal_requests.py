"""`GoalRequests`: the requests of A2A, as the SDK reads them.

Theory of operation
-------------------

The SDK has the framing: JSON-RPC, server-sent events, errors and the types. Here each request is
about one goal, and the task that it gets is a view of that goal:

    SendMessage             sends a goal, and waits for its end for as long as the policy says
    SendStreamingMessage    sends a goal, and tells its updates
    SubscribeToTask         tells the updates after the one in the header Last-Event-ID
    GetTask, ListTasks      ask the servers of the actions
    CancelTask              cancels the goal

The ID of a task is the ID of its goal, so other doors and a second client know it as well. There is
no store of tasks: see `agent_goals` for what is remembered.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing
from time import time
from typing import Any, NoReturn, TypeAlias

import anyio
import msgspec
from a2a.server.context import ServerCallContext
from a2a.server.request_handlers.request_handler import RequestHandler
from a2a.types import (
    AgentCard,
    CancelTaskRequest,
    GetExtendedAgentCardRequest,
    GetTaskRequest,
    ListTasksRequest,
    ListTasksResponse,
    SendMessageRequest,
    SubscribeToTaskRequest,
    Task,
    TaskArtifactUpdateEvent,
    TaskState,
    TaskStatusUpdateEvent,
)
from a2a.utils.errors import (
    InternalError,
    InvalidParamsError,
    PushNotificationNotSupportedError,
    TaskNotCancelableError,
    TaskNotFoundError,
    UnsupportedOperationError,
)
from a2a.utils.proto_utils import validate_proto_required_fields

from fibaction.words.errors import ActionError, GoalRejected, LimitReached, UnknownGoal
from fibaction.words.goals import GoalID
from fibaction_transports._agents.agent_goals import START, AgentGoal, AgentGoals, Position
from fibaction_transports._agents.robot_actions import AgentPolicy, UnshownGoal, question_about
from fibaction_transports.a2a.agent_card import CardMaker, Skill, Skills
from fibaction_transports.a2a.documents import asked_request
from fibaction_transports.a2a.goal_messages import (
    Question,
    Questions,
    answer_in,
    goal_id_of,
    goal_in,
)
from fibaction_transports.a2a.task_views import (
    AFTER_RESULT,
    artifact_event,
    ended_event,
    listed_task,
    page_of,
    position_of,
    status_of,
    task_of,
    update_event,
)

CANCEL_WAIT = 5.0
"""Seconds that the answer to a cancel waits for the end of the goal."""

Update: TypeAlias = Task | TaskStatusUpdateEvent | TaskArtifactUpdateEvent


class GoalRequests(RequestHandler):
    """The requests to one server."""

    def __init__(
        self, skills: Skills, goals: AgentGoals[Skill], cards: CardMaker, policy: AgentPolicy
    ) -> None:
        self._skills = skills
        self._goals = goals
        self._cards = cards
        self._policy = policy
        self._questions = Questions()

    async def on_message_send(self, params: SendMessageRequest, context: ServerCallContext) -> Task:
        """Send a goal, and wait for its end unless the agent does not want to."""
        validate_proto_required_fields(params)
        goal = await self._send(params)
        if isinstance(goal, Task):
            return goal
        if not params.configuration.return_immediately:
            with anyio.move_on_after(self._policy.patience):
                await goal.ended.wait()
        return task_of(goal)

    async def on_message_send_stream(
        self, params: SendMessageRequest, context: ServerCallContext
    ) -> AsyncGenerator[Update, None]:
        """Send a goal, and tell its updates."""
        validate_proto_required_fields(params)
        goal = await self._send(params)
        if isinstance(goal, Task):
            yield goal
            return
        async for update in _updates(goal, START, statuses=True):
            yield update

    async def on_subscribe_to_task(
        self, params: SubscribeToTaskRequest, context: ServerCallContext
    ) -> AsyncGenerator[Update, None]:
        """Tell the updates of a task after the position that the agent has seen last."""
        validate_proto_required_fields(params)
        headers = context.state["headers"]
        after = position_of(headers["last-event-id"]) if "last-event-id" in headers else None
        goal_id = _goal_id(params.id)
        if (question := self._question(goal_id)) is not None:
            yield _asking(question)
            return
        goal = await self._find(goal_id)
        if after is None and goal.status.is_terminal:
            raise UnsupportedOperationError(
                "the task has ended: GetTask tells its result; to read its updates, send the header"
                " Last-Event-ID, with 0 for all"
            )
        async for update in _updates(goal, after or START):
            yield update

    async def on_get_task(self, params: GetTaskRequest, context: ServerCallContext) -> Task:
        """Return a task as it is now."""
        validate_proto_required_fields(params)
        goal_id = _goal_id(params.id)
        if (question := self._question(goal_id)) is not None:
            return _asking(question)
        return task_of(await self._find(goal_id))

    async def on_list_tasks(
        self, params: ListTasksRequest, context: ServerCallContext
    ) -> ListTasksResponse:
        """Return a page of the goals of all clients."""
        tasks = [
            listed_task(skill, info, known.context_id if known else str(info.goal_id))
            for skill, infos in (await self._goals.listed()).items()
            for info in infos
            for known in (self._goals.get(info.goal_id),)
        ]
        return page_of(tasks, params)

    async def on_cancel_task(self, params: CancelTaskRequest, context: ServerCallContext) -> Task:
        """Cancel the goal of a task, and wait a moment for its end."""
        validate_proto_required_fields(params)
        goal_id = _goal_id(params.id)
        if (question := self._question(goal_id)) is not None:
            self._questions.close(question)
            return _task(
                question, TaskState.TASK_STATE_CANCELED, "it was canceled before it was sent"
            )
        goal = await self._find(goal_id)
        self._check_cancel(goal)
        try:
            rejected = await goal.cancel()
        except ActionError as exc:
            raise InternalError(f"the goal may continue: {exc}") from exc
        if rejected:
            raise TaskNotCancelableError(f"the server rejects the cancel: {rejected}")
        with anyio.move_on_after(CANCEL_WAIT):
            await goal.ended.wait()
        return task_of(goal)

    async def on_get_extended_agent_card(
        self, params: GetExtendedAgentCardRequest, context: ServerCallContext
    ) -> AgentCard:
        """Return the card with the skills."""
        return self._cards.card(asked_request().url, is_known=True)

    # Without push notifications

    async def on_create_task_push_notification_config(self, params: Any, context: Any) -> NoReturn:
        raise PushNotificationNotSupportedError

    on_get_task_push_notification_config = on_create_task_push_notification_config
    on_list_task_push_notification_configs = on_create_task_push_notification_config
    on_delete_task_push_notification_config = on_create_task_push_notification_config

    # Their parts

    async def _send(self, params: SendMessageRequest) -> AgentGoal[Skill] | Task:
        """Send the goal of a message, and return it; or the task, if there is no goal yet, or none
        any more.
        """
        message = params.message
        if message.task_id:
            return await self._answer(params)
        if self._policy.read_only:
            raise UnsupportedOperationError("nothing was sent: this server is read-only")
        skill, goal = await goal_in(params, asked_request().documents, self._skills)
        goal_id = goal_id_of(message)
        if not self._policy.asks(skill.server, skill.info.name):
            return await self._send_goal(skill, goal_id, goal, message.context_id)
        try:
            text = question_about(skill, goal)
        except UnshownGoal as exc:
            raise InvalidParamsError(str(exc)) from exc
        context_id = message.context_id
        return _asking(self._questions.ask(goal_id, skill, goal, context_id, text, _client()))

    def _question(self, goal_id: GoalID) -> Question | None:
        """Return the question about a goal that the asking client may answer; None without one."""
        return self._questions.find(goal_id, _client())

    async def _answer(self, params: SendMessageRequest) -> AgentGoal[Skill] | Task:
        """Take the answer to a question."""
        goal_id = _goal_id(params.message.task_id)
        question = self._question(goal_id)
        if question is None:
            goal = await self._find(goal_id)
            state = "has ended" if goal.status.is_terminal else "takes no messages while it runs"
            raise UnsupportedOperationError(
                f"the task {state}: send a message without a task ID for another goal"
            )
        answer = answer_in(asked_request().documents)
        if answer is None:
            return _asking(question)
        self._questions.close(question)
        if not answer:
            text = "nothing was sent: the user has declined"
            return _task(question, TaskState.TASK_STATE_REJECTED, text)
        return await self._send_goal(question.skill, goal_id, question.goal, question.context_id)

    async def _send_goal(
        self, skill: Skill, goal_id: GoalID, goal: Any, context_id: str
    ) -> AgentGoal[Skill] | Task:
        payload = msgspec.msgpack.encode(goal)
        try:
            return await self._goals.send(
                skill, goal_id, payload, owner=_client(), context_id=context_id
            )
        except GoalRejected as exc:
            status = status_of(TaskState.TASK_STATE_REJECTED, time(), exc.reason)
            task = Task(id=str(goal_id), context_id=context_id or str(goal_id), status=status)
            task.metadata.update({"code": exc.code.name})
            return task
        except LimitReached as exc:
            raise InternalError(f"the goal was not sent: {exc}") from exc
        except ActionError as exc:
            raise InternalError(f"the goal may not have been sent: {exc}") from exc

    async def _find(self, goal_id: GoalID) -> AgentGoal[Skill]:
        """Return the goal of a task.

        Raises:
            TaskNotFoundError: No server knows it.
            InternalError: It cannot be followed now, or not all servers can be asked.
        """
        try:
            return await self._goals.find(goal_id)
        except UnknownGoal as exc:
            raise TaskNotFoundError(
                f"there is no task {goal_id}: it was never accepted, its server has forgotten it,"
                f" or its action is not allowed here"
            ) from exc
        except ActionError as exc:
            raise InternalError(f"the task cannot be followed now: {exc}") from exc

    def _check_cancel(self, goal: AgentGoal[Skill]) -> None:
        """Check whether an agent may cancel a goal.

        Raises:
            TaskNotCancelableError: It may not, or the goal has ended.
        """
        skill = goal.action
        if goal.status.is_terminal:
            raise TaskNotCancelableError("the task has ended")
        if self._policy.read_only:
            raise TaskNotCancelableError("this server is read-only: nothing can be canceled")
        if goal.owner != _client() and self._policy.asks(skill.server, skill.info.name):
            raise TaskNotCancelableError(
                "another client has sent the goal, or this server before a restart, and a user"
                " would have to agree: cancel it there"
            )


def _client() -> str:
    """Return the name of the client that asks."""
    return asked_request().client or ""


def _goal_id(task_id: str) -> GoalID:
    try:
        return GoalID.parse(task_id)
    except ValueError as exc:
        raise TaskNotFoundError(f"there is no such task: {exc}") from exc


def _asking(question: Question) -> Task:
    text = f"{question.text}\n\nAsk your user, and answer this task with the text yes or no."
    return _task(question, TaskState.TASK_STATE_INPUT_REQUIRED, text)


def _task(question: Question, state: TaskState, text: str) -> Task:
    return Task(
        id=str(question.goal_id),
        context_id=question.context_id,
        status=status_of(state, time(), text),
    )


async def _updates(
    goal: AgentGoal[Skill], after: Position, *, statuses: bool = False
) -> AsyncGenerator[Update, None]:
    """Iterate over the updates of a task, the task itself first, up to its end.

    Raises:
        InternalError: The goal cannot be followed any more.
    """
    task = task_of(goal, is_whole=False)
    if statuses:  # all that has happened since is told
        task.status.state = TaskState.TASK_STATE_SUBMITTED
    yield task
    async with aclosing(goal.updates(after, statuses=statuses)) as entries:
        async for entry in entries:
            yield update_event(goal, entry)
    if goal.error is not None:
        raise InternalError(
            f"the task cannot be followed now, and may continue: {goal.error}; subscribe again"
        )
    artifact = artifact_event(goal)
    if artifact is not None and after != AFTER_RESULT:
        yield artifact
    yield ended_event(goal)
