"""`Schedule`: the rules by which a server runs its accepted goals."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any, Literal

import msgspec


class Schedule(msgspec.Struct, frozen=True, kw_only=True):
    """The rules by which a server runs its accepted goals. Without one, all run at once."""

    concurrency: int | None = None
    """Executors that run at the same time, for each key; None for any number."""
    queue: int = 0
    """Accepted goals that may wait for a place, for each key."""
    when_full: Literal["reject", "preempt", "replace"] = "reject"
    """The goal that gives way when no place and no place in the queue is free: the new one, the one
    that has run longest, or the newest that waits."""
    key: Callable[[Any], Hashable] | None = None
    """A function that returns the key of a goal, for example its joint group; None for one key."""
    total: int | None = None
    """Executors that run at the same time, for all keys together; None for any number."""
    priority: Callable[[Any], float] | None = None
    """A function that returns the urgency of a goal: smaller numbers are first; None for equal."""
    queue_timeout: float = math.inf
    """Seconds that a goal may wait; then it ends as ABORTED."""
    run_timeout: float = math.inf
    """Seconds that an executor may run; then it is interrupted, and its goal ends as ABORTED."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: A function is not callable, or a number is not a number.
            ValueError: A number is out of range, `when_full` is another word, or a queue can never
                be used.
        """
        for name in ("concurrency", "total"):
            limit = getattr(self, name)
            if limit is not None and limit < 1:
                raise ValueError(f"{name} is 1 or more, or None for any number, not {limit}")
        if self.queue < 0:
            raise ValueError(f"queue is 0 or more, not {self.queue}")
        if self.concurrency is None and self.total is None and self.queue:
            raise ValueError("a queue needs a limit of what runs: give concurrency or total")
        if self.when_full not in ("reject", "preempt", "replace"):
            raise ValueError(
                f"when_full is 'reject', 'preempt' or 'replace', not {self.when_full!r}"
            )
        if self.when_full == "replace" and not self.queue:
            raise ValueError("when_full='replace' needs a queue of at least 1, not 0")
        for name in ("key", "priority"):
            function = getattr(self, name)
            if function is not None and not callable(function):
                raise TypeError(f"{name} is a function of the goal, not {function!r}")
        for name in ("queue_timeout", "run_timeout"):
            seconds = getattr(self, name)
            if not seconds > 0:
                raise ValueError(f"{name} is more than 0, not {seconds}")
