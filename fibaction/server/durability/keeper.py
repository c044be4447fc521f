"""`Keeper`: the way in which a server keeps its goals; this one is for a server without a store.

`GoalKeeper` writes to a store: what a write says is told only when it is kept. For a `Keeper`
itself, all is kept at once, as long as the server runs: its goals live by the table without writes
(see `life`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager, AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import IntakeSource, NoFleet, PastSource
from fibaction.server.life import LIFE_IN_MEMORY, Event, Life, Phase, Step
from fibaction.words.errors import ProtocolError

if TYPE_CHECKING:
    from anyio.abc import TaskGroup

    from fibaction.border.goal_store import KeySlots, StoredGoal
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.types.action import Codec
    from fibaction.words.errors import StoreError
    from fibaction.words.goals import GoalID

GOAL_IS_TAKEN = (
    "another server has taken the goal over, since this one has not told the store in time that it"
    " is there: the goal continues, so follow it by its ID"
)
STORE_FAILED = "the server has stopped, because its store has failed"
GOAL_IS_KEPT = "the server has stopped, and runs the goal again after its next start"
STORE_IS_LATE = "the server has stopped before its store has answered"
ADD_A_STORE = "give the server a store, such as store=SqliteStore('goals.db')"
"""The advice for a setting or a call that has no effect without a store."""

logger = clean_logger("fibaction.server")


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
    look_at_capacity: Callable[[], None]
    """Tell the store the room for goals, if it has changed: called after each write, and after its
    answer."""


class Keeper:
    """The writes of one server about its goals: none, as it has no store."""

    failure: StoreError | None = None
    """The error of the first write that has failed."""
    has_lease: bool = False
    """True if the goals belong to this server only until a time: see `is_valid`."""
    is_valid: bool = True
    """True if the goals belong to this server for certain."""
    block: AbstractContextManager[object] = nullcontext()
    """A block that is canceled when the store fails, once the keeper is open."""
    past: PastSource = PastSource()
    """The source of the goals of the past, once the keeper is open."""

    def __init__(
        self,
        action: str,
        checkpoints: Codec[Any] | None = None,
        table: Mapping[tuple[Phase, Event], Step] = LIFE_IN_MEMORY,
    ) -> None:
        self.life = Life(table)
        """The lives of the goals, by a table in which each step is kept before it is told."""
        self.intakes = IntakeSource()
        """The source of how the action takes goals, once the keeper is open."""
        self._action = action
        self._checkpoints = checkpoints
        self._has_warned = False

    def open(self, tasks: TaskGroup, events: KeeperEvents) -> AbstractAsyncContextManager[None]:
        """Open the store for as long as the block lasts, with tasks of this group.

        Raises:
            StoreError: The store cannot be used.
        """
        return nullcontext()

    def close(self) -> None:
        """Carry out no more answers: the server has stopped without waiting for them."""

    def start(self, tasks: TaskGroup, *parts: Callable[[TaskGroup], None]) -> None:
        """Start the parts that only a server with a store needs, with tasks of this group."""

    def look_at_capacity(self) -> None:
        """Let the store know if the room of the server has changed."""

    def set_capacity(self, running: float, waiting: float) -> None:
        """Tell the store how many more goals the server can run and queue."""

    async def key_slots(self, limit: str, most: int) -> KeySlots:
        """See `GoalJournal.key_slots`.

        Raises:
            ValueError: There is no fleet.
            StoreError: The store does not answer.
        """
        raise NoFleet(limit)

    async def keep_checkpoint(self, goal: GoalRecord, state: object) -> None:
        """Keep the state of a goal, and wait until it is kept.

        Raises:
            TypeError: The action has no type for checkpoints, or the state is not of it.
            RuntimeError: The goal has ended.
            StoreError: It cannot be kept, or the goal belongs to another server by now.
        """
        codec = self._checkpoints
        if codec is None:
            raise TypeError(
                f"action {self._action!r} has no checkpoints: give their type to its Action, as"
                f" `checkpoint=`"
            )
        if not codec.accepts(state):
            raise TypeError(
                f"a checkpoint of action {self._action!r} is of type"
                f" {codec.type_text}, not {excerpt(repr(state))}"
            )
        await self._keep_state(goal, partial(codec.encode, state))

    async def _keep_state(self, goal: GoalRecord, encode: Callable[[], bytes]) -> None:
        """Keep a checkpoint, which `encode` returns. Without a store there is no next attempt, and
        the first call warns of that.
        """
        if not self._has_warned:
            self._has_warned = True
            logger.warning(
                "action server %r has no store, so goal.checkpoint() keeps nothing: %s",
                self._action,
                ADD_A_STORE,
            )

    def restored(self, stored: StoredGoal) -> Any:
        """Return the last checkpoint of a goal; None if there is none.

        Raises:
            ProtocolError: It is not of the type of checkpoints.
        """
        if stored.checkpoint is None:
            return None
        if self._checkpoints is None:
            raise ProtocolError(f"action {self._action!r} has no checkpoints any more")
        return self._checkpoints.decode(stored.checkpoint)

    def check(self) -> None:
        """Check that goals can be kept.

        Raises:
            GoalKept: The store has failed, or the server has stopped.
        """

    async def kept(self, write: int) -> None:
        """Wait until the write of that number is durable.

        Raises:
            StoreError: It has failed, or one before it.
        """

    async def settled(self) -> None:
        """Wait until all writes so far are durable, or one has failed."""

    async def settled_within(self, seconds: float) -> None:
        """Wait for that, for some seconds at most, even if the caller is canceled."""
