"""`Dispatcher`: the way in which goals get their turn; this one is for a server without a schedule.

Each goal has its turn as soon as it is accepted. `GoalDispatcher` carries out a `Schedule`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from fibaction.server.goal_handle import Succession
from fibaction.types.action import GoalT

if TYPE_CHECKING:
    from collections.abc import Callable

    from anyio.abc import TaskGroup

    from fibaction.border.goal_store import OpenKeySlots
    from fibaction.server.goal_handle import GoalHandle
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import GoalID, Sender


class DispatchedGoals(Protocol[GoalT]):
    """The active goals of a server, as far as they are dispatched: see `Runs`."""

    def begin(self, goal_id: GoalID) -> None: ...
    def interrupt(self, goal_id: GoalID, reason: str) -> None: ...
    def kill(self, goal_id: GoalID, /, *, for_good: bool) -> None: ...
    def take_over(self, goal_id: GoalID, successor: GoalID) -> None: ...
    def is_interrupted(self, goal_id: GoalID) -> bool: ...
    def handle_of(self, goal_id: GoalID) -> GoalHandle[GoalT]: ...
    def record_of(self, goal_id: GoalID) -> GoalRecord | None: ...


class Dispatcher(Succession[GoalT]):
    """The turns of one server's goals: all run at once, as it has no schedule."""

    def __init__(self) -> None:
        self._goals: DispatchedGoals[GoalT]
        self._is_closed = False

    async def open(
        self,
        tasks: TaskGroup,
        goals: DispatchedGoals[GoalT],
        changed: Callable[[], None],
        key_slots: OpenKeySlots,
    ) -> None:
        """Start, interrupt and end these goals from now on, in tasks of this group. Call `changed`
        when a place has become free. A limit that other servers have as well gets its slots from
        `key_slots`.

        Raises:
            RuntimeError, ValueError: The schedule cannot be shared with others.
            StoreError: The store does not answer.
        """
        self._goals = goals

    def start(self) -> None:
        """Count the time of goals from now on: executors were held back until then."""

    def close(self) -> None:
        """Start no goals from now on: the server stops, and ends all of them."""
        self._is_closed = True

    def offer(self, goal_id: GoalID, request: GoalT, sender: Sender, deadline: float) -> bool:
        """Find a place for a goal, and return whether it has its turn as soon as it is accepted.

        With `skip_expired`, it is not begun after its `deadline`, by the clock of the event loop.
        The place is its own until it has `left`. All that follows for this goal and for others is
        held back until it is `accepted`, or `withdraw`n.

        Raises:
            Busy: There is no place to run or to wait.
            GoalRejected: The function `key` or `priority` of the schedule rejects it, or failed.
        """
        return True

    def accepted(self, goal_id: GoalID) -> None:
        """Begin the goal if it has its turn, and carry out what else was held back."""
        if not self._is_closed:
            self._goals.begin(goal_id)

    def withdraw(self, goal_id: GoalID) -> None:
        """Free the place of a goal that is not accepted after all."""

    def resume(
        self, goal_id: GoalID, request: GoalT, sender: Sender, deadline: float, waited: float
    ) -> None:
        """Find a place for a goal that an earlier process has accepted, and begin it if it has its
        turn: it waits if it cannot run, also in a full queue. It has waited for so many seconds,
        and the deadline is as for `offer`.

        Raises:
            GoalRejected: As for `offer`.
        """
        self._goals.begin(goal_id)

    def failure_of(self, request: GoalT, sender: Sender) -> str:
        """Return how the function `key` or `priority` of the schedule fails for a goal; empty if it
        does not fail.
        """
        return ""

    def left(self, goal_id: GoalID) -> None:
        """Free the place of a goal whose executor is gone; of an unknown one, do nothing."""

    def hold(self, goal_id: GoalID) -> None:
        """Order nothing for a goal that has its turn: it does not begin before it may `go_on`."""

    def go_on(self, goal_id: GoalID) -> None:
        """Take a goal as one that begins now."""

    def lost(self, goal_id: GoalID) -> None:
        """Order nothing more for a goal that another server has taken over, and that runs here
        until its executor is gone.
        """

    def capacity(self) -> tuple[float, float]:
        """Return how many more goals can run, and how many more can wait."""
        return math.inf, 0

    def note_positions(self) -> None:
        """Note in the records of waiting goals their places in the queue, for observers."""
