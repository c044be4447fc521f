"""`ActionServer`: the settings, start and stop, and the client-facing methods of an action server.

The work is done by its parts: `Admission` decides on goals and `Cancels` on cancels, `Runs` runs
executors, `GoalRegistry` has every goal and its rules, and with a store, `GoalKeeper` writes to it
and `Recovery` takes over what it has. The server does not depend on transports: they call it as an
`Endpoint`.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Coroutine, Iterable
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Generic, Literal, Self

import anyio
from anyio import CancelScope, create_task_group

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.tasks import Background
from fibaction.border.abc import Endpoint, GoalRequest
from fibaction.border.goal_store import GoalStore
from fibaction.border.watchers import Watcher
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.feeds.status_broadcast import StatusCursor
from fibaction.server.admission.admission import Admission, Offer
from fibaction.server.admission.argument_checks import (
    check_is_executor,
    check_is_schedule,
    check_is_store,
    check_recovery,
)
from fibaction.server.admission.callbacks import Callback, Callbacks
from fibaction.server.admission.capacity import Room
from fibaction.server.admission.sender_argument import GoalFunction
from fibaction.server.cancels import Cancels
from fibaction.server.durability.goal_keeper import STORE_FAILED, GoalKeeper
from fibaction.server.durability.recovery import Recovery, RecoveryRule
from fibaction.server.execution.executor import Executor
from fibaction.server.execution.runs import GOAL_IS_KEPT, Runs
from fibaction.server.execution.watchdog import Watch
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.lost_goals import Losses
from fibaction.server.registry.registry import MAX_BYTES, MAX_GOALS, GoalRegistry
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.shutdown import Shutdown
from fibaction.server.watcher_group import WatcherGroup
from fibaction.types.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalKept, ServerNotFound, copy_of
from fibaction.words.goals import CancelAnswer, GoalID
from fibaction.words.meta import checked_meta

SERVER_STOPPED = "server stopped"
STORE_PATIENCE = 5.0
"""Seconds that a server which stops waits for its store, at least: a disk may be busy."""

logger = clean_logger("fibaction.server")


class ActionServer(Endpoint, Generic[GoalT, FeedbackT, ResultT]):
    """A server of one action, to be entered with `async with`, or given to `serve`.

    It can be entered once. User callbacks may be sync or async. An exception of a callback becomes
    an answer to the client and a line in the log, and the server goes on.

    For example:

        async with serve(ActionServer(DRIVE, drive), "tcp://127.0.0.1:7400"):
            await anyio.sleep_forever()
    """

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        *,
        on_goal: GoalFunction[GoalT, Awaitable[None] | None] | None = None,
        on_cancel: Callback[GoalHandle[GoalT]] | None = None,
        interrupt_on_cancel: bool = True,
        feedback: Literal["every", "latest"] = "every",
        feedback_window: int = 64,
        stall_timeout: float = 10.0,
        result_timeout: float = 10.0,
        max_results: int = 1000,
        max_goals: int = MAX_GOALS,
        max_bytes: int = MAX_BYTES,
        shutdown_timeout: float = 5.0,
        schedule: Schedule | None = None,
        store: GoalStore | None = None,
        recovery: RecoveryRule[GoalT] = "abort",
        max_attempts: int = 3,
        at_stop: Literal["abort", "keep"] = "abort",
        watchdog: float = 1.0,
        watchers: Iterable[Watcher] = (),
    ) -> None:
        """Set up a server; nothing runs yet.

        Args:
            action: The action that is served.
            executor: An async generator function, called with a `GoalHandle` for each goal.
            on_goal: A function that is called with each goal of the right type, and with its
                `Sender` if it has a second parameter, and raises `GoalRejected` to reject the goal.
                Without it, every such goal is accepted.
            on_cancel: A function that is called with the `GoalHandle` of each goal to cancel, and
                raises `CancelRejected` to reject the cancel. Without it, every cancel is accepted.
            interrupt_on_cancel: If true, an accepted cancel raises the backend's cancellation in
                the executor. If false, the executor has to check `goal.cancel_requested` itself.
            feedback: With `every`, no feedback is lost, and the executor waits at its `yield` for
                the goal's own client. With `latest`, it never waits, and a slow reader gets the
                newest feedback.
            feedback_window: The number of feedback messages of a goal that are remembered. So many
                may be unread before the executor waits, or before a slow reader loses the oldest.
            stall_timeout: Seconds that the executor waits for a client that does not read.
            result_timeout: Seconds that an outcome is kept after the goal's end; 0 not at all,
                `math.inf` for ever. A client that already waits for it always gets it.
            max_results: The number of outcomes that are kept at most; the oldest are forgotten.
            max_goals: The number of goals that may be active, or be decided upon, at the same time;
                more are rejected with a reason that begins with `busy`.
            max_bytes: The bytes of goals until their end, of remembered feedback, and of results,
                together. Over it new goals are rejected as `busy`, the oldest outcomes are
                forgotten, and executors wait until their feedback is read.
            shutdown_timeout: Seconds that executors have for their clean-up when the server stops.
                Then they are killed, and those that do not end are abandoned about a second later.
            schedule: The rules by which accepted goals run, wait and give way; None to run all of
                them at once.
            store: The place in which goals outlive this process; None to keep them in memory only.
            recovery: The rule for goals that were running when the server was killed, at its next
                start with the same store. With `abort`, they end as ABORTED; with `rerun`, they
                run again, from their last checkpoint if they have made one. A function is called
                with the `GoalHandle` of each, and returns None to run it again, or raises
                `GoalAborted`. Goals that have not begun run in any case.
            max_attempts: The number of attempts that a goal may lose in this way; then it ends as
                ABORTED.
            at_stop: With `abort`, a server that stops ends its goals. With `keep`, it interrupts
                their executors, and goals that do not end by themselves stay in the store: they run
                again after the next start.
            watchdog: Seconds that an executor may block the event loop before the log names its
                goal and its line of code; 0 is never. The time at a debugger's breakpoint counts,
                and so may the time for which the computer sleeps or is too busy.
            watchers: Objects that see everything that happens to goals: metrics, recordings and
                others.

        Raises:
            TypeError: The action is untyped, or the executor is not callable, is a coroutine
                function, or is a generator function that is not async; `on_goal` takes neither
                one argument nor two; the schedule is not a `Schedule`; or a watcher is not a
                `Watcher`.
            ValueError: A number is out of range; `feedback`, `recovery` or `at_stop` is not one of
                its words; or goals are to be kept at a stop without a store.
        """
        if object in action.feedback.classes:
            raise TypeError(
                f"{action!r} is untyped, and a server needs types: define an Action with the types"
                f" of goal, feedback and result"
            )
        check_is_executor(executor)
        if feedback not in ("every", "latest"):
            raise ValueError(f"feedback is 'every' or 'latest', not {feedback!r}")
        if feedback_window < 1:
            raise ValueError(f"feedback_window is at least 1, not {feedback_window}")
        for name, value in (
            ("stall_timeout", stall_timeout),
            ("result_timeout", result_timeout),
            ("max_results", max_results),
            ("max_goals", max_goals),
            ("max_bytes", max_bytes),
            ("shutdown_timeout", shutdown_timeout),
            ("watchdog", watchdog),
        ):
            if not value >= 0:
                raise ValueError(f"{name} is 0 or more, not {value}")
        check_recovery(recovery, max_attempts)
        if at_stop not in ("abort", "keep"):
            raise ValueError(f"at_stop is 'abort' or 'keep', not {at_stop!r}")
        self.action = action
        registry = GoalRegistry(
            result_timeout=result_timeout,
            max_results=max_results,
            max_goals=max_goals,
            max_bytes=max_bytes,
        )
        self._logs = GoalLogs(registry, window=feedback_window, latest=feedback == "latest")
        self._watch = Watch(action.name, watchdog)
        self._runs = Runs(
            action,
            executor,
            registry,
            self._logs,
            stall_timeout=stall_timeout,
            kill_after=shutdown_timeout,
            watch=self._watch,
        )
        self._dispatcher: Dispatcher[GoalT, FeedbackT, ResultT] | None = None
        if schedule is not None:
            check_is_schedule(schedule)
            self._dispatcher = Dispatcher(
                schedule, self._runs, action=action.name, kill_after=shutdown_timeout
            )
        self._callbacks = Callbacks(action.name)
        self._admission = Admission(
            action,
            registry,
            self._runs,
            self._logs,
            self._dispatcher,
            on_goal=on_goal,
            callbacks=self._callbacks,
        )
        self._cancels = Cancels(
            registry,
            self._runs,
            self._admission.decided,
            on_cancel=on_cancel,
            interrupt=interrupt_on_cancel,
            callbacks=self._callbacks,
        )
        self._recovery = Recovery(
            action,
            registry,
            self._runs,
            self._logs,
            self._dispatcher,
            self._admission.decided,
            rule=recovery,
            max_attempts=max_attempts,
            keep_for=result_timeout,
        )
        self._losses = Losses(action.name, self._admission, self._runs, self._recovery)
        self._room = Room(registry, self._dispatcher)
        self._keep_for, self._max_results = result_timeout, max_results
        self._at_stop = at_stop
        self._keeper: GoalKeeper | None = None
        self._watchers: WatcherGroup | None = None
        self._stack: AsyncExitStack
        self._block: CancelScope
        self._shutdown_timeout = shutdown_timeout
        self._started = Notifier()
        self.store: GoalStore | None = None
        """The store that keeps the goals of this server; None if none does."""
        self._phase: Literal["new", "running", "stopping", "stopped"] = "new"
        if store is not None:
            self.keep_in(store)
        self.watch_by(watchers)

    # Life

    @property
    def is_new(self) -> bool:
        """True if the server has not been entered yet."""
        return self._phase == "new"

    @property
    def is_running(self) -> bool:
        """True if the server accepts goals: it was entered, and has not begun to stop."""
        return self._phase == "running"

    def keep_in(self, store: GoalStore) -> None:
        """Keep goals in this store, as with the argument `store`.

        Raises:
            RuntimeError: The server was started before, or has a store.
            TypeError: It is not a `GoalStore`.
        """
        if not self.is_new or self._keeper is not None:
            state = "was started before" if self._keeper is None else "has a store"
            raise RuntimeError(f"{self!r} {state}; give the store to another one")
        check_is_store(store)
        self.store = store
        self._logs.are_told_elsewhere = store.tells_statuses
        keeper = self._keeper = GoalKeeper(
            store, self.action.name, keep_for=self._keep_for, max_results=self._max_results
        )
        self._runs.keep_by(keeper)
        self._admission.keep_by(keeper)
        self._cancels.keep_by(keeper)
        self._losses.keep_by(keeper)
        self._room.keep_by(keeper)
        keeper.on_failure = self._give_up

    def watch_by(self, watchers: Iterable[Watcher]) -> None:
        """Add watchers to those that the server has, as with the argument `watchers`.

        Raises:
            RuntimeError: The server was started before.
            TypeError: One of them is not a `Watcher`, or has an async method.
        """
        members = tuple(watchers)
        if not members:
            return
        if not self.is_new:
            raise RuntimeError(f"{self!r} was started before; give the watchers to another one")
        earlier = () if self._watchers is None else self._watchers.members
        self._watchers = WatcherGroup(self.action.name, (*earlier, *members))
        self._logs.watchers = self._admission.watchers = self._watchers
        self._recovery.watchers = self._watchers

    async def __aenter__(self) -> Self:
        """Start the server. With a store, take over its goals before anything else.

        Raises:
            RuntimeError: It was started before.
            ValueError: Goals are to be kept at a stop, and there is no store.
            StoreError: The store cannot be used.
        """
        if not self.is_new:
            raise RuntimeError(f"{self!r} was started before; make another one")
        if self._at_stop == "keep" and self._keeper is None:
            raise ValueError(f"{self!r} has at_stop='keep', which needs a store")
        async with AsyncExitStack() as stack:
            if self._watchers is not None:
                stack.callback(self._watchers.closed, self.info)
                self._watchers.opened(self.info)
            self._watch.open()
            stack.callback(self._watch.close)
            tasks = await stack.enter_async_context(Background())
            tasks.start_soon(self._logs.forget_expired, name=f"expiry of {self.action.name}")
            if self._keeper is not None:
                self._block = CancelScope()  # the store may fail at the first write
                tasks.start_soon(self._keeper.run, name=f"store of {self.action.name}")
                await stack.enter_async_context(self._keeper.open(self._recovery.claim))
            self._runs.open(tasks)  # its tasks wait for `stop`, so nothing may fail before that
            if self._dispatcher is not None:
                self._dispatcher.open(tasks)
            if self._keeper is not None:
                self._recovery.open(tasks)
                tasks.start_soon(self._room.run, name=f"room of {self.action.name}")
                stack.push_async_callback(self._stop_early)
                await self._recovery.recovered()
                if self._keeper.failure is not None:
                    raise copy_of(self._keeper.failure)
                self._logs.ended.notify()  # some outcomes may have been found that expire
                stack.enter_context(self._block)
            self._stack = stack.pop_all()
        self._phase = "running"
        self._room.open()
        self._started.notify()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, as `stop()` does. An exception of the block is raised as itself.

        Raises:
            StoreError: The store has failed, which has canceled the block.
        """
        try:
            # In a task of its own: asyncio can cancel this one itself, which no scope shields.
            with CancelScope(shield=True):
                async with create_task_group() as tasks:
                    tasks.start_soon(self.stop)
        finally:
            is_over = await self._stack.__aexit__(exc_type, exc, traceback)
        if self._keeper is not None and self._keeper.failure is not None and (is_over or not exc):
            raise copy_of(self._keeper.failure)

    async def _stop_early(self) -> None:
        """Stop a server whose start was canceled, or has failed: it may run goals already."""
        if self.is_new:
            self._phase = "running"
            with CancelScope(shield=True):
                await self.stop()
            self._started.notify()

    def _give_up(self) -> None:
        """Cancel the block, because the store has failed; `__aexit__` does the rest."""
        self._close()
        self._runs.abandon_ends()
        self._admission.wake()
        self._block.cancel()

    def _close(self) -> None:
        self._room.close()
        self._recovery.close()
        self._admission.close()
        self._callbacks.stop()

    async def drain(self, timeout: float = math.inf) -> None:
        """Reject new goals as busy, and wait until the active ones have ended, at most `timeout`
        seconds.

        Clients of a fleet then send their goals to other servers. The server goes on rejecting when
        this returns, also if it is canceled; `stop()` ends what is left.
        """
        if not self.is_running:
            return
        self._admission.drain()
        self._room.close()
        with anyio.move_on_after(timeout):
            if self._keeper is not None:
                await self._keeper.settled()  # what is accepted by then is active
            while self._runs.are_left:
                await self._logs.ended.wait()

    async def stop(self) -> None:
        """Reject new goals, end all active ones, and answer every client that waits.

        Executors are interrupted, and have `shutdown_timeout` seconds for their clean-up. Their
        goals end as ABORTED with the reason `server stopped`, or stay in the store: see `at_stop`.
        Stopping twice is harmless.

        Cancel scopes do not interrupt it; if asyncio cancels the task itself, the time for the
        clean-up is over at once. An executor that awaits `stop()` waits for itself, and is killed
        when the time is over.
        """
        if not self.is_running:
            return
        self._phase = "stopping"
        self._close()
        if self._dispatcher is not None:
            self._dispatcher.close()
        if self._at_stop == "keep":
            self._runs.keep_for(SERVER_STOPPED)
        shutdown = Shutdown(
            self._runs, self._logs.ended, self.action.name, SERVER_STOPPED, self._shutdown_timeout
        )
        try:
            try:
                await self._settle()  # what is accepted by then is among the goals to stop
            finally:  # asyncio can cancel the task itself
                await shutdown.run()
            await self._settle()
        finally:
            if self._keeper is not None:
                self._keeper.close()
                self._runs.let_go()
                self._admission.wake()
            self._logs.close()
            self._phase = "stopped"
            logger.info("action server %r has stopped", self.action.name)

    async def _settle(self) -> None:
        """Wait until all that was written is kept, for some seconds at most."""
        if self._keeper is not None:
            patience = max(self._shutdown_timeout, STORE_PATIENCE)
            with anyio.move_on_after(patience, shield=True):
                await self._keeper.settled()

    # The endpoint

    @property
    def info(self) -> ActionInfo:
        """The action that is served here."""
        return self.action.info

    async def wait_for_server(self) -> None:
        """Wait until this server runs."""
        while self.is_new:
            await self._started.wait()
        self._check_running()

    def offer_goal(
        self, request: GoalRequest
    ) -> FeedbackCursor | Coroutine[Any, Any, FeedbackCursor]:
        """See `Endpoint.offer_goal`; only an async `on_goal` makes it return a coroutine."""
        self._check_running()
        # A copy of the meta: the caller may change its own later.
        meta = None if request.meta is None else checked_meta(request.meta)
        return self._admission.offer(Offer(request, meta))

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> FeedbackCursor:
        """See `Endpoint.feedback`."""
        self._check_running()
        return self._logs.follow(goal_id, after=after, own=own, attempt=attempt)

    def owner_of(self, goal_id: GoalID) -> bytes:
        """See `Endpoint.owner_of`."""
        return self._logs.owner_of(goal_id)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """See `Endpoint.cancel_goals`."""
        self._check_running()
        answer = await self._cancels.cancel(goal_id, stamp)
        if self._watchers is not None:
            self._watchers.canceled(goal_id, answer)
        return answer

    async def status(self) -> StatusCursor:
        """See `Endpoint.status`."""
        self._check_running()
        if self._dispatcher is not None:
            self._dispatcher.note_places()
        return await self._logs.follow_statuses()

    def _check_running(self) -> None:
        if self._phase in ("running", "stopping"):
            return
        keeper = self._keeper
        if self._phase == "stopped" and keeper is not None and self._at_stop == "keep":
            raise GoalKept(GOAL_IS_KEPT)  # clients are to come back after the next start
        if keeper is not None and keeper.failure is not None:
            raise GoalKept(STORE_FAILED)
        raise ServerNotFound(f"the action server {self.action.name!r} is not running")

    def __repr__(self) -> str:
        return f"<ActionServer {self.action.name!r} {self._phase} goals={len(self._runs)}>"
