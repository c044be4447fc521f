"""The deadlines of goals on the wire, which carries the seconds that are left.

A deadline is a time by `anyio.current_time()`, and the clocks of two processes differ.
"""

from __future__ import annotations

from anyio import current_time

from fibaction.wire.messages import LONGEST_TIMEOUT

LEAST_TIMEOUT = 0.001
"""Seconds that are sent for a deadline that has passed, since 0 is not a timeout."""


def timeout_until(deadline: float) -> float | None:
    """Return the timeout to send for a deadline: the seconds that are left; None if too many."""
    left = deadline - current_time()
    return max(left, LEAST_TIMEOUT) if left <= LONGEST_TIMEOUT else None


def deadline_after(timeout: float) -> float:
    """Return the deadline of a goal that arrives now with this timeout."""
    return current_time() + timeout
