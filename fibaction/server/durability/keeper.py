"""`Keeper`: the way in which a server keeps its goals, with a store or without one.

Each write says whether it is kept already. If it is not, it is followed by an event of the goal's
life (see `life`): its function `then` is called with that event as soon as it is kept. `GoalKeeper`
writes to a store. A server without a store has a `NoStoreKeeper`, for which all is kept at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from fibaction.border.goal_store import RecordTooLarge
    from fibaction.server.life import Event
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.errors import GoalKept, StoreError
    from fibaction.words.goals import Outcome

Kept: TypeAlias = Callable[["GoalRecord", "Event"], None]
"""A function that is called when a write about a goal is durable, with the event that follows."""
TooLarge: TypeAlias = Callable[["GoalRecord", "RecordTooLarge"], None]
"""A function that is called when something about a goal is too large for the store."""


class Keeper(ABC):
    """The writes of one server about its goals."""

    failure: StoreError | None
    """The error of the first write that has failed."""
    has_lease: bool
    """True if the goals belong to this server only until a time: see `is_valid`."""
    is_valid: bool
    """True if the goals belong to this server for certain."""

    @abstractmethod
    def accept(
        self,
        goal: GoalRecord,
        payload: bytes,
        meta: dict[str, str] | None,
        *,
        is_running: bool,
        then: Kept,
        too_large: TooLarge,
    ) -> int:
        """Keep a goal that is about to be accepted, and return the number of the write; 0 if it is
        kept already.
        """

    @abstractmethod
    def begin(self, goal: GoalRecord, event: Event, then: Kept) -> bool:
        """Keep that an attempt at the goal begins, unless its acceptance has said so; `event`
        follows. Return whether it is kept already.
        """

    @abstractmethod
    def cancel(self, goal: GoalRecord, then: Kept) -> bool:
        """Keep that a cancel of the goal was accepted; return whether it is kept already."""

    @abstractmethod
    async def keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """Keep a checkpoint, which `encode` returns, and wait until it is kept.

        Raises:
            RuntimeError: The goal has ended.
            StoreError: It cannot be kept, or the goal belongs to another server by now.
        """

    @abstractmethod
    def end(
        self, goal: GoalRecord, outcome: Outcome[bytes], then: Kept, too_large: TooLarge
    ) -> bool:
        """Keep the end of the goal; return whether it is kept already."""

    @abstractmethod
    def release(self, goal: GoalRecord, then: Kept) -> None:
        """Keep that the goal is free, to be run again. Only a store has such goals."""

    @abstractmethod
    def check(self) -> None:
        """Check that goals can be kept.

        Raises:
            GoalKept: The store has failed, or the server has stopped.
        """

    @abstractmethod
    def stopped(self) -> GoalKept:
        """Return the error for calls that wait for a server which has stopped."""

    @abstractmethod
    async def kept(self, write: int) -> None:
        """Wait until the write of that number is durable.

        Raises:
            StoreError: It has failed, or one before it.
        """

    @abstractmethod
    async def settled(self) -> None:
        """Wait until all writes so far are durable, or one has failed."""


class NoStoreKeeper(Keeper):
    """The keeper of a server without a store: all is kept at once, as long as the server runs."""

    failure = None
    has_lease = False
    is_valid = True

    def accept(
        self,
        goal: GoalRecord,
        payload: bytes,
        meta: dict[str, str] | None,
        *,
        is_running: bool,
        then: Kept,
        too_large: TooLarge,
    ) -> int:
        return 0

    def begin(self, goal: GoalRecord, event: Event, then: Kept) -> bool:
        return True

    def cancel(self, goal: GoalRecord, then: Kept) -> bool:
        return True

    async def keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """Keep nothing: there is no next attempt."""

    def end(
        self, goal: GoalRecord, outcome: Outcome[bytes], then: Kept, too_large: TooLarge
    ) -> bool:
        return True

    def release(self, goal: GoalRecord, then: Kept) -> None:
        raise NotImplementedError("only a store keeps a goal to be run again")

    def check(self) -> None:
        """Do nothing: what is kept in memory does not fail."""

    def stopped(self) -> GoalKept:
        raise NotImplementedError("only a store can fail")

    async def kept(self, write: int) -> None:
        """Return at once."""

    async def settled(self) -> None:
        """Return at once."""
