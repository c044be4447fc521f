"""The records that a `Monitor` keeps of each action and each goal."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from fibaction.client.events import GoalFeedback
from fibaction.observe.action_listener import AnyClient
from fibaction.types.action import ActionInfo
from fibaction.words.goals import NO_GOAL, GoalInfo
from fibaction.words.statuses import GoalStatus

SPAN = 5.0
"""Seconds over which a rate is measured: a shorter span flickers, a longer one is late."""

_NOT_WAITING = GoalInfo(NO_GOAL, 0, GoalStatus.UNKNOWN)


class Rate:
    """A count of events, and how often they happen."""

    def __init__(self) -> None:
        self.count = 0
        self._samples: deque[tuple[float, int]] = deque()

    def sample(self, now: float) -> None:
        """Record the count at this time."""
        self._samples.append((now, self.count))
        while len(self._samples) > 2 and self._samples[1][0] <= now - SPAN:
            self._samples.popleft()

    @property
    def per_second(self) -> float:
        """The rate over the last `SPAN` seconds; 0 before the second sample."""
        if len(self._samples) < 2:
            return 0.0
        (began, before), (ended, after) = self._samples[0], self._samples[-1]
        return (after - before) / (ended - began) if ended > began else 0.0


class MonitoredAction:
    """The state of one action."""

    def __init__(self, info: ActionInfo) -> None:
        self.info = info
        self.client: AnyClient | None = None
        self.away = ""
        self.rate = Rate()


class MonitoredGoal:
    """The state of one goal."""

    def __init__(self, info: GoalInfo) -> None:
        self.info = info
        self.rate = Rate()
        self.latest: Any = None
        """The summary of the latest feedback; None if none has come."""
        self._number = 0
        self._new: GoalFeedback[Any] | None = None

    def merge(self, info: GoalInfo) -> None:
        """Take what is newer there: answers and events may cross on the way."""
        status = max(self.info.status, info.status)
        waiting = info if info.place else self.info  # events tell no places
        if status is not GoalStatus.ACCEPTED:
            waiting = _NOT_WAITING
        attempt = max(self.info.attempt, info.attempt)
        counts = (one.feedback_count for one in (self.info, info) if one.attempt == attempt)
        self.info = msgspec.structs.replace(
            info,
            status=status,
            attempt=attempt,
            feedback_count=max(counts),
            client=info.client or self.info.client,
            parent=info.parent or self.info.parent,
            labels=info.labels or self.info.labels,
            worker=info.worker or self.info.worker,
            place=waiting.place,
            queue_length=waiting.queue_length,
            began_at=info.began_at or self.info.began_at,
            ended_at=info.ended_at or self.info.ended_at,
            reason=info.reason or ("" if status.is_active else self.info.reason),
        )

    def add_feedback(self, event: GoalFeedback[Any]) -> int:
        """Take feedback. Return how many messages there were since the one before."""
        # If the first one seen here is not number 1, its number says nothing about the rate. The
        # numbers begin again with each attempt.
        more = event.number - self._number if 0 < self._number < event.number else 1
        self._number, self._new = event.number, event
        self.rate.count += more
        count, attempt = event.number, event.attempt
        self.merge(msgspec.structs.replace(self.info, feedback_count=count, attempt=attempt))
        return more

    def summarize(self, summarize: Callable[[Any], Any] | None) -> None:
        """Make the summary of the latest feedback; with None, forget the feedback.

        It may be large, and a server may have many goals.
        """
        if self._new is not None:
            if summarize is not None:
                self.latest = summarize(self._new.feedback)
            self._new = None
