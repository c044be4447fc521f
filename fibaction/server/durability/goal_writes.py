"""`GoalWrites`: the effects of a goal's life that write, on a server with a store.

Each of them hands the write to the keeper, together with the event that follows when it is kept
(`KEPT`): the goal takes that step then, and clients are told.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Generic, Protocol

from fibaction.server.durability.keeper import ActiveT
from fibaction.server.life import KEPT, Effect, Event
from fibaction.words.goals import Outcome
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.border.goal_store import RecordTooLarge
    from fibaction.server.durability.keeper import Acts, Kept, Take, TooLarge
    from fibaction.server.registry.goal_record import GoalRecord


class GoalWriter(Protocol):
    """The object that writes: see `GoalKeeper`."""

    def begin(self, goal: GoalRecord, then: Kept) -> None: ...
    def cancel(self, goal: GoalRecord, then: Kept) -> None: ...
    def end(
        self, goal: GoalRecord, outcome: Outcome[bytes], then: Kept, too_large: TooLarge
    ) -> None: ...
    def release(self, goal: GoalRecord, then: Kept) -> None: ...


class GoalWrites(Generic[ActiveT]):
    """The writes about the active goals of one server."""

    def __init__(self, keeper: GoalWriter, take: Take[ActiveT]) -> None:
        self._keeper = keeper
        self._take = take

    def acts(self) -> Acts[ActiveT]:
        """Return the functions that carry out the effects which write."""
        return {
            Effect.WRITE_BEGIN: partial(self._write_begin, Effect.WRITE_BEGIN),
            Effect.WRITE_TAKE_OVER: partial(self._write_begin, Effect.WRITE_TAKE_OVER),
            Effect.WRITE_CANCEL: self._write_cancel,
            Effect.WRITE_END: self._write_end,
            Effect.WRITE_RELEASE: self._write_release,
        }

    def _then(self, active: ActiveT, effect: Effect) -> Kept:
        return partial(self._take, active, KEPT[effect])

    def _write_begin(self, effect: Effect, active: ActiveT) -> None:
        """Write that an attempt begins, unless the acceptance has said so."""
        if active.goal.stored is not None and active.goal.stored.is_running:
            self._take(active, KEPT[effect])
        else:
            self._keeper.begin(active.goal, self._then(active, effect))

    def _write_cancel(self, active: ActiveT) -> None:
        self._keeper.cancel(active.goal, self._then(active, Effect.WRITE_CANCEL))

    def _write_end(self, active: ActiveT) -> None:
        """Write the outcome; one that is too large is replaced by the reason."""
        assert active.outcome is not None

        def shorten(error: RecordTooLarge) -> None:
            active.outcome = Outcome(GoalStatus.ABORTED, None, f"the result is not kept: {error}")
            self._take(active, Event.TOO_LARGE)

        self._keeper.end(active.goal, active.outcome, self._then(active, Effect.WRITE_END), shorten)

    def _write_release(self, active: ActiveT) -> None:
        self._keeper.release(active.goal, self._then(active, Effect.WRITE_RELEASE))
