"""Cancels: `Cancels` calls `on_cancel`, and carries out its answers.

The registry says which goals a cancel means; `on_cancel` is called for each of them, for
`CANCELS_DECIDED_AT_ONCE` concurrently, because one slow answer should not delay the cancels of
other goals. A client may cancel all goals as often as it likes, so the work is done in slices.

With a store, the executor of a goal is interrupted at once, and the cancel is told when it is kept:
the answer waits for all writes before it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Generic

from anyio import Semaphore, create_task_group, current_time

from fibaction.border.event_loop import Slices
from fibaction.server.admission.callbacks import GoalCallbacks
from fibaction.server.durability.keeper import Keeper
from fibaction.server.execution.runs import Runs
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.life import Phase
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.types.action import FeedbackT, GoalT, ResultT
from fibaction.words.errors import CancelRejected, UnknownGoal
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID
from fibaction.words.statuses import GoalStatus

CANCELS_DECIDED_AT_ONCE = 100
"""Calls of `on_cancel` that one cancel waits for at the same time."""

_NOT_HERE = (CancelCode.UNKNOWN_GOAL_ID, CancelCode.GOAL_TERMINATED)


class Cancels(Generic[GoalT, FeedbackT, ResultT]):
    """The cancels of one server's goals."""

    def __init__(
        self,
        registry: GoalRegistry,
        logs: GoalLogs,
        runs: Runs[GoalT, FeedbackT, ResultT],
        keeper: Keeper,
        callbacks: GoalCallbacks[GoalT],
        decided: Callable[[GoalID], Awaitable[None]],
        *,
        interrupt: bool,
    ) -> None:
        """Wait with `decided` for goals that are undecided, and interrupt executors if
        `interrupt`.
        """
        self._registry = registry
        self._logs = logs
        self._runs = runs
        self._keeper = keeper
        self._callbacks = callbacks
        self._decided = decided
        self._interrupt = interrupt

    async def cancel(self, goal_id: GoalID | None, stamp: int | None) -> CancelAnswer:
        """Cancel the goals that an ID and a stamp mean: see `Endpoint.cancel_goals`."""
        if goal_id is not None:
            await self._decided(goal_id)
        cancellation = self._registry.cancel(goal_id, stamp, now=current_time())
        if not self._callbacks.are_cancels_decided or len(cancellation.candidates) < 2:
            slices = Slices()
            for goal in cancellation.candidates:
                asking = self._cancel(cancellation, goal)
                if asking is not None:
                    await self._cancel_later(cancellation, goal, asking)
                await slices.pause()
        else:
            await self._cancel_together(cancellation)
        await self._keeper.settled()
        self._keeper.check()
        for goal in cancellation.candidates:
            if goal.phase is Phase.LOST:
                cancellation.leave_out(goal)
        answer = cancellation.answer()
        if goal_id is not None and answer.return_code in _NOT_HERE:
            with suppress(UnknownGoal):
                self._logs.find(goal_id)  # raises `GoalKept` for a goal that lives in the store
        return answer

    async def _cancel_together(self, cancellation: Cancellation) -> None:
        """Cancel goals, and wait for several calls of an async `on_cancel` at the same time."""
        slices, room = Slices(), Semaphore(CANCELS_DECIDED_AT_ONCE, fast_acquire=True)

        async def wait(goal: GoalRecord, asking: Awaitable[None]) -> None:
            await self._cancel_later(cancellation, goal, asking)
            room.release()

        async with create_task_group() as tasks:
            for goal in cancellation.candidates:
                await room.acquire()
                asking = self._cancel(cancellation, goal)
                if asking is None:
                    room.release()
                else:
                    tasks.start_soon(wait, goal, asking)
                await slices.pause()

    def _cancel(self, cancellation: Cancellation, goal: GoalRecord) -> Awaitable[None] | None:
        """Cancel a goal, or have it rejected; return the answer to wait for if it takes time."""
        if not goal.phase.is_open:
            return None  # it has ended since it was chosen
        if self._callbacks.are_cancels_decided and goal.status is not GoalStatus.CANCELING:
            try:
                asking = self._callbacks.ask_cancel(self._runs.handle_of(goal.goal_id))
            except CancelRejected as exc:
                cancellation.reject(exc.reason)
                return None
            if asking is not None:
                return asking
        self._accept_cancel(cancellation, goal)
        return None

    async def _cancel_later(
        self, cancellation: Cancellation, goal: GoalRecord, asking: Awaitable[None]
    ) -> None:
        try:
            await asking
        except CancelRejected as exc:
            cancellation.reject(exc.reason)
        else:
            self._accept_cancel(cancellation, goal)

    def _accept_cancel(self, cancellation: Cancellation, goal: GoalRecord) -> None:
        before = goal.status
        if cancellation.accept(goal) and goal.status is not before:
            self._runs.cancel(goal, interrupt=self._interrupt)
