"""Limits for the bytes that many parts hold together.

A stranger must not fill the memory of a server, however many connections it opens. So the parts
that hold bytes of peers share a `ByteBudget`. Where it is not known who lets go of the bytes last,
`CountedBytes` counts them for as long as anything references it:

    held = CountedBytes(budget, len(body))
    if budget.is_over:
        raise LimitReached("...")
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["ByteBudget", "CountedBytes"]


class ByteBudget:
    """A limit for the bytes that several parts hold together.

    It counts, and nothing else: each part says what it takes, and gives back the same.
    """

    __slots__ = ("limit", "make_room", "used")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        """The most bytes that should be held at the same time."""
        self.used = 0
        """The bytes that are held now."""
        self.make_room: Callable[[], object] | None = None
        """The function that lets go of bytes that are kept without being in use. It is called when
        more are held than the limit, before what is in use has to give way."""

    def has_room(self, size: int = 0) -> bool:
        """Return whether so many more bytes are within the limit."""
        return self.used + size <= self.limit

    @property
    def is_over(self) -> bool:
        """True if more bytes are held than the limit."""
        return self.used > self.limit

    def take(self, size: int) -> None:
        """Count bytes that are held from now on, even if they are over the limit."""
        self.used += size

    def give_back(self, size: int) -> None:
        """Count bytes as no longer held."""
        self.used -= size


class CountedBytes:
    """Some bytes that count in a budget for as long as this object is referenced.

    It serves parts that share what they hold, where none knows that it is the last one.
    """

    __slots__ = ("_budget", "size")

    def __init__(self, budget: ByteBudget, size: int) -> None:
        """Count so many bytes from now on."""
        self._budget = budget
        self.size = size
        """The bytes that are counted."""
        budget.used += size

    def resize(self, size: int) -> None:
        """Count so many bytes in place of those until now."""
        self._budget.used += size - self.size
        self.size = size

    def __del__(self) -> None:
        self._budget.used -= self.size
