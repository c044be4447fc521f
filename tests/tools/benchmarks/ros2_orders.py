"""The parts that the programs of the benchmarks with ROS 2 share: the orders of goals, which say
what executors do, and the look at their own memory.
"""

from __future__ import annotations

from pathlib import Path

LONG = 10_000
"""The least order of a goal that sends the difference as equal messages, as fast as possible."""

LARGE = 1_000_000
"""The bytes of a large feedback message."""
LARGE_PAUSE = 1 / 30
"""Seconds between large feedback messages."""
LARGE_TYPE = "fibaction_test_msgs/action/Echo"
"""The type of the action with large feedback, whose goal is the number of messages as text."""


def most_memory() -> int:
    """Return the largest memory of this program until now, in bytes.

    The usage that `wait4` returns is at least that of the program that started it.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
