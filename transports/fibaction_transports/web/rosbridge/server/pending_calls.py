"""`PendingCalls`: what one rosbridge client waits for, and the messages that it gets for it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import TypeAlias, cast

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.schema.payload import PayloadError
from fibaction.wire.errors import sendable
from fibaction.wire.messages import (
    Actions,
    CancelAnswered,
    CancelGoals,
    Credit,
    Ended,
    Failed,
    Feedback,
    FromServer,
    ListActions,
    Received,
    Rejected,
    SendGoal,
    encode,
)
from fibaction.words.goals import GoalID
from fibaction_transports.web.rosbridge.operations import Arguments, ClientID
from fibaction_transports.web.rosbridge.server.replies import SentGoal, ServiceReplies
from fibaction_transports.web.rosbridge.server.rosapi import (
    Service,
    ServiceFailed,
    Values,
    cancel_response,
)

CREDIT = 2**30
"""Feedback messages for which a goal has credit at first; the same again when they are used up."""

Answer: TypeAlias = Feedback | Ended | Rejected | Failed | Actions | CancelAnswered
"""A frame about something that the client waits for."""

logger = clean_logger("fibaction.web")


class PendingCalls:
    """The goals, the calls and the cancels of one connection, by the requests of its session."""

    def __init__(self, peer: str, note: Callable[[str], None]) -> None:
        """Let `note` log something about the client once."""
        self._peer = peer
        self._note = note
        self._requests = count(1)
        self._goals: dict[int, SentGoal] = {}
        self._calls: dict[int, tuple[ServiceReplies, Callable[[FromServer], Values]]] = {}
        self._cancels: dict[int, SentGoal] = {}
        self._latest: dict[ClientID, int] = {}
        self._replies: list[bytes] = []

    # To the session

    def send_goal(
        self, goal: SentGoal, payload: bytes, meta: dict[str, str] | None = None
    ) -> bytes:
        """Return the frame that sends a goal."""
        request = next(self._requests)
        self._goals[request] = goal
        self._latest[goal.client_id] = request
        credit = CREDIT if goal.has_feedback else None
        return encode(
            SendGoal(request, goal.action, goal.goal_id, payload, credit, meta=meta, checked=True)
        )

    def latest_goal(self, client_id: ClientID) -> SentGoal | None:
        """Return the goal that the client has sent last with that ID, if it has not ended."""
        return self._goals.get(self._latest.get(client_id, 0))

    def cancel_goal(self, goal: SentGoal) -> bytes:
        """Return the frame that cancels a goal of this client."""
        request = next(self._requests)
        self._cancels[request] = goal
        return encode(CancelGoals(request, goal.action, goal.goal_id, None))

    def cancel_goals(
        self, replies: ServiceReplies, action: str, goal_id: bytes | None, stamp: int | None
    ) -> bytes:
        """Return the frame that cancels goals of any client."""
        request = next(self._requests)
        self._calls[request] = (
            replies,
            lambda answer: cancel_response(cast("CancelAnswered", answer)),
        )
        return encode(CancelGoals(request, action, goal_id, stamp))

    def call(self, replies: ServiceReplies, service: Service, args: Arguments) -> bytes:
        """Return the frame that asks for what a service needs."""
        request = next(self._requests)
        self._calls[request] = (
            replies,
            lambda answer: service(cast("Actions", answer).actions, args),
        )
        return encode(ListActions(request))

    def take_replies(self) -> list[bytes]:
        """Return the frames for the session about what was written."""
        replies, self._replies = self._replies, []
        return replies

    # To the client

    def texts_of(self, message: Answer) -> list[str]:
        """Return the messages for the client that a frame of the session is."""
        if isinstance(message, Feedback):
            return self._feedback(message)
        if isinstance(message, Ended | Rejected):
            return self._ended(message)
        if isinstance(message, Failed):
            return self._failed(message)
        return self._answered(message)

    def _feedback(self, message: Feedback) -> list[str]:
        goal = self._goals[message.id]
        goal.feedback_count += 1
        if goal.feedback_count % CREDIT == 0:
            self._replies.append(encode(Credit(message.id, CREDIT)))
        try:
            return goal.replies.feedback(message.payload)
        except PayloadError as exc:
            self._note(f"feedback of the action {goal.action!r} is left out: {exc}")
            return []

    def _ended(self, message: Ended | Rejected) -> list[str]:
        goal = self._forget(message.id)
        if isinstance(message, Rejected):
            return goal.replies.rejected(message.reason, message.code)
        self._replies.append(encode(Received(message.id)))
        missed = message.place - goal.feedback_count if goal.has_feedback else 0
        if missed > 0:
            count = f"{missed} of {message.place} feedback messages"
            self._note(f"it reads slowly: {count} of goal {goal.goal_id} were dropped")
        return goal.replies.ended(message)

    def _forget(self, request: int) -> SentGoal:
        goal = self._goals.pop(request)
        if self._latest.get(goal.client_id) == request:
            del self._latest[goal.client_id]
        return goal

    def _failed(self, message: Failed) -> list[str]:
        if message.id in self._goals:
            return self._forget(message.id).replies.failed(message.text)
        if message.id in self._calls:
            replies, _ = self._calls.pop(message.id)
            return replies.failed(message.text)
        self._log_cancel(message.id, message.text)
        return []

    def _answered(self, message: Actions | CancelAnswered) -> list[str]:
        if message.id not in self._calls:
            reason = message.reason if isinstance(message, CancelAnswered) else ""
            self._log_cancel(message.id, reason)
            return []
        replies, values_of = self._calls.pop(message.id)
        try:
            return replies.answered(values_of(message))
        except ServiceFailed as exc:
            return replies.failed(sendable(str(exc)))

    def _log_cancel(self, request: int, reason: str) -> None:
        """Log why a goal is not canceled: rosbridge has no answer to `cancel_action_goal`."""
        goal = self._cancels.pop(request)
        if reason:
            text = excerpt(reason)
            logger.info("%s: goal %s is not canceled: %s", self._peer, goal.goal_id, text)

    def bound_goals(self) -> list[tuple[str, GoalID]]:
        """Return the goals that end with their client, each with the name of its action."""
        return [(goal.action, goal.goal_id) for goal in self._goals.values() if goal.is_bound]
