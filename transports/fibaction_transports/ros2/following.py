"""What a client follows of one goal.

It is told what has arrived, and keeps it until it is read. It knows nothing of ROS.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Any

from fibaction._notify import Notifier
from fibaction.abc import FeedbackItem, GoalStream, GoalUpdate
from fibaction.exceptions import ActionError, copy_of
from fibaction.goals import GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus


class Reading(ABC):
    """How to read what arrives."""

    @abstractmethod
    def feedback(self, message: bytes) -> bytes:
        """The payload of a feedback message.

        Raises:
            ProtocolError: It is none.
        """

    @abstractmethod
    def outcome(self, response: Any) -> Outcome[bytes]:
        """What the answer to a request for a result says.

        Raises:
            ProtocolError: It is no end of a goal.
        """


class RosGoal(GoalStream):
    """One goal at a server of ROS.

    Its feedback is numbered here, as it arrives: ROS has no numbers, so what is lost on the way is
    not noticed. What is unread is kept, up to a limit; then the oldest gives way.
    """

    def __init__(self, goal_id: GoalID, reading: Reading, depth: int, *, reads: bool) -> None:
        self.goal_id = goal_id
        self.stamp = 0
        self.latest = False
        self.cursor = 0
        self.reading = reading
        self.asked: list[int] = []
        """The numbers of the requests for its result."""
        self.servers: frozenset[bytes] = frozenset()
        """Who served when it was accepted: one of them has the goal."""
        self.news = Notifier()
        self.reads = reads
        self._items: deque[FeedbackItem] = deque(maxlen=depth)
        self._statuses: deque[GoalStatus] = deque()
        self._status = GoalStatus.UNKNOWN
        self._received = 0
        self._delivered = 0
        self._outcome: Outcome[bytes] | None = None
        self._error: ActionError | None = None

    @property
    def status(self) -> GoalStatus:
        return self._status

    @property
    def dropped(self) -> int:
        return self.cursor - self._delivered

    @property
    def has_begun(self) -> bool:
        """Whether it is known that the server has accepted the goal."""
        return self._status is not GoalStatus.UNKNOWN

    @property
    def is_over(self) -> bool:
        """Whether nothing more is to come."""
        return self._outcome is not None or self._error is not None

    # What arrives

    def begin(self, info: GoalInfo) -> None:
        """The server has accepted the goal; this is what is known of it."""
        self.stamp, self._status = info.stamp, info.status
        self.news.notify()

    def arrive(self, message: bytes) -> None:
        """Feedback has arrived."""
        self._received += 1
        if self.reads and not self.is_over:
            self._items.append(FeedbackItem(self._received, message))
            self.news.notify()

    def tell(self, status: GoalStatus) -> None:
        """The goal has another status."""
        if self.has_begun and status > self._status:  # statuses only ever grow
            self._status = status
            if self.reads and status.is_active:
                self._statuses.append(status)
                self.news.notify()

    def end(self, outcome: Outcome[bytes]) -> None:
        """The goal has ended."""
        if not self.is_over:
            self._outcome = outcome
            self._status = outcome.status
            self.news.notify()

    def fail(self, error: ActionError) -> None:
        """Nothing more will arrive, or nothing that could be read."""
        if not self.is_over:
            self._error = error
            self.news.notify()

    # What is read

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if self._statuses:
            return (self._statuses.popleft(),)
        if self._items:
            return [self._read() for _ in range(min(limit, len(self._items)))]
        self._raise_error()
        if self._outcome is None:
            return ()
        if self.reads:
            self.cursor = self._received
        return (self._outcome,)

    def _read(self) -> FeedbackItem:
        item = self._items.popleft()
        self.cursor = item.number
        self._delivered += 1
        return FeedbackItem(item.number, self.reading.feedback(item.payload))

    def known_outcome(self) -> Outcome[bytes] | None:
        self._raise_error()
        return self._outcome

    def hold(self, wanted: bool) -> None:
        """It has no effect: in ROS, nobody can make a server wait."""

    def close(self) -> None:
        self.reads = False
        self._items.clear()
        self._statuses.clear()
        self.news.notify()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise copy_of(self._error)
