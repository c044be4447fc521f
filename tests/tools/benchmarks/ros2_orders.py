"""The orders of goals in the benchmarks with ROS 2, which say what executors do."""

from __future__ import annotations

PENDING = -1
"""The order of a goal that ends when it is canceled."""
LONG = 10_000
"""The least order of a goal that sends the difference as equal messages, as fast as possible."""

LARGE = 1_000_000
"""The bytes of a large feedback message."""
LARGE_PAUSE = 1 / 30
"""Seconds between large feedback messages."""
LARGE_TYPE = "fibaction_test_msgs/action/Echo"
"""The type of the action with large feedback, whose goal is the number of messages as text."""
