"""`GoalStatistics`: how many goals an action has, how they end, and how long they wait and run.

Theory of operation
-------------------

Goals are added one by one, in any order, and the memory does not depend on their number. Durations
are counted in classes, each 2 % wider than the one before; a percentile is the middle of its
class, so it is off by 1 % at most. Reasons are counted up to `MOST_REASONS` different ones, and
the goals with other ones together.

Two spans of time are counted, both of which end now: a long one, and the last `RECENT` seconds of
it. An end counts in a span if the goal ended in it, and an acceptance if it was accepted in it.

`statistics_of` reads the goals that the server remembers, and those that it has in the history of
its store, of whichever kind that is.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections import Counter
from itertools import accumulate

import msgspec

from fibaction.border.endpoints import Endpoint
from fibaction.border.event_loop import Slices
from fibaction.feeds.answers import statuses_soon
from fibaction.words.goal_query import GoalQuery, Place
from fibaction.words.goals import GoalInfo
from fibaction.words.statuses import GoalStatus

RECENT = 600
"""Seconds of the shorter span: ten minutes."""
MOST_REASONS = 1000
"""Different reasons that are counted."""
MOST_TOLD = 20
"""Different reasons that are told, the most frequent ones."""
OTHER_REASONS = "other reasons"
"""The text for all goals whose reason is not among those."""
NO_REASON = "no reason was given"
"""The text for goals that were aborted without a reason."""

_GROWTH = 1.02
_WIDTH = math.log(_GROWTH)
_SHORTEST = 1e-6


class Percentiles(msgspec.Struct, frozen=True):
    """Seconds that goals took: the half of them, and 95 of 100, took at most so long."""

    count: int
    p50: float
    p95: float
    most: float


class FailedGoals(msgspec.Struct, frozen=True):
    """Goals that were aborted for the same reason."""

    reason: str
    goals: int
    """The number of them."""


class SpanStatistics(msgspec.Struct, frozen=True):
    """The goals of an action in a span of time."""

    seconds: float
    """The length of the span, which ends now."""
    accepted: int
    """The number of goals that were accepted in it."""
    per_minute: float
    """The same, for each minute."""
    ended: dict[str, int]
    """The number of goals that ended in it, by the names of all statuses of an end."""
    failures: tuple[FailedGoals, ...]
    """Those that were aborted, by their reasons, the most frequent first; the last one may be all
    others."""
    waited: Percentiles | None
    """Seconds for which those that ended had waited for their begin; None if known of none."""
    ran: Percentiles | None
    """Seconds for which they ran; None if known of none."""


class ActionStatistics(msgspec.Struct, frozen=True):
    """The goals of an action: now, in the last ten minutes, and in a longer span."""

    waiting: int
    """The number of goals that have not begun."""
    running: int
    """The number of goals that have begun, and not ended."""
    past: int
    """The number of goals that were read from the history of the server's store; 0 if it keeps
    none."""
    recent: SpanStatistics
    whole: SpanStatistics


class Durations:
    """Durations in classes."""

    def __init__(self) -> None:
        self._classes: Counter[int] = Counter()
        self._count = 0
        self._most = 0.0

    def add(self, seconds: float | None) -> None:
        """Count a duration; None for one that is not known."""
        if seconds is not None:
            self._classes[math.ceil(math.log(max(seconds, _SHORTEST)) / _WIDTH)] += 1
            self._count += 1
            self._most = max(self._most, seconds)

    def told(self) -> Percentiles | None:
        """Return the percentiles; None without durations."""
        if not self._count:
            return None
        return Percentiles(self._count, self._share(0.5), self._share(0.95), self._most)

    def _share(self, share: float) -> float:
        classes = sorted(self._classes)
        counts = list(accumulate(self._classes[one] for one in classes))
        found = classes[bisect_left(counts, math.ceil(share * self._count))]
        middle = 2 * _GROWTH**found / (1 + _GROWTH)
        return min(middle, self._most) if middle > _SHORTEST else 0.0


class _Span:
    """The counters of one span."""

    def __init__(self, now: int, seconds: float) -> None:
        self.seconds = seconds
        self.begin = now - int(seconds * 1e9)
        self.accepted = 0
        self.ended: Counter[GoalStatus] = Counter()
        self.reasons: Counter[str] = Counter()
        self.waited, self.ran = Durations(), Durations()

    def add(self, info: GoalInfo) -> None:
        self.accepted += info.stamp >= self.begin
        # A goal whose end has no time, as of ROS, has ended a moment ago: it is still remembered.
        if not info.status.is_terminal or (info.ended_at or self.begin) < self.begin:
            return
        self.ended[info.status] += 1
        self.waited.add(info.waited)
        self.ran.add(info.ran)
        if info.status is GoalStatus.ABORTED:
            reason = info.reason or NO_REASON
            is_counted = reason in self.reasons or len(self.reasons) < MOST_REASONS
            self.reasons[reason if is_counted else OTHER_REASONS] += 1

    def told(self) -> SpanStatistics:
        known = Counter({one: n for one, n in self.reasons.items() if one != OTHER_REASONS})
        told = [FailedGoals(*one) for one in known.most_common(MOST_TOLD)]
        if others := self.reasons.total() - sum(one.goals for one in told):
            told.append(FailedGoals(OTHER_REASONS, others))
        ends = (status for status in GoalStatus if status.is_terminal)
        return SpanStatistics(
            self.seconds,
            self.accepted,
            self.accepted * 60 / self.seconds,
            {status.name: self.ended[status] for status in ends},
            tuple(told),
            self.waited.told(),
            self.ran.told(),
        )


class GoalStatistics:
    """The counters of one action."""

    def __init__(self, now: int, since: int) -> None:
        """Count the goals from `since` until `now`, both in nanoseconds since 1970."""
        seconds = max((now - since) / 1e9, 1.0)
        self.earliest = now - int(2 * seconds * 1e9)
        """The earliest time of acceptance of goals that are to be added: one that took longer than
        the whole span is left out."""
        self._spans = _Span(now, min(RECENT, seconds)), _Span(now, seconds)
        self._waiting = self._running = self._past = 0

    def add(self, info: GoalInfo, *, is_past: bool = False) -> None:
        """Count a goal, which is one of the history if `is_past`."""
        self._past += is_past
        self._waiting += info.status is GoalStatus.ACCEPTED
        self._running += info.status in (GoalStatus.EXECUTING, GoalStatus.CANCELING)
        for span in self._spans:
            span.add(info)

    def told(self) -> ActionStatistics:
        """Return the numbers."""
        recent, whole = (span.told() for span in self._spans)
        return ActionStatistics(self._waiting, self._running, self._past, recent, whole)


async def statistics_of(endpoint: Endpoint, since: int) -> ActionStatistics:
    """Return the statistics of an action from a time on, in nanoseconds since 1970.

    The goals are read in parts, so that memory and the turns of others do not depend on their
    number.

    Raises:
        ActionError: As for `Endpoint.status` and `Endpoint.past_goals`.
    """
    statistics = GoalStatistics(time.time_ns(), since)
    slices = Slices()
    with await statuses_soon(endpoint) as statuses:
        remembered = await statuses.listed()
    known: set[Place] = set()
    for info in remembered:
        known.add((info.stamp, info.goal_id))
        statistics.add(info)
        await slices.pause()

    def take(infos: list[GoalInfo]) -> None:
        for info in infos:
            if (info.stamp, info.goal_id) not in known:
                statistics.add(info, is_past=True)

    # Afterwards, so that a goal which is forgotten meanwhile is in one of them.
    await endpoint.read_past(GoalQuery(since=statistics.earliest), take)
    return statistics.told()
