"""The error table: every error that may cross the wire, and its number, in both directions.

An endpoint's error is told to the client as one message, and the client raises the same error with
the same text:

- `GoalRejected` is the message `Rejected`, as an answer to `SendGoal` and `Follow`.
- Every other error in `NUMBERS` is `Failed` with its number. A subclass that is not in the table
  has the number of its nearest base.
- An error that is not in the table, such as a `ValueError` of an endpoint, is a bug of the server:
  it arrives as `ServerFailed`, with the error's type and without its text, which may be secret.
- What ends a connection is `Goodbye` with the same numbers; 0 says that nothing is wrong.

So a gateway, which raises again what it has received, changes no error. A number that this version
does not know counts as `ConnectionLost`. docs/protocol.md has the same table.
"""

from __future__ import annotations

from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import REASON, excerpt, shortened
from fibaction._runtime.text import sendable as sendable  # for transports, too
from fibaction.wire.messages import Failed, Goodbye, Rejected, Why, encode
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalRejected,
    InvalidMessage,
    InvalidURL,
    LimitReached,
    ProtocolError,
    RejectionCode,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goals import GoalID

logger = clean_logger("fibaction.wire")

NUMBERS: dict[type[ActionError], int] = {
    UnknownGoal: Why.UNKNOWN_GOAL,
    ServerNotFound: Why.SERVER_NOT_FOUND,
    ConnectionLost: Why.CONNECTION_LOST,
    AuthenticationFailed: Why.FORBIDDEN,
    LimitReached: Why.LIMIT,
    ProtocolError: Why.PROTOCOL,
    TransportError: Why.TRANSPORT,
    ServerFailed: Why.SERVER_FAILED,
    InvalidMessage: Why.INVALID_MESSAGE,
    InvalidURL: Why.INVALID_URL,
}
"""The number of each error; `GoalRejected` has a message of its own."""

_ERRORS = {number: error for error, number in NUMBERS.items()}


def number_of(error: ActionError) -> int:
    """Return the number of an error: that of its class, or of the nearest base in the table."""
    bases = (NUMBERS[kind] for kind in type(error).__mro__ if kind in NUMBERS)
    return next(bases, Why.SERVER_FAILED)


def error_of(message: Failed | Rejected, goal_id: GoalID | None = None) -> ActionError:
    """Return the error that a server has answered with; `goal_id` is the goal of the request."""
    if isinstance(message, Rejected):
        code = RejectionCode(message.code)
        return GoalRejected(shortened(message.reason), goal_id=goal_id, code=code)
    return _error(message.why, message.text, goal_id)


def failed(request: int, error: ActionError, limit: int) -> bytes:
    """Return the frame that answers a request with an error, of at most `limit` bytes."""
    text = sendable(error.reason if isinstance(error, GoalRejected) else str(error))
    frame = encode(_answer(request, error, text))
    if len(frame) > limit:
        room = max(0, len(text.encode()) - (len(frame) - limit))
        frame = encode(_answer(request, error, text.encode()[:room].decode(errors="ignore")))
    return frame


def _answer(request: int, error: ActionError, text: str) -> Rejected | Failed:
    if isinstance(error, GoalRejected):
        return Rejected(request, text, error.code)
    return Failed(request, number_of(error), text)


def fitting(request: int, frame: bytes, limit: int) -> bytes:
    """Return the frame, or, if it is larger than the client's limit, one that says so."""
    if len(frame) <= limit:
        return frame
    text = (
        f"the answer has {len(frame)} bytes, and the client accepts {limit}:"
        " connect(..., limits=Limits(frame=...)) sets its limit"
    )
    logger.warning("an answer is not sent: %s", text)
    return encode(Failed(request, Why.LIMIT, text))


def error_of_goodbye(message: Goodbye, where: str) -> ActionError:
    """Return the error that ends the connection to the peer at `where`, which said goodbye."""
    return _error(message.why, f"{where}: {excerpt(message.reason)}", None)


def goodbye_of(error: ActionError) -> Goodbye:
    """Return the last message to a peer whose connection ends with an error."""
    text = str(error)
    if not isinstance(error, AuthenticationFailed):
        text = f"the server has closed the connection: {text}"
    return Goodbye(sendable(text), number_of(error))


def failure_of(exc: BaseException) -> ServerFailed:
    """Return the error that a client is told of a bug of its server."""
    return ServerFailed(f"the server failed: {type(exc).__name__}")


def _error(number: int, text: str, goal_id: GoalID | None) -> ActionError:
    text = excerpt(text, REASON)  # the peer may have sent anything
    if number == Why.UNKNOWN_GOAL:
        # Without a goal, an endpoint has raised it where it may not.
        return ServerFailed(text) if goal_id is None else UnknownGoal(goal_id)
    return _ERRORS.get(number, ConnectionLost)(text)
