"""Errors as answers of HTTP: a status, and problem details (RFC 9457) in JSON.

A problem of HTTP itself, such as a method that is not there, has no type of its own. An error of
the library has its name as the type, `urn:fibaction:GoalRejected`, and its text as the detail.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

import msgspec

from fibaction.border.http_access import Refused
from fibaction.schema.payload import PayloadError
from fibaction.wire.errors import sendable
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ConnectionLost,
    GoalKept,
    GoalRejected,
    InvalidMessage,
    LimitReached,
    ProtocolError,
    RejectionCode,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)

PROBLEM_JSON = "application/problem+json"
RETRY = ("Retry-After", "1")
"""The header for a client that may try again soon."""

STATUSES: dict[type[ActionError], tuple[int, str]] = {
    GoalRejected: (422, "The server rejected the goal."),
    CancelRejected: (409, "The goal cannot be canceled."),
    UnknownGoal: (404, "The goal is unknown."),
    AuthenticationFailed: (403, "The client lacks the permission."),
    LimitReached: (429, "A limit is reached."),
    GoalKept: (503, "The server has stopped, and keeps the goal."),
    ServerNotFound: (503, "The server of the action does not answer."),
    ConnectionLost: (502, "The connection to the server of the action was lost."),
    InvalidMessage: (413, "The goal is too large."),
    ProtocolError: (502, "The server of the action sent an invalid message."),
    ServerFailed: (500, "The server has a bug."),
    TransportError: (502, "The server of the action cannot be reached."),
}
"""The status and the title of each error; a subclass that is not here has those of its base."""

REJECTIONS = {
    RejectionCode.BUSY: 503,
    RejectionCode.DUPLICATE: 409,
    RejectionCode.STOPPING: 503,
}
"""The status of a rejected goal, if it is not that of `GoalRejected`."""


@dataclass(frozen=True)
class Problem:
    """One problem, as it is told to a client."""

    status: int
    detail: str
    title: str = ""
    type: str = "about:blank"
    members: dict[str, Any] = field(default_factory=dict[str, Any])
    """Further members."""
    headers: tuple[tuple[str, str], ...] = ()

    @property
    def body(self) -> bytes:
        """The problem as JSON."""
        title = self.title or HTTPStatus(self.status).phrase
        details = {"type": self.type, "title": title, "status": self.status, "detail": self.detail}
        return msgspec.json.encode(details | self.members)


def problem_of(error: Refused | PayloadError | ActionError) -> Problem:
    """Return the problem that an error is."""
    text = sendable(str(error))
    if isinstance(error, Refused):
        return Problem(error.status, text, headers=error.headers)
    if isinstance(error, PayloadError):
        return _invalid_goal(text, [sendable(one) for one in error.problems])
    if isinstance(error, GoalRejected) and error.code is RejectionCode.UNREADABLE:
        reason = sendable(error.reason)
        return _invalid_goal(reason, [reason])
    known = next(kind for kind in (*type(error).__mro__, ServerFailed) if kind in STATUSES)
    status, title = STATUSES[known]
    members: dict[str, Any] = {}
    if isinstance(error, GoalRejected):
        text, members = sendable(error.reason), {"code": error.code.name}
        status = REJECTIONS.get(error.code, status)
    headers = (RETRY,) if status in (429, 503) else ()
    return Problem(status, text, title, _type(known.__name__), members, headers)


def _invalid_goal(text: str, problems: list[str]) -> Problem:
    """Return the problem of a goal that is not of its type, whichever server has found it."""
    members = {"problems": problems, "code": RejectionCode.UNREADABLE.name}
    return Problem(422, text, "The goal is not of its type.", _type("InvalidGoal"), members)


def _type(name: str) -> str:
    return f"urn:fibaction:{name}"
