"""What goals ask for in the benchmarks with ROS 2, by their order."""

from __future__ import annotations

PENDING = -1
"""Ends when it is canceled."""
LONG = 10_000
"""Above this: so many feedback messages, all the same, as quickly as can be."""
