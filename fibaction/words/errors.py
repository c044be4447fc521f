"""Every error that fibaction raises, under one root.

    ActionError
    ├── GoalRejected          the server did not accept the goal
    ├── GoalAborted           the server ended the goal by itself
    ├── GoalCanceled          the goal ended because its cancel was accepted
    ├── GoalTimeout           the goal took longer than the client's timeout
    ├── CancelRejected        the server rejects a cancel
    ├── UnknownGoal           the server does not know the goal, or no longer
    ├── InvalidTransition     an event that a status does not allow: a bug in fibaction
    ├── ProtocolError         the peer sent an invalid message
    │   └── InvalidMessage        this side's message is too large or malformed; it was not sent
    ├── StoreError            goals cannot be kept in the server's store
    └── TransportError        the server could not be reached as asked
        ├── InvalidURL            the URL is malformed, or has settings that cannot be used
        ├── ServerNotFound        the server is not there, or does not serve this action
        ├── ConnectionLost        the connection ended
        │   └── GoalKept              the server has stopped, and keeps the goal in its store
        ├── AuthenticationFailed  the credentials or the permissions do not suffice
        ├── LimitReached          a limit of the server or of the client is reached
        └── ServerFailed          the server has a bug

Data is in attributes (`reason`, `result`, `goal_id`), the text is one sentence on one printable
line, whatever a peer has sent: see `fibaction._runtime.text`. Nothing here knows
goals in progress, transports or tasks. The number of each error on the wire is in
`fibaction.wire.errors`.
"""

from __future__ import annotations

from typing import Any

from fibaction._runtime.text import REASON, excerpt
from fibaction.words.action_error import ActionError as ActionError  # the root of this tree
from fibaction.words.goals import WHY_UNKNOWN, GoalID
from fibaction.words.statuses import GoalStatus, NamedNumber
from fibaction.words.statuses import (
    InvalidTransition as InvalidTransition,  # raised by the table alone
)

FAILURES = (Exception, SystemExit)
"""The errors of a user's function that end what it was called for: a goal, or an answer. A library
that calls `sys.exit` means the program, and does not know that it runs in a server of many."""


class _GoalError(ActionError):
    """An error with a reason, and with the ID of its goal once that is known."""

    what = "failed"

    def __init__(self, reason: str, *, goal_id: GoalID | None = None) -> None:
        super().__init__(reason)
        # `GoalRejected(exc)` is easily written, and only text can be sent.
        self.reason = str(reason)
        self.goal_id = goal_id

    def __str__(self) -> str:
        reason = excerpt(self.reason, REASON)
        if self.goal_id is None:
            return reason or f"the goal {self.what}"
        return f"goal {self.goal_id} {self.what}" + (f": {reason}" if reason else "")


class RejectionCode(NamedNumber):
    """The kind of a rejection, by which clients decide what to do. The reason is text for people.

    docs/concepts.md has the table of them. The numbers are those of the wire.
    """

    REJECTED = 0
    """The server has decided so; also if the transport does not carry the code."""
    BUSY = 1
    """There is no room for the goal. The same goal may be accepted later, or elsewhere."""
    UNREADABLE = 2
    """The goal does not fit the type of the server's action. A server of another version may be
    able to read it."""
    DUPLICATE = 3
    """The ID of the goal is in use by another goal."""
    INVALID = 4
    """The goal cannot be taken at all: its ID is all zeros, or it is too large to be kept."""
    FAILED = 5
    """A function of the server that decides on goals, such as `on_goal`, has failed."""
    STOPPING = 6
    """The server is stopping. The same goal may be accepted later, or elsewhere."""

    @property
    def is_temporary(self) -> bool:
        """True if the same goal may be accepted later, or by another server."""
        return self in (RejectionCode.BUSY, RejectionCode.STOPPING)

    @classmethod
    def _missing_(cls, value: object) -> RejectionCode | None:
        """Take the number of a newer peer as `REJECTED`."""
        return cls.REJECTED if isinstance(value, int) else None


class GoalRejected(_GoalError):
    """The server did not accept the goal; `reason` says why. Nothing was run.

    Raise it in `on_goal` to reject; a client's `send_goal` raises it.

    For example:

        def on_goal(goal: Drive) -> None:
            if battery.is_charging:
                raise GoalRejected("the battery is charging", code=RejectionCode.BUSY)
    """

    what = "was rejected"

    def __init__(
        self,
        reason: str,
        *,
        goal_id: GoalID | None = None,
        code: RejectionCode = RejectionCode.REJECTED,
    ) -> None:
        super().__init__(reason, goal_id=goal_id)
        self.code = RejectionCode(code)
        """The kind of the rejection: it, and never the reason, decides what clients do."""

    @property
    def is_busy(self) -> bool:
        """True if the server had no room for the goal. The same goal may be accepted later."""
        return self.code is RejectionCode.BUSY


