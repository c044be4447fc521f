"""The clock of a node: the machine's, or that of a simulation (`use_sim_time`)."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from fibaction_transports.ros2.node.ros_node import RosClock
from fibaction_transports.ros2.on_rclpy.rcl import Duration, InvalidHandle, JumpThreshold


class NodeClock(RosClock):
    """The clock of a node, and the number of times that it has begun again."""

    def __init__(self, node: Any) -> None:
        self._clock = node.get_clock()
        self.era = 0
        self._jumps = self._clock.create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
            ),
            post_callback=self._begin_anew,
        )

    def _begin_anew(self, jump: Any) -> None:
        # In the thread that rclpy spins. No other thread writes it.
        self.era += 1

    @property
    def is_the_machines(self) -> bool:
        return self.era == 0 and not self._clock.ros_time_is_active

    def now(self) -> int:
        nanoseconds: int = self._clock.now().nanoseconds
        return nanoseconds

    def close(self) -> None:
        """Note no more jumps."""
        with suppress(InvalidHandle):  # the user has destroyed the node
            self._jumps.unregister()
