"""`LostExecutors`: executors of goals that belong to other servers by now, until they have ended.

They are interrupted, have the time of a clean-up, and are killed then: one task, `run`, waits for
that. A goal may come back to this server before its old executor has ended (`left`).

An executor that is only fenced off is still that of an active goal, but is killed in the same way.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from anyio import current_time, sleep_until

from fibaction._runtime.notify import Notifier
from fibaction.server.execution.executor import Execution, ExecutorPhase
from fibaction.server.execution.executor_ends import warn_of_kill
from fibaction.words.goals import GoalID

if TYPE_CHECKING:
    from fibaction.server.durability.keeper import Keeper

AnyExecution: TypeAlias = Execution[Any, Any, Any]

LEASE_IS_OVER = "the server was cut off from its store for too long"


class Kill(Protocol):
    """A function that kills the executor of an active goal, and ends the goal."""

    def __call__(self, goal_id: GoalID, /, *, for_good: bool) -> None: ...


class LostExecutors:
    """The executors of lost goals of one server."""

    def __init__(self, action: str, keeper: Keeper, *, kill_after: float, kill: Kill) -> None:
        """Kill those that have not ended `kill_after` seconds after an interruption: by `kill`, if
        their goals are still active.
        """
        self._action = action
        self._keeper = keeper
        self._kill_after = kill_after
        self._kill = kill
        self.executions: dict[GoalID, AnyExecution] = {}
        """These executors, by their goals."""
        self._due: deque[tuple[float, AnyExecution]] = deque()
        self._news = Notifier()
        self._left = Notifier()

    def add(self, execution: AnyExecution) -> None:
        """Interrupt the executor of a goal that is lost, and note it until it has ended."""
        self.executions[execution.goal.goal_id] = execution
        self.interrupt(execution)

    def interrupt(self, execution: AnyExecution) -> None:
        """Interrupt an executor, and kill it if it does not end in time."""
        execution.goal.goes_on = True
        execution.interrupt()
        self._due.append((current_time() + self._kill_after, execution))
        self._news.notify()

    def fence(self, execution: AnyExecution) -> bool:
        """Interrupt an executor, and return True, if its goal may be another server's by now."""
        if self._keeper.is_valid:
            return False
        goal = execution.goal
        if goal.phase.is_open and execution.phase is not ExecutorPhase.INTERRUPTED:
            goal.stop_reason = goal.stop_reason or LEASE_IS_OVER
            self.interrupt(execution)
        return True

    def discard(self, execution: AnyExecution) -> bool:
        """Forget an executor that has ended; return whether it was one of these."""
        if self.executions.get(execution.goal.goal_id) is not execution:
            return False
        del self.executions[execution.goal.goal_id]
        self._left.notify()
        return True

    async def left(self, goal_id: GoalID) -> None:
        """Wait until no executor of that goal is left from before."""
        while goal_id in self.executions:
            await self._left.wait()

    async def run(self) -> None:
        """Kill executors whose time is over, until canceled."""
        while True:
            while not self._due:
                await self._news.wait()
            await self._kill_first()

    async def _kill_first(self) -> None:
        # Its own function, as `run` would reference the last executor until the next one is lost.
        at, execution = self._due[0]
        if execution.phase is not ExecutorPhase.GONE:
            await sleep_until(at)
        self._due.popleft()
        if execution.phase is not ExecutorPhase.GONE:
            warn_of_kill(execution.goal.goal_id, self._action, self._kill_after)
            if execution.goal.phase.is_open:
                self._kill(execution.goal.goal_id, for_good=False)
            else:
                execution.kill(for_good=False)

    def kill_all(self) -> None:
        """Kill all of them for good: the server stops."""
        for execution in self.executions.values():
            execution.kill()
