"""The clock of a node without ROS: the machine's, or that of a simulation, which tells its time on
the topic `/clock`.
"""

from __future__ import annotations

import struct
import time
from typing import Final

from fibaction_transports.ros2.node.ros_node import RosClock

CLOCK_TOPIC: Final = "/clock"
_BILLION = 10**9
_TIME = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}
_START = 4


class OwnClock(RosClock):
    """The clock of a node."""

    def __init__(self) -> None:
        self.era = 0
        self._is_simulated = False
        self._now = 0

    @property
    def is_the_machines(self) -> bool:
        return self.era == 0 and not self._is_simulated

    def now(self) -> int:
        return self._now if self._is_simulated else time.time_ns()

    def use_simulated(self, wanted: bool) -> None:
        """Use the time of a simulation, or that of the machine."""
        if wanted != self._is_simulated:
            self._is_simulated = wanted
            self.era += 1

    def take(self, message: bytes, publisher: bytes) -> None:
        """Take a `rosgraph_msgs/msg/Clock`; it is ignored if it is not one."""
        form = _TIME.get(message[1]) if len(message) >= _START + 8 else None
        if form is None:
            return
        seconds, nanoseconds = form.unpack_from(message, _START)
        now = seconds * _BILLION + nanoseconds
        if now < self._now:
            self.era += 1
        self._now = now
