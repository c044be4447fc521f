"""`Shutdown`: the end of all active goals when their server stops."""

from __future__ import annotations

from typing import Any

from anyio import move_on_after

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.slices import Slices
from fibaction.server.execution.executor_ends import warn_of_kill
from fibaction.server.execution.runs import Runs

MOST_NAMED = 10
"""Goals that are named in the log when they are killed; the others are counted."""

logger = clean_logger("fibaction.server")


class Shutdown:
    """The stop of one server's executors, for a reason, within a time."""

    def __init__(
        self, runs: Runs[Any, Any, Any], ended: Notifier, action: str, reason: str, timeout: float
    ) -> None:
        """Wait `timeout` seconds for executors; `ended` notifies of each goal that ends."""
        self._runs = runs
        self._ended = ended
        self._action = action
        self._reason = reason
        self._timeout = timeout

    async def run(self) -> None:
        """Interrupt all executors, wait until they have ended, and kill those that have not."""
        try:
            slices = Slices()
            for goal_id in self._runs.active():
                self._runs.interrupt(goal_id, self._reason)
                await slices.pause()
            with move_on_after(self._timeout, shield=True):
                while self._runs.are_left:
                    await self._ended.wait()
        finally:
            try:
                await self._kill_all()
            finally:
                self._runs.lost.kill_all()
                self._runs.close()

    async def _kill_all(self) -> None:
        goals = self._runs.active()
        for goal_id in goals[:MOST_NAMED]:
            warn_of_kill(goal_id, self._action, self._timeout)
        if len(goals) > MOST_NAMED:
            more = len(goals) - MOST_NAMED
            logger.warning(
                "%d more goals of action %r did not stop in time either", more, self._action
            )
        slices = Slices()
        try:
            for goal_id in goals:
                self._runs.kill(goal_id, self._reason, for_good=True)
                await slices.pause()
        finally:
            for goal_id in self._runs.active():  # asyncio itself canceled the task in a pause
                self._runs.kill(goal_id, self._reason, for_good=True)
