"""`ByteBudget`: a number of bytes that many parts share."""

from __future__ import annotations


class ByteBudget:
    """A limit for the bytes that several parts hold together.

    It counts, and nothing else: each part says what it takes, and gives back the same.
    """

    __slots__ = ("limit", "used")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        """The most bytes that should be held at the same time."""
        self.used = 0
        """The bytes that are held now."""

    def has_room(self, size: int = 0) -> bool:
        """Return whether so many more bytes are within the limit."""
        return self.used + size <= self.limit

    def take(self, size: int) -> None:
        """Count bytes that are held from now on, also if they are over the limit."""
        self.used += size

    def give_back(self, size: int) -> None:
        """Count bytes as no longer held."""
        self.used -= size
