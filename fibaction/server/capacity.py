"""`Capacity`: the number of goals that a server can take in addition."""

from __future__ import annotations

from typing import Any

from anyio import sleep
from anyio.abc import TaskGroup

from fibaction._runtime.notify import Notifier
from fibaction.server.durability.keeper import Keeper
from fibaction.server.execution.runs import Runs
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher

LOOK_AGAIN = 0.1
"""Seconds after which a server that holds too many bytes looks again."""


class Capacity:
    """The number of goals that a server can take in addition, as its store is told.

    A store that several servers share hands goals over by it. It is computed from counters at each
    write of the server, at each answer, and when a goal leaves the schedule, and told when one of
    the two numbers becomes zero, or more than zero. Bytes are given back by readers, of which
    nothing is told, so a server that has too many looks again after a while.
    """

    def __init__(
        self,
        registry: GoalRegistry,
        keeper: Keeper,
        dispatcher: Dispatcher[Any],
        runs: Runs[Any, Any, Any],
    ) -> None:
        self._registry = registry
        self._keeper = keeper
        self._dispatcher = dispatcher
        self._runs = runs
        self._is_open = False
        self._told = False, False
        self._shortage = Notifier()

    def open(self) -> None:
        """Tell the store from now on what the server can take: it runs."""
        self._is_open = True
        self.update()

    def close(self) -> None:
        """Tell the store that the server takes no more goals: it drains, or stops."""
        self._is_open = False
        self.update()

    def update(self) -> None:
        """Tell the store if one of the numbers has become zero, or more than zero."""
        running, waiting = 0.0, 0.0
        if self._is_open:
            if self._registry.goals_left > 0:
                running, waiting = self._dispatcher.capacity()
                if self._registry.intake.holds or self._runs.suspects.goals:
                    running, waiting = 0.0, max(waiting, 1.0)
            elif self._registry.has_too_many_bytes:
                self._shortage.notify()
        has_room = running > 0, waiting > 0
        if has_room != self._told:
            self._told = has_room
            self._keeper.set_room(running, waiting)

    def watch(self, tasks: TaskGroup) -> None:
        """Look again after a shortage of bytes, in a task of this group."""
        tasks.start_soon(self._run, name="room for goals")

    async def _run(self) -> None:
        while True:
            while not (self._is_open and self._registry.has_too_many_bytes):
                await self._shortage.wait()
            await sleep(LOOK_AGAIN)
            self.update()
