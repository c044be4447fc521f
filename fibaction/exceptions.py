"""Every error that fibaction raises, under one root.

    ActionError
    ├── GoalRejected          the server did not accept the goal
    ├── GoalAborted           the server ended the goal by itself
    ├── GoalCanceled          the goal ended because its cancel was accepted
    ├── CancelRejected        the server refused a cancel
    ├── UnknownGoal           no such goal, or its result has expired
    ├── InvalidTransition     an event that a status does not allow: a bug in fibaction
    ├── ProtocolError         the other side sent what it may not send
    └── TransportError        the server could not be reached as asked
        ├── ServerNotFound
        ├── ConnectionLost
        └── AuthenticationFailed

Data is in attributes (`reason`, `result`, `goal_id`), the text is one sentence.
Nothing here knows of goals in progress, of transports or of tasks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fibaction.goals import GoalID
    from fibaction.states import GoalEvent, GoalStatus


class ActionError(Exception):
    """The root: `except ActionError` catches all that fibaction raises on purpose."""


class _Refusal(ActionError):
    """An error with a reason, and the goal it is about once that is known."""

    what = "failed"

    def __init__(self, reason: str, *, goal_id: GoalID | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.goal_id = goal_id

    def __str__(self) -> str:
        if self.goal_id is None:
            return self.reason or f"the goal {self.what}"
        return f"goal {self.goal_id} {self.what}" + (f": {self.reason}" if self.reason else "")


class GoalRejected(_Refusal):
    """The server did not accept the goal; `reason` says why. Nothing was run.

    Raise it in `on_goal` to reject; a client's `send_goal` raises it.
    """

    what = "was rejected"


class GoalAborted(_Refusal):
    """The server ended the goal by itself; `reason` says why, `result` is what there was, or None.

    Raise it in an executor to abort with a partial result; a client's `result()` raises it.
    """

    what = "was aborted"

    def __init__(self, reason: str, *, result: Any = None, goal_id: GoalID | None = None) -> None:
        super().__init__(reason, goal_id=goal_id)
        self.result = result


class GoalCanceled(_Refusal):
    """The goal ended because its cancel was accepted; `result` is what there was, or None.

    Raise it in an executor that was asked to stop, to hand over a partial result; a client's
    `result()` raises it.
    """

    what = "was canceled"

    def __init__(
        self, reason: str = "", *, result: Any = None, goal_id: GoalID | None = None
    ) -> None:
        super().__init__(reason, goal_id=goal_id)
        self.result = result


class CancelRejected(_Refusal):
    """The server refuses a cancel; raise it in `on_cancel`. The goal goes on."""

    what = "cannot be canceled"


class UnknownGoal(ActionError):
    """The server knows no such goal: it was never accepted, or its result has expired."""

    def __init__(self, goal_id: GoalID) -> None:
        super().__init__(goal_id)
        self.goal_id = goal_id

    def __str__(self) -> str:
        return f"goal {self.goal_id} is unknown: it was never accepted, or its result has expired"


class InvalidTransition(ActionError):
    """An event that a status does not allow: a bug in fibaction, not in what uses it."""

    def __init__(self, status: GoalStatus, event: GoalEvent) -> None:
        super().__init__(status, event)
        self.status = status
        self.event = event

    def __str__(self) -> str:
        return f"a goal that is {self.status.name} cannot {self.event.name}"


class ProtocolError(ActionError):
    """The other side sent something that it may not send, or that is not of the agreed type."""


class TransportError(ActionError):
    """The server could not be reached as asked."""


class ServerNotFound(TransportError):
    """There is no such server, or it does not serve this action."""


class ConnectionLost(TransportError):
    """The connection ended while something was waited for; goals may run on at the server."""


class AuthenticationFailed(TransportError):
    """The server did not accept the credentials, or the client not the server's."""
