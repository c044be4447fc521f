"""The stream with which a client follows one goal at a server of ROS.

It is told what has arrived, and keeps it until it is read. It does not use ROS itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from msgspec.structs import replace

from fibaction.border.abc import FeedbackItem, GoalStream, GoalUpdate, Notifier
from fibaction.words.errors import ActionError, copy_of
from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus


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

    Feedback is numbered here, as it arrives: ROS has no numbers. Feedback that is lost on the way
    is noticed at the end, if the server tells how many messages there were. Unread feedback is kept
    up to a limit; then the oldest is dropped.

    The outcome is known as soon as the result has arrived. It ends the feedback, too, unless some
    of it may still arrive: then the feedback ends with `finish`.
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
        self.early_request: int | None = None
        """The number of the one that was sent before the goal was accepted; None if none was."""
        self.resumed = 0
        """The number of those that were sent because the server had been silent."""
        self.servers: frozenset[bytes] = frozenset()
        """The servers at the time when it was accepted: one of them has the goal."""
        self.is_counted = False
        """True if the server tells the number of the goal's feedback messages, all of which were
        published since this stream has followed the goal."""
        self.awaits_server = False
        """True if several servers run the goal, and it is not yet known whose feedback to take."""
        self.awaits_rest = False
        """True if the middleware is finding out whether feedback is missing."""
        self.when_listed: Callable[[], None] = lambda: None
        """Called if the goal is in a status list, and its acceptance has not arrived."""
        self.news = Notifier()
        self.reads = reads
        self._items: deque[tuple[FeedbackItem, bytes]] = deque(maxlen=depth)
        self._publishers: frozenset[bytes] = frozenset()
        self._statuses: deque[GoalStatus] = deque()
        self._status = GoalStatus.UNKNOWN
        self._received = 0
        self._total: int | None = None
        self._delivered = 0
        self._is_finished = False
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
        return self._is_finished or self._error is not None

    @property
    def missing(self) -> int | None:
        """The number of feedback messages that have yet to arrive; None if it is not yet known."""
        if self.reads and (self.awaits_server or self.awaits_rest):
            return None
        if not (self.reads and self.is_counted):
            return 0
        return None if self._total is None else max(0, self._total - self._received)

    # What has arrived

    def begin(self, info: GoalInfo) -> None:
        """Note that the server has accepted the goal, and when."""
        self.stamp = info.stamp
        if self._outcome is None and self._error is None:  # the result may have been faster
            self._status = info.status
        self.news.notify()

    def add_feedback(self, message: bytes, publisher: bytes = b"") -> None:
        """Add a feedback message, which is decoded when it is read; `publisher` is its GID."""
        if not self._is_of_its_server(publisher):
            return
        self._received += 1
        if self.reads and not self.is_over:
            self._items.append((FeedbackItem(self._received, message), publisher))
            self.news.notify()

    def note_lost(self, count: int) -> None:
        """Note that feedback is lost between what has arrived and what is to come. Feedback that
        is lost before is of a goal before.
        """
        if self._received and not self.is_counted:
            self._received += count

    def take_from(self, publishers: frozenset[bytes]) -> None:
        """Take feedback of these publishers only, and drop the unread feedback of others. None
        means all publishers.
        """
        if publishers and publishers != self._publishers:
            self._publishers = publishers
            self.awaits_server = False
            before = self._received - len(self._items)
            kept = [item for item in self._items if self._is_of_its_server(item[1])]
            self._items.clear()
            self._received = before + len(kept)
            for number, (item, publisher) in enumerate(kept, before + 1):
                self._items.append((replace(item, number=number), publisher))

    def _is_of_its_server(self, publisher: bytes) -> bool:
        return not (self._publishers and publisher) or publisher in self._publishers

    def set_total(self, total: int) -> None:
        """Note the number of feedback messages that the server has published in all."""
        if self.is_counted:
            self._total = total

    def set_status(self, status: GoalStatus) -> None:
        """Set the status, unless it is an earlier one: statuses only ever grow."""
        if not self.has_begun:
            self.when_listed()
        elif status > self._status:
            self._status = status
            if self.reads and status.is_active:
                self._statuses.append(status)
                self.news.notify()

    def set_outcome(self, outcome: Outcome[bytes]) -> None:
        """Note the goal's outcome. Its feedback continues until `finish`."""
        if self._outcome is None and self._error is None:
            self._outcome = outcome
            self._status = outcome.status
            self.news.notify()

    def finish(self) -> None:
        """End the stream with the outcome: no more feedback is waited for."""
        if self._outcome is not None:
            self._is_finished = True
            self.news.notify()

    def end(self, outcome: Outcome[bytes]) -> None:
        """End the stream with the goal's outcome."""
        self.set_outcome(outcome)
        self.finish()

    def fail(self, error: ActionError) -> None:
        """End the stream with an error, because the rest will not arrive or cannot be decoded; with
        the outcome, if only feedback is missing.
        """
        self.finish()
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
        if self._outcome is None or (self.reads and not self._is_finished):
            return ()
        if self.reads:
            self.cursor = self._received + (self.missing or 0)
        return (self._outcome,)

    def _next_feedback(self) -> FeedbackItem:
        item, _ = self._items.popleft()
        self.cursor = item.number
        self._delivered += 1
        return replace(item, payload=self.decoder.feedback(item.payload))

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
