"""Stamps of goals, translated between the machine's clock and the clock of the node.

In ROS, a stamp is a time of the node's clock, which may be the clock of a simulation: it may run at
any speed, stand still, or jump back. The rest of fibaction has stamps of the machine's clock. So
each goal has a pair of stamps here, which are taken together when the goal is first seen. If the
node has the machine's clock, nothing is translated.

A clock that jumps back begins a new era. The goals of earlier eras count as accepted before every
time of the era that is now.
"""

from __future__ import annotations

import time
from typing import NamedTuple

from fibaction.words.goals import GoalID
from fibaction_transports.ros2.node.ros_node import RosClock

FIRST_STAMP, LAST_STAMP = -(2**31) * 10**9, 2**31 * 10**9 - 1
"""The first and the last stamp that a message of ROS can hold."""
MOST = 10_000
"""Goals whose stamps a client remembers; then the oldest are forgotten."""


class _Pair(NamedTuple):
    stamp: int
    """The stamp in fibaction."""
    era: int
    ros: int


class ServedStamps:
    """The stamps of the goals of a server."""

    def __init__(self, clock: RosClock) -> None:
        self._clock = clock
        self._pairs: dict[GoalID, _Pair] = {}

    def to_ros(self, goal_id: GoalID, stamp: int) -> int:
        """Return the stamp of a goal for ROS: when it was first asked for."""
        pair = self._pairs.get(goal_id)
        if pair is None:
            clock = self._clock
            ros = stamp if clock.is_the_machines else clock.now()
            pair = self._pairs[goal_id] = _Pair(stamp, clock.era, ros)
        return pair.ros

    def forget(self, goal_id: GoalID) -> None:
        """Forget a goal."""
        self._pairs.pop(goal_id, None)

    def clear(self) -> None:
        """Forget all goals."""
        self._pairs.clear()

    def from_ros(self, ros: int) -> int:
        """Return a stamp for a cancel: that of the last goal that was accepted at or before a time
        of ROS.
        """
        clock = self._clock
        if clock.is_the_machines:
            return ros
        if ros >= clock.now():
            return LAST_STAMP
        before = (
            pair.stamp for pair in self._pairs.values() if pair.era < clock.era or pair.ros <= ros
        )
        return max(before, default=FIRST_STAMP)


class FollowedStamps:
    """The stamps of the goals that a client has been told."""

    def __init__(self, clock: RosClock) -> None:
        self._clock = clock
        self._pairs: dict[bytes, _Pair] = {}

    def from_ros(self, goal_id: bytes, ros: int) -> int:
        """Return the stamp of a goal: as long ago by the machine's clock as it was by the node's
        when the goal was first seen.
        """
        clock = self._clock
        if clock.is_the_machines:
            return ros
        pair = self._pairs.get(goal_id)
        if pair is None or pair.ros != ros:
            stamp = time.time_ns() - (clock.now() - ros)
            pair = self._pairs[goal_id] = _Pair(stamp, clock.era, ros)
            if len(self._pairs) > MOST:
                del self._pairs[next(iter(self._pairs))]
        return pair.stamp

    def stamp_in_ros(self, goal_id: bytes, stamp: int) -> int:
        """Return the stamp that `from_ros` was last given for a goal; `stamp` is what it returned.
        It is exact, and `to_ros` is not.
        """
        pair = self._pairs.get(goal_id)
        return self.to_ros(stamp) if pair is None else pair.ros

    def to_ros(self, stamp: int) -> int:
        """Return the time of ROS for a cancel of the goals up to a stamp. It is that of the last
        such goal, or a later one that is before the next goal.
        """
        clock = self._clock
        if clock.is_the_machines:
            return stamp
        about = clock.now() - (time.time_ns() - stamp)
        pairs = [pair for pair in self._pairs.values() if pair.era == clock.era]
        next_one = min((pair.ros for pair in pairs if pair.stamp > stamp), default=LAST_STAMP)
        last = max((pair.ros for pair in pairs if pair.stamp <= stamp), default=FIRST_STAMP)
        return max(min(about, next_one - 1), last)
