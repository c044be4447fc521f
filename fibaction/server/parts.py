"""`Parts`: the parts of a server that runs, each with its partners, and their start and stop.

Theory of operation
-------------------

`Admission` decides on goals and `Cancels` on cancels. `Runs` has the active goals and runs their
executors, when the `Dispatcher` gives them their turn. `GoalRegistry` knows every goal, and
`GoalLogs` tells followers about them. The `Keeper` writes to the store; `Recovery` takes over what
the store has, `Capacity` tells the store how many more goals the server can take, and `Levers` let
operators pause and drain the server.

They are made here, and only here, when the server starts. Partners are given to the constructors.
Each part carries out effects of the goals' `Life`. Two of them call each other back: the keeper
gets `KeeperEvents` when it is opened, and the dispatcher gets the goals. A feature that a server
does not have is a part that does nothing: a bare `Keeper`, `Dispatcher` or `Watchers`.

The start is `open`, then `recover`, then the capacity is told. The end is `close`, after which
nothing new is taken; `stop`, which ends or releases the goals; and the end of the tasks and of the
store, which the exit stack of `open` has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AsyncExitStack
from typing import Generic

from anyio import move_on_after

from fibaction._runtime.async_only import HomeLoop
from fibaction._runtime.log import clean_logger
from fibaction.border.event_loop import Background, Slices, loop_clock
from fibaction.server.admission.admission import Admission
from fibaction.server.admission.callbacks import GoalCallbacks
from fibaction.server.cancels import Cancels
from fibaction.server.durability.keeper import STORE_IS_LATE, Keeper, KeeperEvents
from fibaction.server.durability.recovery import Recovery
from fibaction.server.durability.stored_goals import PastGoals
from fibaction.server.execution.executor import Runner
from fibaction.server.execution.executor_ends import warn_of_kill
from fibaction.server.execution.runs import Runs
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.intake import Capacity, Levers
from fibaction.server.log_keeper import LogKeeper
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.settings import ActionServerSettings
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import copy_of
from fibaction.words.goals import GoalID

SERVER_STOPPED = "server stopped"
STORE_PATIENCE = 5.0
"""Seconds that a server which stops waits for its store, at least: a disk may be busy."""

MOST_NAMED = 10
"""Goals that are named in the log when they are killed; the others are counted."""

logger = clean_logger("fibaction.server")


class Parts(Generic[GoalT, FeedbackT, ResultT]):
    """The parts of one server."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        runner: Runner,
        settings: ActionServerSettings[GoalT],
        keeper: Keeper,
        dispatcher: Dispatcher[GoalT],
        watchers: Watchers,
        callbacks: GoalCallbacks[GoalT],
    ) -> None:
        self._name = action.name
        self._settings = settings
        self.keeper = keeper
        self.dispatcher = dispatcher
        self._callbacks = callbacks
        self.registry = registry = GoalRegistry(
            result_timeout=settings.result_timeout,
            max_results=settings.max_results,
            max_goals=settings.max_goals,
            max_bytes=settings.max_bytes,
        )
        self.logs = logs = GoalLogs(
            registry,
            watchers,
            keeper,
            loop_clock(),
            window=settings.feedback_window,
            latest=settings.feedback == "latest",
        )
        self.log_keeper = LogKeeper(action.name, settings.log_lines)
        self.past = PastGoals(action.name, keeper, logs, registry.budget)
        self._watch = Watch(action.name, settings.watchdog)
        self.runs = runs = Runs(
            action, runner, registry, logs, keeper, dispatcher, self._watch, settings
        )
        self.admission = Admission(
            action, registry, runs, logs, keeper, dispatcher, watchers, callbacks
        )
        self.cancels = Cancels(
            registry,
            logs,
            runs,
            keeper,
            callbacks,
            self.admission.decided,
            interrupt=settings.interrupt_on_cancel,
        )
        self.recovery = Recovery(
            action, registry, runs, logs, dispatcher, watchers, self.admission, settings
        )
        self.capacity = Capacity(registry, keeper, dispatcher, runs)
        self.levers = Levers(
            action.name,
            registry,
            keeper,
            runs,
            self.admission,
            self.capacity,
            (settings.schedule or Schedule()).told(settings.max_goals),
        )

    async def open(self, stack: AsyncExitStack, *, held: bool) -> None:
        """Open the store, and start the tasks. The stack ends both. If `held`, no executor runs
        before `runs.start`.

        Raises:
            StoreError: The store cannot be used, or has goals that cannot be read.
            RuntimeError, ValueError: The server cannot share its schedule with others.
        """
        self._watch.open(HomeLoop())
        stack.callback(self._watch.close)
        stack.enter_context(self.log_keeper.open())
        tasks = await stack.enter_async_context(Background())
        tasks.start_soon(self.logs.forget_expired, name=f"expiry of {self._name}")
        events = KeeperEvents(
            claim=self.recovery.claim,
            lose=self._lose,
            obstacle=self.recovery.readable.obstacle,
            ends_unreadable=self._settings.unreadable == "abort",
            refuse=self._lose_record,
            fail=self._fail,
            look_at_capacity=self.capacity.update,
        )
        await stack.enter_async_context(self.keeper.open(tasks, events))
        await self.levers.look()
        await self.recovery.check()
        keeper = self.keeper
        await self.dispatcher.open(tasks, self.runs, keeper.look_at_capacity, keeper.key_slots)
        # Their tasks wait for `stop`, so nothing may fail from here on.
        self.runs.open(tasks, held=held)
        self.keeper.start(tasks, self.recovery.open, self.capacity.watch)
        if self.keeper.intakes.intake_period < math.inf:
            tasks.start_soon(self.levers.watch, name=f"intake of {self._name}")

    async def recover(self) -> None:
        """Take over what the store has.

        Raises:
            StoreError: The store has failed.
        """
        await self.recovery.recovered()
        if self.keeper.failure is not None:
            raise copy_of(self.keeper.failure)
        self.logs.ended.notify()  # some outcomes may have been found that expire

    async def drain(self, timeout: float, together: Sequence[GoalRegistry]) -> None:
        """Reject new goals as busy, and wait until the active ones have ended, at most `timeout`
        seconds. Goals that active ones have sent, also those of other registries, are accepted.
        While the action is paused, goals that have not begun are not waited for.
        """
        self.levers.finish()
        self.admission.drain(together)
        self.capacity.close()
        with move_on_after(timeout):
            await self.keeper.settled()  # what is accepted by then is active
            while self.runs.are_going_on:
                await self.logs.ended.wait()

    def close(self) -> None:
        """Take nothing new from now on."""
        self.levers.finish()
        self.capacity.close()
        self.recovery.close()
        self.admission.close()
        self._callbacks.stop()

    async def stop(self) -> None:
        """End all goals, or release those that are kept."""
        self.close()
        self.dispatcher.close()
        timeout = self._settings.shutdown_timeout
        patience = max(timeout, STORE_PATIENCE)
        if self._settings.at_stop == "keep":
            self.runs.keep_for(SERVER_STOPPED)
        try:
            try:
                # What is accepted by then is among the goals to stop.
                await self.keeper.settled_within(patience)
            finally:  # asyncio can cancel the task itself
                await self._end_goals(timeout)
            await self.keeper.settled_within(patience)
        finally:
            self.keeper.close()
            self.runs.release(STORE_IS_LATE)
            self.admission.wake()
            self.logs.close()

    async def _end_goals(self, timeout: float) -> None:
        """Interrupt all executors, wait until they have ended, and kill those that have not."""
        try:
            slices = Slices()
            for goal_id in self.runs.active():
                self.runs.interrupt(goal_id, SERVER_STOPPED)
                await slices.pause()
            self.runs.start()  # those that are held back end, too
            with move_on_after(timeout, shield=True):
                while self.runs.are_left:
                    await self.logs.ended.wait()
        finally:
            try:
                await self._kill_goals(timeout)
            finally:
                self.runs.lost.kill_all()
                self.runs.close()

    async def _kill_goals(self, timeout: float) -> None:
        goals = self.runs.active()
        for goal_id in goals[:MOST_NAMED]:
            warn_of_kill(goal_id, self._name, timeout)
        if len(goals) > MOST_NAMED:
            more = len(goals) - MOST_NAMED
            logger.warning(
                "%d more goals of action %r did not stop in time either", more, self._name
            )
        slices = Slices()
        try:
            for goal_id in goals:
                self.runs.kill(goal_id, SERVER_STOPPED, for_good=True)
                await slices.pause()
        finally:
            for goal_id in self.runs.active():  # asyncio itself canceled the task in a pause
                self.runs.kill(goal_id, SERVER_STOPPED, for_good=True)

    # Events that the store reports by itself

    def _lose(self, goal_id: GoalID) -> None:
        """Let go of a goal that another server has taken over; of an unknown one, nothing."""
        self.recovery.lose(goal_id)
        goal = self.admission.writing(goal_id) or self.runs.record_of(goal_id)
        if goal is not None:
            self._lose_record(goal)

    def _lose_record(self, goal: GoalRecord) -> None:
        """Let go of a goal of which a write was refused, because another server has it."""
        if not self.admission.lose(goal):
            self.runs.lose(goal)

    def _fail(self) -> None:
        """Let go of what cannot be kept any more: the store has failed."""
        self.close()
        self.runs.release_unwritten()
        self.admission.wake()
