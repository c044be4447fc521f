"""`PendingCalls`: what one rosbridge client waits for, and the messages that it gets, as JSON text.

These rules come from the clients, roslibjs 2 and roslibpy 2:

- `status` is in each `action_result`; without it roslibpy looks into the values, and breaks.
- The values of `result: true` are an object, and those of `result: false` a text, which both
  libraries show.
- A goal that was aborted without a result is `result: false`, so that its reason is shown.
- There is no feedback after the result, and never a `status` or an `action_status`: roslibpy
  raises an error for each.
- A topic is told as `publish` with the name that the client has written, and without an ID.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, TypeAlias, cast

import msgspec

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
    GoalChanged,
    ListActions,
    Received,
    Rejected,
    SendGoal,
    encode,
)
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.action_values import values_text
from fibaction_transports.web.rosbridge.operations import (
    Arguments,
    ClientID,
    FragmentSize,
)
from fibaction_transports.web.rosbridge.server.rosapi import (
    Service,
    ServiceFailed,
    Values,
    cancel_response,
)
from fibaction_transports.web.rosbridge.text_messages import in_fragments

_encode = msgspec.json.Encoder().encode

CREDIT = 2**30
"""Feedback messages for which a goal has credit at first; the same again when they are used up."""
Answer: TypeAlias = Feedback | Ended | Rejected | Failed | Actions | CancelAnswered
"""A frame about something that the client waits for."""
logger = clean_logger("fibaction.web")


class Replies:
    """The messages that answer one operation of a client."""

    def __init__(
        self, op: str, client_id: ClientID, kind: str, name: str, fragment_size: FragmentSize
    ) -> None:
        """Answer with the ID and the name that the client has sent."""
        self._id = client_id
        self._fragment_size = fragment_size
        self._members = _members(op, client_id, kind, name)

    def _told(self, **members: Any) -> list[str]:
        return self._fitting(_encode(self._members | members).decode())

    def _fitting(self, text: str) -> list[str]:
        return in_fragments(text, self._id, self._fragment_size)


def _members(op: str, client_id: ClientID, kind: str, name: str) -> dict[str, Any]:
    members = {"op": op, "id": client_id, kind: name}
    return members if client_id is not None else {"op": op, kind: name}


class GoalReplies(Replies):
    """The messages about one goal of a client."""

    def __init__(self, client_id: ClientID, action: str, fragment_size: FragmentSize) -> None:
        super().__init__("action_result", client_id, "action", action, fragment_size)
        feedback = _encode(_members("action_feedback", client_id, "action", action))
        self._feedback = f'{feedback[:-1].decode()},"values":'

    def feedback(self, payload: bytes) -> list[str]:
        """Return a feedback message.

        Raises:
            PayloadError: JSON cannot express it.
        """
        return self._fitting(f"{self._feedback}{values_text(payload)}}}")

    def ended(self, end: Ended) -> list[str]:
        """Return the end of the goal."""
        try:
            values = None if end.result is None else msgspec.Raw(values_text(end.result).encode())
        except PayloadError as exc:
            return self.failed(str(exc), end.status)
        if values is None and end.status not in (GoalStatus.SUCCEEDED, GoalStatus.CANCELED):
            return self.failed(end.reason, end.status)
        told: dict[str, Any] = {"values": msgspec.Raw(b"{}") if values is None else values}
        told |= {"status": end.status, "result": True}
        return self._told(**told | ({"reason": end.reason} if end.reason else {}))

    def rejected(self, reason: str, code: int) -> list[str]:
        """Return the end of a goal that was not accepted."""
        return self._told(values=reason, status=GoalStatus.UNKNOWN, result=False, code=code)

    def failed(self, text: str, status: GoalStatus = GoalStatus.UNKNOWN) -> list[str]:
        """Return the end of a goal without a result; UNKNOWN if it was not accepted."""
        return self._told(values=text, status=status, result=False)


class SentGoal(msgspec.Struct):
    """A goal that a client has sent, and that has not ended."""

    client_id: ClientID
    action: str
    """The name of the action at its server."""
    goal_id: GoalID
    is_bound: bool
    """True if the goal ends when its client does not come back."""
    replies: GoalReplies
    has_feedback: bool
    """True if the client wants the feedback."""
    feedback_count: int = 0
    """Feedback messages so far."""


class ServiceReplies(Replies):
    """The answer to one call of a service."""

    def __init__(self, client_id: ClientID, service: str, fragment_size: FragmentSize) -> None:
        super().__init__("service_response", client_id, "service", service, fragment_size)

    def answered(self, values: dict[str, Any]) -> list[str]:
        """Return the answer."""
        return self._told(values=values, result=True)

    def failed(self, text: str) -> list[str]:
        """Return an error in place of the answer."""
        return self._told(values=text, result=False)


# Topics


def topic_feedback(goal_id: bytes, payload: bytes) -> Callable[[str], str]:
    """Return what makes the message with a feedback of a goal on a topic.

    Raises:
        PayloadError: JSON cannot express it.
    """
    uuid, values = _uuid_text(goal_id), values_text(payload)
    message = f'{{"goal_id":{{"uuid":"{uuid}"}},"feedback":{values}}}'
    return lambda topic: _published(topic, message)


def topic_statuses(topic: str, goals: Iterable[GoalChanged]) -> str:
    """Return the message with the statuses of goals on a topic."""
    statuses = [
        {
            "goal_info": {
                "goal_id": {"uuid": _uuid_text(goal.goal_id)},
                "stamp": _stamp(goal.stamp),
            },
            "status": goal.status,
        }
        for goal in goals
    ]
    return _published(topic, _encode({"status_list": statuses}).decode())


def _published(topic: str, message: str) -> str:
    members = _encode({"op": "publish", "topic": topic}).decode()
    return f'{members[:-1]},"msg":{message}}}'


def _stamp(nanoseconds: int) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds, 10**9)
    return {"sec": seconds, "nanosec": rest}


def _uuid_text(goal_id: bytes) -> str:
    return base64.b64encode(goal_id).decode()


# What is waited for


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
