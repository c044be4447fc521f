"""Every error that fibaction raises, under one root.

    ActionError
    ├── GoalRejected          the server did not accept the goal
    ├── GoalAborted           the server ended the goal by itself
    ├── GoalCanceled          the goal ended because its cancel was accepted
    ├── CancelRejected        the server refuses a cancel
    ├── UnknownGoal           no such goal, or none any more
    ├── InvalidTransition     an event that a status does not allow: a bug in fibaction
    ├── ProtocolError         a message that may not be sent like that
    └── TransportError        the server could not be reached as asked
        ├── ServerNotFound        there is none, or not for this action
        ├── ConnectionLost        it was reached, and is not any more
        └── AuthenticationFailed  it does not let this client in, or do that

Data is in attributes (`reason`, `result`, `goal_id`), the text is one sentence.
Nothing here knows of goals in progress, of transports or of tasks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fibaction.goals import GoalID
    from fibaction.states import GoalEvent, GoalStatus


class ActionError(Exception):
    """The root: `except ActionError` catches all that fibaction raises on purpose.

    Only what is wrong in the code that calls is not among it: `TypeError`, `ValueError`, and
    `RuntimeError` for a server that is started twice.
    """


class _Refusal(ActionError):
    """An error with a reason, and the goal it is about once that is known."""

    what = "failed"

    def __init__(self, reason: str, *, goal_id: GoalID | None = None) -> None:
        super().__init__(reason)
        # `GoalRejected(exc)` is easily written, and what is no text would stop on its way.
        self.reason = str(reason)
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
    """The server refuses a cancel; raise it in `on_cancel`. The goal goes on.

    No client gets it: `cancel` gives a `CancelAnswer` with `CancelCode.REJECTED` and the reason.
    """

    what = "cannot be canceled"


WHY_UNKNOWN = "it was never accepted, its result has expired, or the server was started anew"
"""A server that does not know a goal cannot tell which of these it was."""


class UnknownGoal(ActionError):
    """The server knows no such goal: it was never accepted, its result has expired, or the server
    was started anew.
    """

    def __init__(self, goal_id: GoalID) -> None:
        super().__init__(goal_id)
        self.goal_id = goal_id

    def __str__(self) -> str:
        return f"goal {self.goal_id} is unknown: {WHY_UNKNOWN}"


class InvalidTransition(ActionError):
    """An event that a status does not allow: a bug in fibaction, not in what uses it."""

    def __init__(self, status: GoalStatus, event: GoalEvent) -> None:
        super().__init__(status, event)
        self.status = status
        self.event = event

    def __str__(self) -> str:
        return f"a goal that is {self.status.name} cannot {self.event.name}"


class ProtocolError(ActionError):
    """The other side sent something that it may not send, or that is not of the agreed type.

    A goal that is too large for the server is one, too: it is not sent. Where the fault ends the
    connection, those who wait are told of it as `ConnectionLost`.
    """


class TransportError(ActionError):
    """The server could not be reached as asked.

    If it is none of those below: a URL, an address or the types of an action cannot be used,
    something that the transport needs is not installed, or the server cannot answer this request,
    since a limit is reached or the answer is larger than the client takes.
    """


class ServerNotFound(TransportError):
    """There is no such server, or it does not serve this action.

    Also if it did not come, or did not answer, in time, has stopped, or failed itself while
    answering.
    """


class ConnectionLost(TransportError):
    """The connection ended while something was waited for; goals may run on at the server.

    Also if it ended before it was of use: the server is full, or the two do not speak the same.
    """


class AuthenticationFailed(TransportError):
    """The server did not accept the credentials, or the client not the server's.

    Also for a single request, where the server lets the client in and does not allow it that.
    fibaction does not try again by itself.
    """


def text_of(exc: BaseException) -> str:
    """What somebody else's code has raised, in words: `ValueError: too far`.

    An error that cannot say what it is has a name at least: it must not become another one.
    """
    try:
        return f"{type(exc).__name__}: {exc}"
    except Exception:
        return type(exc).__name__


def copy_of(error: ActionError) -> ActionError:
    """Return a new error of the same type, with the same data.

    An error that many tasks wait for is raised once for each: a raised one gathers tracebacks.
    """
    copy = type(error).__new__(type(error), *error.args)
    copy.__dict__.update(error.__dict__)
    copy.args = error.args
    return copy