class GoalAborted(_GoalError):
    """The server ended the goal by itself; `reason` says why, `result` is what there was, or None.

    Raise it in an executor to abort with a partial result; a client's `result()` raises it.
    """

    what = "was aborted"

    def __init__(self, reason: str, *, result: Any = None, goal_id: GoalID | None = None) -> None:
        super().__init__(reason, goal_id=goal_id)
        self.result = result


class GoalCanceled(_GoalError):
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


class GoalTimeout(_GoalError, TimeoutError):
    """The goal took longer than the client's `timeout`, and the client has asked to cancel it.

    It is Python's `TimeoutError`, too.
    """

    what = "timed out"

    def __init__(
        self,
        reason: str,
        *,
        goal_id: GoalID | None = None,
        status: GoalStatus = GoalStatus.UNKNOWN,
        feedback: Any = None,
        feedback_count: int = 0,
    ) -> None:
        super().__init__(reason, goal_id=goal_id)
        self.status = status
        """The newest status that the client knew then; UNKNOWN before the acceptance."""
        self.feedback = feedback
        """The last feedback that was read; None if none was."""
        self.feedback_count = feedback_count
        """The number of feedback messages that were read."""


class CancelRejected(_GoalError):
    """The server rejects a cancel; raise it in `on_cancel`. The goal continues.

    Clients do not get it: `cancel` returns a `CancelAnswer` with `CancelCode.REJECTED` and the
    reason.
    """

    what = "cannot be canceled"


class UnknownGoal(ActionError):
    """The server does not know the goal: it was never accepted, its result has expired, or the
    server was restarted.
    """

    def __init__(self, goal_id: GoalID) -> None:
        super().__init__(goal_id)
        self.goal_id = goal_id

    def __str__(self) -> str:
        return f"goal {self.goal_id} is unknown: {WHY_UNKNOWN}"


class ProtocolError(ActionError):
    """The peer sent an invalid message: one that it may not send, or that is not of its type.

    Over a connection it means that the peer does not speak this protocol, or another version of
    it. fibaction does not connect again.
    """


class InvalidMessage(ProtocolError):
    """This side's message is too large or malformed; it was not sent.

    For example, a goal is larger than the server's limit.
    """


class StoreError(ActionError):
    """Goals cannot be kept in the server's store: it cannot be opened, or cannot be written to.

    A server whose store fails stops, and raises it. Clients do not get it.
    """


class TransportError(ActionError):
    """The server could not be reached as asked.

    This class itself, and none of its subclasses, means that an address or the types of an action
    cannot be used, or that a package is missing that the transport needs.
    """


class InvalidURL(TransportError):
    """The URL is malformed, its scheme is unknown, or it has settings that cannot be used."""


class ServerNotFound(TransportError):
    """The server is not there, or does not serve this action.

    Also raised when the server did not answer in time, or has stopped.
    """


class ConnectionLost(TransportError):
    """The connection ended while something was waited for; goals may keep running at the server.

    Also raised for a goal that another server has taken over from this one.
    """


class GoalKept(ConnectionLost):
    """This server reports nothing more about the goal; the next server may know it.

    It has stopped and keeps the goal in its store, or its store has failed.
    """


class AuthenticationFailed(TransportError):
    """The server did not accept the client's credentials, or the client those of the server.

    Also raised for a single request that the server does not permit to this client. fibaction does
    not try again by itself.
    """


class LimitReached(TransportError):
    """A limit of the server or of the client is reached.

    For example, the server is full, there are too many requests at once, or an answer is larger
    than the client accepts.
    """


class ServerFailed(TransportError):
    """The server has a bug: an endpoint or a callback raised an error that it may not raise.

    The text names the type of that error. Its traceback is in the server's log.
    """


def text_of(exc: BaseException) -> str:
    """Return an error of foreign code as text, for example `ValueError: too far`, or `TimeoutError`
    for one without a text.

    It is one printable line of limited length. If `str(exc)` itself raises, fall back to the name
    of the class.
    """
    try:
        if isinstance(exc, SystemExit):  # its text alone would be a number, or empty
            code = "" if exc.code is None else repr(exc.code)
            return excerpt(f"sys.exit({code}) was called", REASON)
        text = str(exc)
        return excerpt(f"{type(exc).__name__}: {text}" if text else type(exc).__name__, REASON)
    except FAILURES:
        return type(exc).__name__


def copy_of(error: ActionError) -> ActionError:
    """Return a new error of the same type, with the same data.

    An error that many tasks wait for is raised once for each: a raised one gathers tracebacks.
    """
    copy = type(error).__new__(type(error), *error.args)  # a subclass may have its own constructor
    copy.args = error.args
    vars(copy).update(vars(error))
    return copy
