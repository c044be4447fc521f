"""The stream with which a client follows one goal at a server of ROS.

It is told what has arrived, and keeps it until it is read. It does not use ROS itself.
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


class GoalDecoder(ABC):
    """Decodes what a goal's server sends."""

    @abstractmethod
    def feedback(self, message: bytes) -> bytes:
        """Return the payload of a feedback message.

        Raises:
            ProtocolError: The message cannot be decoded.
        """

    @abstractmethod
    def outcome(self, response: Any) -> Outcome[bytes]:
        """Return the outcome in the answer to a request for a result.

        Raises:
            ProtocolError: The answer is not the end of a goal.
        """


class RosGoalStream(GoalStream):
    """One goal at a server of ROS.

    Feedback is numbered here, as it arrives: ROS has no numbers, so feedback that is lost on the
    way is not noticed. Unread feedback is kept up to a limit; then the oldest is dropped.
    """

    def __init__(self, goal_id: GoalID, decoder: GoalDecoder, depth: int, *, reads: bool) -> None:
        self.goal_id = goal_id
        self.stamp = 0
        self.ros_stamp = 0
        """The stamp as it was in the acceptance; 0 if another client has sent the goal."""
        self.latest = False
        self.cursor = 0
        self.decoder = decoder
        self.requests: list[int] = []
        """The numbers of the requests for its result."""
        self.resumed = 0
        """The number of those that were sent because the server had been silent."""
        self.servers: frozenset[bytes] = frozenset()
        """The servers at the time when it was accepted: one of them has the goal."""
        self.news = Notifier()
        self.reads = reads
        self._items: deque[tuple[FeedbackItem, bytes]] = deque(maxlen=depth)
        self._publishers: frozenset[bytes] = frozenset()
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
        """True if the server is known to have accepted the goal."""
        return self._status is not GoalStatus.UNKNOWN

    @property
    def is_over(self) -> bool:
        """True if nothing more will arrive."""
        return self._outcome is not None or self._error is not None

    # What has arrived

    def begin(self, info: GoalInfo) -> None:
        """Note that the server has accepted the goal, and when."""
        self.stamp, self._status = info.stamp, info.status
        self.news.notify()

    def add_feedback(self, message: bytes, publisher: bytes = b"") -> None:
        """Add a feedback message, which is decoded when it is read; `publisher` is its GID."""
        if not self._is_of_its_server(publisher):
            return
        self._received += 1
        if self.reads and not self.is_over:
            self._items.append((FeedbackItem(self._received, message), publisher))
            self.news.notify()

    def take_from(self, publishers: frozenset[bytes]) -> None:
        """Take feedback of these publishers only, and drop the unread feedback of others. None
        means all publishers.
        """
        if publishers and publishers != self._publishers:
            self._publishers = publishers
            before = self._received - len(self._items)
            kept = [item for item in self._items if self._is_of_its_server(item[1])]
            self._items.clear()
            self._received = before + len(kept)
            for number, (item, publisher) in enumerate(kept, before + 1):
                self._items.append((FeedbackItem(number, item.payload), publisher))

    def _is_of_its_server(self, publisher: bytes) -> bool:
        return not (self._publishers and publisher) or publisher in self._publishers

    def set_status(self, status: GoalStatus) -> None:
        """Set the status, unless it is an earlier one: statuses only ever grow."""
        if self.has_begun and status > self._status:
            self._status = status
            if self.reads and status.is_active:
                self._statuses.append(status)
                self.news.notify()

    def end(self, outcome: Outcome[bytes]) -> None:
        """End the stream with the goal's outcome."""
        if not self.is_over:
            self._outcome = outcome
            self._status = outcome.status
            self.news.notify()

    def fail(self, error: ActionError) -> None:
        """End the stream with an error, because the rest will not arrive or cannot be decoded."""
        if not self.is_over:
            self._error = error
            self.news.notify()

    # What is read

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if self._statuses:
            return (self._statuses.popleft(),)
        if self._items:
            return [self._next_feedback() for _ in range(min(limit, len(self._items)))]
        self._raise_error()
        if self._outcome is None:
            return ()
        if self.reads:
            self.cursor = self._received
        return (self._outcome,)

    def _next_feedback(self) -> FeedbackItem:
        item, _ = self._items.popleft()
        self.cursor = item.number
        self._delivered += 1
        return FeedbackItem(item.number, self.decoder.feedback(item.payload))

    def known_outcome(self) -> Outcome[bytes] | None:
        self._raise_error()
        return self._outcome

    def hold(self, wanted: bool) -> None:
        """Do nothing: in ROS, a client cannot make a server wait."""

    def close(self) -> None:
        self.reads = False
        self._items.clear()
        self._statuses.clear()
        self.news.notify()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise copy_of(self._error)
