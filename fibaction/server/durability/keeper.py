"""`Keeper`: the way in which a server keeps its goals, with a store or without one.

`GoalKeeper` writes to a store: what a write says is told only when it is kept. A server without a
store has a `NoStoreKeeper`, for which all is kept at once, as long as the server runs: its goals
live by the table without writes (see `life`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager, AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeVar

from fibaction._runtime.log import clean_logger
from fibaction.border.goal_store import NoFleet, PastSource
from fibaction.server.life import LIFE_IN_MEMORY, Effect, Event, Phase, Step

if TYPE_CHECKING:
    from anyio.abc import TaskGroup

    from fibaction.border.goal_store import KeyPlaces, RecordTooLarge, StoredGoal
    from fibaction.server.registry.goal_record import GoalRecord, Offer
    from fibaction.types.action import GoalT
    from fibaction.words.errors import GoalKept, StoreError
    from fibaction.words.goals import GoalID, Outcome

ADD_A_STORE = "give the server a store, such as store=SqliteStore('goals.db')"
"""The advice for a setting or a call that has no effect without a store."""

logger = clean_logger("fibaction.server")

Kept: TypeAlias = Callable[[], None]
"""A function that is called when a write is durable."""
TooLarge: TypeAlias = Callable[["RecordTooLarge"], None]
"""A function that is called when what was to be written is too large for the store."""


class Active(Protocol):
    """An active goal, as far as it is written."""

    goal: GoalRecord
    outcome: Outcome[bytes] | None


ActiveT = TypeVar("ActiveT", bound=Active)
Take: TypeAlias = Callable[[ActiveT, Event], None]
"""A function by which a goal takes the step that follows from an event."""
Acts: TypeAlias = dict[Effect, Callable[[ActiveT], None]]
"""The functions that carry out effects."""


@dataclass(frozen=True)
class KeeperEvents:
    """The functions of a server that its store calls by itself."""

    claim: Callable[[StoredGoal], None]
    """Take over a goal of an earlier process, or of another server."""
    lose: Callable[[GoalID], None]
    """Let go of a goal that another server has taken over."""
    obstacle: Callable[[StoredGoal], str]
    """Return why the server cannot run a goal of another server; empty if it can."""
    ends_unreadable: bool
    """True if the server ends the goals that no server can run."""
    refuse: Callable[[GoalRecord], None]
    """Let go of a goal of which a write is refused for that reason."""
    fail: Callable[[], None]
    """Stop: a write has failed."""
    look_at_room: Callable[[], None]
    """Tell the store the room for goals, if it has changed: called after each write, and after its
    answer."""


class Keeper(ABC):
    """The writes of one server about its goals."""

    failure: StoreError | None
    """The error of the first write that has failed."""
    has_lease: bool
    """True if the goals belong to this server only until a time: see `is_valid`."""
    is_valid: bool
    """True if the goals belong to this server for certain."""
    tells_statuses: bool
    """True if the statuses may be followed without this server's knowledge."""
    block: AbstractContextManager[object]
    """A block that is canceled when the store fails, once the keeper is open."""
    life: Mapping[tuple[Phase, Event], Step]
    """The table by which the goals live."""
    past: PastSource
    """The source of the goals of the past, once the keeper is open."""

    @abstractmethod
    def open(self, tasks: TaskGroup, events: KeeperEvents) -> AbstractAsyncContextManager[None]:
        """Open the store for as long as the block lasts, with tasks of this group.

        Raises:
            StoreError: The store cannot be used.
        """

    @abstractmethod
    def close(self) -> None:
        """Carry out no more answers: the server has stopped without waiting for them."""

    @abstractmethod
    def start(self, tasks: TaskGroup, *parts: Callable[[TaskGroup], None]) -> None:
        """Start the parts that only a server with a store needs, with tasks of this group."""

    @abstractmethod
    def look_at_room(self) -> None:
        """Let the store know if the room of the server has changed."""

    @abstractmethod
    def set_room(self, running: float, waiting: float) -> None:
        """Tell the store how many more goals the server can run and queue."""

    @abstractmethod
    async def key_places(self, limit: str, most: int) -> KeyPlaces:
        """See `GoalJournal.key_places`.

        Raises:
            ValueError: There is no fleet.
            StoreError: The store does not answer.
        """

    @abstractmethod
    def acts(self, take: Take[ActiveT]) -> Acts[ActiveT]:
        """Return the functions that carry out the effects which write, and call `take` with what
        follows.
        """

    @abstractmethod
    def accept(
        self,
        offer: Offer[GoalT],
        *,
        is_running: bool,
        then: Callable[[Offer[GoalT]], None],
        too_large: Callable[[Offer[GoalT], RecordTooLarge], None],
    ) -> int:
        """Keep the goal of an offer, which has its record, and return the number of the write; 0 if
        it is kept already.
        """

    @abstractmethod
    async def keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """Keep a checkpoint, which `encode` returns, and wait until it is kept.

        Raises:
            RuntimeError: The goal has ended.
            StoreError: It cannot be kept, or the goal belongs to another server by now.
        """

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

    @abstractmethod
    async def settled_within(self, seconds: float) -> None:
        """Wait for that, for some seconds at most, even if the caller is canceled."""


class NoStoreKeeper(Keeper):
    """The keeper of a server without a store: all is kept at once, as long as the server runs."""

    failure = None
    has_lease = False
    is_valid = True
    tells_statuses = False
    block = nullcontext()
    life = LIFE_IN_MEMORY
    past: PastSource = PastSource()

    def __init__(self, action: str) -> None:
        self._action = action
        self._has_warned = False

    def open(self, tasks: TaskGroup, events: KeeperEvents) -> AbstractAsyncContextManager[None]:
        return nullcontext()

    def close(self) -> None:
        """Do nothing: there are no answers."""

    def start(self, tasks: TaskGroup, *parts: Callable[[TaskGroup], None]) -> None:
        """Start none of them."""

    def look_at_room(self) -> None:
        """Do nothing: no goals are handed over."""

    def set_room(self, running: float, waiting: float) -> None:
        """Do nothing, as above."""

    async def key_places(self, limit: str, most: int) -> KeyPlaces:
        raise NoFleet(limit)

    def acts(self, take: Take[ActiveT]) -> Acts[ActiveT]:
        return {}

    def accept(
        self,
        offer: Offer[GoalT],
        *,
        is_running: bool,
        then: Callable[[Offer[GoalT]], None],
        too_large: Callable[[Offer[GoalT], RecordTooLarge], None],
    ) -> int:
        return 0

    async def keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """Keep nothing: there is no next attempt. The first call warns of that."""
        if not self._has_warned:
            self._has_warned = True
            logger.warning(
                "action server %r has no store, so goal.checkpoint() keeps nothing: %s",
                self._action,
                ADD_A_STORE,
            )

    def check(self) -> None:
        """Do nothing: what is kept in memory does not fail."""

    def stopped(self) -> GoalKept:
        raise NotImplementedError("only a store can fail")

    async def kept(self, write: int) -> None:
        """Return at once."""

    async def settled(self) -> None:
        """Return at once."""

    async def settled_within(self, seconds: float) -> None:
        """Return at once."""
