"""`Parts`: the parts of a server that runs, each with its partners, and their start and stop.

Theory of operation
-------------------

`Admission` decides on goals and `Cancels` on cancels. `Runs` has the active goals and runs their
executors, when the `Dispatcher` gives them their turn. `GoalRegistry` knows every goal, and
`GoalLogs` tells followers about them. The `Keeper` writes to the store; `Recovery` takes over what
the store has, and `Capacity` tells the store how many more goals the server can take.

They are made here, and only here, when the server starts. Partners are given to the constructors.
Each part carries out effects of the goals' `Life`. Two of them call each other back: the keeper
gets `KeeperEvents` when it is opened, and the dispatcher gets the goals. A feature that a server
does not have is a part that does nothing: a bare `Keeper`, `Dispatcher` or `Watchers`.

The start is `open`, then `recover`, then the capacity is told. The end is `close`, after which
nothing new is taken; `stop`, which ends or releases the goals; and the end of the tasks and of the
store, which the exit stack of `open` has.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AsyncExitStack
from typing import Any, Generic

from anyio import move_on_after, sleep
from anyio.abc import TaskGroup

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.own_thread import HomeLoop
from fibaction.border.event_loop import Background, Slices, loop_clock
from fibaction.server.admission.admission import Admission
from fibaction.server.admission.callbacks import GoalCallbacks
from fibaction.server.cancels import Cancels
from fibaction.server.durability.keeper import STORE_IS_LATE, Keeper, KeeperEvents
from fibaction.server.durability.past_goals import PastGoals
from fibaction.server.durability.recovery import Recovery
from fibaction.server.execution.abandoned import warn_of_kill
from fibaction.server.execution.executor import Runner
from fibaction.server.execution.runs import Runs
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
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

LOOK_AGAIN = 0.1
"""Seconds after which a server that holds too many bytes looks again."""

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

    async def open(self, stack: AsyncExitStack, *, held: bool) -> None:
        """Open the store, and start the tasks. The stack ends both. If `held`, no executor runs
        before `runs.start`.

        Raises:
            StoreError: The store cannot be used, or has goals that cannot be read.
            RuntimeError, ValueError: The server cannot share its schedule with others.
        """
        self._watch.open(HomeLoop())
        stack.callback(self._watch.close)
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
        await self.recovery.check()
        keeper = self.keeper
        await self.dispatcher.open(tasks, self.runs, keeper.look_at_capacity, keeper.key_places)
        # Their tasks wait for `stop`, so nothing may fail from here on.
        self.runs.open(tasks, held=held)
        self.keeper.start(tasks, self.recovery.open, self.capacity.watch)

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
        """
        self.admission.drain(together)
        self.capacity.close()
        with move_on_after(timeout):
            await self.keeper.settled()  # what is accepted by then is active
            while self.runs.are_left:
                await self.logs.ended.wait()

    def close(self) -> None:
        """Take nothing new from now on."""
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
                if self._runs.suspects.goals:
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
