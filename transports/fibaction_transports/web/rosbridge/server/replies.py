"""The messages to a rosbridge client, as JSON text.

These rules come from the clients, roslibjs 2 and roslibpy 2:

- `status` is in each `action_result`; without it roslibpy looks into the values, and breaks.
- The values of `result: true` are an object, and those of `result: false` a text, which both
  libraries show.
- A goal that was aborted without a result is `result: false`, so that its reason is shown.
- There is no feedback behind the result, and never a `status` or an `action_status`: roslibpy
  raises an error for each.
- A topic is told as `publish` with the name that the client has written, and without an ID.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from fibaction.schema.payload import PayloadError
from fibaction.wire.messages import Ended, GoalChanged
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.action_values import values_text
from fibaction_transports.web.rosbridge.operations import (
    ClientID,
    FragmentSize,
)
from fibaction_transports.web.rosbridge.text_messages import in_fragments

_encode = msgspec.json.Encoder().encode


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
