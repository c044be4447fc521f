"""`Parts`: the parts of a server that runs, each with its partners, and their start and stop.

Theory of operation
-------------------

`Admission` decides on goals and `Cancels` on cancels. `Runs` has the active goals and runs their
executors, when the `Dispatcher` gives them their turn. `GoalRegistry` knows every goal, and
`GoalLogs` tells followers about them. The `Keeper` writes to the store; `Recovery` takes over what
the store has, `Losses` lets go of what other servers have by now, and `Room` tells the store how
much there is place for.

They are made here, and only here, when the server starts. Partners are given to the constructors.
Two of them call each other back: the keeper gets `KeeperEvents` when it is opened, and the
dispatcher gets the goals. What a server does not have is a part that does nothing: `NoStoreKeeper`,
`NoScheduleDispatcher`, `NoWatchers`.

The start is `open`, then `recover`, then the room is told. The end is `close`, after which nothing
new is taken; `stop`, which ends or releases the goals; and the end of the tasks and of the store,
which the exit stack of `open` has.
"""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import Generic

from anyio import move_on_after

from fibaction._runtime.asyncio_task import loop_clock
from fibaction._runtime.own_thread import HomeLoop
from fibaction._runtime.tasks import Background
from fibaction.server.admission.admission import Admission
from fibaction.server.admission.goal_callbacks import GoalCallbacks
from fibaction.server.admission.room_report import Room
from fibaction.server.cancels import Cancels
from fibaction.server.durability.goal_keeper import STORE_IS_LATE
from fibaction.server.durability.keeper import Keeper, KeeperEvents
from fibaction.server.durability.past_goals import PastGoals
from fibaction.server.durability.recovery import Recovery
from fibaction.server.execution.executor import Runner
from fibaction.server.execution.runs import Runs
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.lost_goals import Losses
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.settings import ActionServerSettings
from fibaction.server.shutdown import Shutdown
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import copy_of

SERVER_STOPPED = "server stopped"
STORE_PATIENCE = 5.0
"""Seconds that a server which stops waits for its store, at least: a disk may be busy."""


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
        registry = GoalRegistry(
            result_timeout=settings.result_timeout,
            max_results=settings.max_results,
            max_goals=settings.max_goals,
            max_bytes=settings.max_bytes,
        )
        self.logs = logs = GoalLogs(
            registry,
            watchers,
            loop_clock(),
            window=settings.feedback_window,
            latest=settings.feedback == "latest",
            are_told_elsewhere=keeper.tells_statuses,
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
            runs,
            keeper,
            callbacks,
            self.admission.decided,
            interrupt=settings.interrupt_on_cancel,
        )
        self.recovery = Recovery(
            action, registry, runs, logs, dispatcher, watchers, self.admission, settings
        )
        self._losses = Losses(self.admission, runs, self.recovery)
        self.room = Room(registry, keeper, dispatcher)

    async def open(self, stack: AsyncExitStack) -> None:
        """Open the store, and start the tasks. The stack ends both.

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
            lose=self._losses.lose,
            obstacle=self.recovery.readable.obstacle,
            ends_unreadable=self._settings.unreadable == "abort",
            refuse=self._losses.lose_record,
            fail=self._give_up,
            look_at_room=self.room.update,
        )
        await stack.enter_async_context(self.keeper.open(tasks, events))
        await self.recovery.check()
        keeper = self.keeper
        await self.dispatcher.open(tasks, self.runs, keeper.look_at_room, keeper.key_places)
        self.runs.open(tasks)  # its tasks wait for `stop`, so nothing may fail from here on
        self.keeper.start(tasks, self.recovery.open, self.room.watch)

    async def recover(self) -> None:
        """Take over what the store has.

        Raises:
            StoreError: The store has failed.
        """
        await self.recovery.recovered()
        if self.keeper.failure is not None:
            raise copy_of(self.keeper.failure)
        self.logs.ended.notify()  # some outcomes may have been found that expire

    async def drain(self, timeout: float) -> None:
        """Reject new goals as busy, and wait until the active ones have ended, at most `timeout`
        seconds.
        """
        self.admission.drain()
        self.room.close()
        with move_on_after(timeout):
            await self.keeper.settled()  # what is accepted by then is active
            while self.runs.are_left:
                await self.logs.ended.wait()

    def close(self) -> None:
        """Take nothing new from now on."""
        self.room.close()
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
        shutdown = Shutdown(self.runs, self.logs.ended, self._name, SERVER_STOPPED, timeout)
        try:
            try:
                # What is accepted by then is among the goals to stop.
                await self.keeper.settled_within(patience)
            finally:  # asyncio can cancel the task itself
                await shutdown.run()
            await self.keeper.settled_within(patience)
        finally:
            self.keeper.close()
            self.runs.let_go(STORE_IS_LATE)
            self.admission.wake()
            self.logs.close()

    def _give_up(self) -> None:
        """Let go of what cannot be kept any more: the store has failed."""
        self.close()
        self.runs.abandon_ends()
        self.admission.wake()
