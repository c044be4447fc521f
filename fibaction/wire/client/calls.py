"""Calls of a client: a request with one answer, and what goals and statuses have in common.

A `Call` knows which message opens it, on the first connection and on each after that, and takes the
messages of its ID. It does not know connections: what it has to say in between goes to `post`.
`remote_goal` and `remote_statuses` are the two other kinds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction._runtime.notify import Notifier
from fibaction.wire.errors import error_of
from fibaction.wire.messages import Close, Credit, Failed, FromClient
from fibaction.words.errors import ActionError, ProtocolError, copy_of
from fibaction.words.goals import GoalID

Post: TypeAlias = Callable[[FromClient], None]
"""Sends a small message if there is a connection; without one it is not needed."""


class Call(ABC):
    """A request that is open, from its first message to its last."""

    def __init__(self, call_id: int) -> None:
        self.id = call_id
        """The same on every connection."""
        self.news = Notifier()
        self.error: ActionError | None = None
        self.is_answered = False
        """True if the server has answered."""
        self.is_over = False
        """True if its answers are not wanted any more, so that it need not be opened again."""

    @abstractmethod
    def opening(self) -> FromClient:
        """Return the message that opens the call on a new connection."""

    def giving_up(self) -> FromClient:
        """Return the message that gives the call up."""
        return Close(self.id)

    @abstractmethod
    def on_message(self, message: Any) -> bool:
        """Take a message of its ID; return whether it was the last.

        Raises:
            ProtocolError: The message does not answer this call.
        """

    async def answered(self) -> None:
        """Wait until the server has answered.

        Raises:
            ActionError: The server has answered with an error, or the connection is lost.
        """
        while not self.is_answered:
            if self.error is not None:
                raise copy_of(self.error)
            await self.news.wait()

    def fail(self, error: ActionError) -> None:
        """End the call with an error."""
        self.error = error
        self.news.notify()

    def lose(self, error: ActionError) -> None:
        """Take an error of the connection or of the server; most calls end with it."""
        self.fail(error)

    def raise_error(self) -> None:
        """Raise a copy of the error that the call has ended with, if it has."""
        if self.error is not None:
            raise copy_of(self.error)


class PendingRequest(Call):
    """A request with one answer."""

    def __init__(self, call_id: int, message: FromClient) -> None:
        super().__init__(call_id)
        self._message = message
        self._answer: Any = None

    def opening(self) -> FromClient:
        return self._message

    def on_message(self, message: Any) -> bool:
        if isinstance(message, Failed):
            goal_id = getattr(self._message, "goal_id", None)
            self.fail(error_of(message, GoalID(goal_id) if goal_id else None))
        else:
            self._answer = message
            self.is_answered = True
            self.news.notify()
        return True

    def answer(self, kind: type[Any]) -> Any:
        """Return the answer that has arrived.

        Raises:
            ProtocolError: It is not of that kind.
        """
        if not isinstance(self._answer, kind):
            raise unfitting(self._answer)
        return self._answer


class Credits:
    """The number of messages that the server may still send for one call."""

    __slots__ = ("_allowed", "_id", "_piece", "_ungranted", "_window", "post")

    def __init__(self, call_id: int, window: int, post: Post) -> None:
        self._id = call_id
        self._window = window
        # In larger pieces: a credit message for each message would cost more than the message.
        self._piece = (window + 1) // 2
        self.post = post
        self._allowed = window
        self._ungranted = 0

    def restart(self, unread: int) -> int:
        """Begin again on a new connection; return the credit, given so many unread messages."""
        self._ungranted = 0
        self._allowed = self._window - unread
        return self._allowed

    def spend(self, count: int = 1) -> None:
        """Count messages that have arrived.

        Raises:
            ProtocolError: There was not enough credit for them.
        """
        if self._allowed < count:
            raise ProtocolError("there were more messages than credit for them")
        self._allowed -= count

    def grant(self, count: int = 1) -> None:
        """Count messages that were read: as many more may come."""
        self._ungranted += count
        if self._ungranted >= self._piece:
            self._allowed += self._ungranted
            self.post(Credit(self._id, self._ungranted))
            self._ungranted = 0


def unfitting(message: object) -> ProtocolError:
    """Return the error for a message that does not answer its call."""
    return ProtocolError(f"a {type(message).__name__} does not answer what was asked")
