"""`ActionServer`: the life of an action server, and its methods for clients.

Theory of operation
-------------------

A server is *new* until it is entered, then *running*, *stopping* and *stopped*; it runs once. Until
it starts, `serve` and transports may give it a store and watchers. Whatever a wrong argument would
break is made in the constructor; the parts that do the work are made at the start (see `parts`),
when everything is known.

The server does not depend on transports: they call it as an `Endpoint`, and so do clients in the
same process. Each of these methods checks that the server runs, and calls one part.

A store that fails cancels the block of `async with`; the error is raised at its end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Iterable, Sized
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Generic, Literal, Self, Unpack

from anyio import CancelScope, create_task_group

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Endpoint, GoalRequest, LogLine
from fibaction.border.goal_store import GoalStore
from fibaction.border.urls import check_settings
from fibaction.border.watchers import Watcher
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.feeds.status_broadcast import StatusCursor
from fibaction.server.admission.callbacks import GoalCallbacks
from fibaction.server.durability.goal_keeper import GoalKeeper
from fibaction.server.durability.keeper import ADD_A_STORE, GOAL_IS_KEPT, STORE_FAILED, Keeper
from fibaction.server.execution.executor import Executor
from fibaction.server.functions.executor_check import (
    check_is_executor,
    check_is_served,
    executor_of,
    runner_of,
)
from fibaction.server.parts import Parts
from fibaction.server.registry.goal_record import Offer
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.server.settings import ActionServerKeywords, ActionServerSettings, check_is_store
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.words.errors import GoalKept, ServerNotFound, TransportError, copy_of
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo
from fibaction.words.intake import Intake, IntakeChange
from fibaction.words.meta import checked_meta

logger = clean_logger("fibaction.server")


class ActionServer(Endpoint, Generic[GoalT, FeedbackT, ResultT]):
    """A server of one action, to be entered with `async with`, or given to `serve`.

    It can be entered once. User callbacks may be sync or async. An exception of a callback becomes
    an answer to the client and a line in the log, and the server continues.

    For example:

        async with serve(ActionServer(DRIVE, drive), "tcp://127.0.0.1:7400"):
            await anyio.sleep_forever()
    """

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT] | None = None,
        **settings: Unpack[ActionServerKeywords[GoalT]],
    ) -> None:
        """Set up a server; nothing runs yet.

        Args:
            action: The action that is served.
            executor: An async generator function, called with a `GoalHandle` for each goal; None
                for the function from which `@action` made the action.
            settings: Keyword arguments, each of them optional: see `ActionServerSettings`.

        Raises:
            TypeError: The action is untyped, or the executor is missing, is not callable, is a
                coroutine function, or is a generator function that is not async; `on_goal` takes
                neither one argument nor two; the schedule is not a `Schedule`; a watcher is not a
                `Watcher`; or there is no such setting.
            ValueError: A number is out of range; or `feedback`, `recovery`, `unreadable` or
                `at_stop` is not one of its words.
        """
        check_is_served(action)
        if executor is None:
            executor = executor_of(action)
        check_is_executor(executor)
        self.action = action
        self._runner = runner_of(executor)
        check_settings("ActionServer", settings, ActionServerSettings.__struct_fields__)
        self._settings = ActionServerSettings(**settings)
        self._callbacks = GoalCallbacks(action.name, self._settings)
        schedule, kill_after = self._settings.schedule, self._settings.shutdown_timeout
        self._dispatcher: Dispatcher[GoalT] = Dispatcher()
        if schedule is not None:
            self._dispatcher = GoalDispatcher(schedule, action=action.name, kill_after=kill_after)
        self._watchers = Watchers(action.name, self._settings.watchers)
        self._parts: Parts[GoalT, FeedbackT, ResultT]
        self._goals: Sized = ()
        self._started = Notifier()
        self._stack: AsyncExitStack
        self._phase: Literal["new", "running", "stopping", "stopped"] = "new"
        self._is_held = False
        self.store: GoalStore | None = self._settings.store
        """The store that keeps the goals of this server; None if none does."""

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
        if not self.is_new or self.store is not None:
            state = "was started before" if self.store is None else "has a store"
            raise RuntimeError(f"{self!r} {state}; give the store to another one")
        check_is_store(store)
        self.store = store

    def watch_by(self, watchers: Iterable[Watcher]) -> None:
        """Add watchers to those that the server has, as with the argument `watchers`.

        Raises:
            RuntimeError: The server was started before.
            TypeError: One of them is not a `Watcher`, or has an async method.
        """
        members = tuple(watchers)
        if members and not self.is_new:
            raise RuntimeError(f"{self!r} was started before; give the watchers to another one")
        self._watchers = Watchers(self.action.name, (*self._watchers.members, *members))

    def hold_executors(self) -> None:
        """Run no executor before `start_executors` is called: an executor of a goal that the store
        has may need a client of this very server. To be called before the server is entered.
        """
        self._is_held = True

    def start_executors(self) -> None:
        """Run the executors that were held back: clients can reach the server now."""
        self._parts.runs.start()

    async def __aenter__(self) -> Self:
        """Start the server. With a store, take over its goals before anything else.

        Raises:
            RuntimeError: It was started before, or a server in another thread has its schedule.
            ValueError: Goals are to be kept at a stop, and there is no store; servers that share a
                schedule have not the same `shutdown_timeout`; or the schedule has a `fleet_limit`,
                and there is no fleet.
            StoreError: The store cannot be used, or has goals that cannot be read.
        """
        if not self.is_new:
            raise RuntimeError(f"{self!r} was started before; make another one")
        keeper = self._make_keeper()
        self._parts = parts = Parts(
            self.action,
            self._runner,
            self._settings,
            keeper,
            self._dispatcher,
            self._watchers,
            self._callbacks,
        )
        self._goals = parts.runs
        async with AsyncExitStack() as stack:
            stack.callback(self._watchers.closed, self.info)
            self._watchers.opened(self.info)
            await parts.open(stack, held=self._is_held)
            stack.push_async_callback(self._stop_early)
            await parts.recover()
            stack.enter_context(keeper.block)
            self._stack = stack.pop_all()
        self._phase = "running"
        parts.capacity.open()
        self._started.notify()
        return self

    def _make_keeper(self) -> Keeper:
        """Make the keeper of the server's goals.

        Raises:
            ValueError: Goals are to be kept at a stop, and there is no store.
        """
        settings, action = self._settings, self.action
        if self.store is not None:
            return GoalKeeper(
                self.store,
                action.name,
                action.checkpoint,
                result_timeout=settings.result_timeout,
                given_up_timeout=settings.given_up_timeout,
                max_results=settings.max_results,
            )
        if settings.at_stop == "keep":
            raise ValueError(f"{self!r} has at_stop='keep', which needs a store")
        if settings.recovery != "abort":
            logger.warning(
                "action server %r has no store, so its `recovery` has no effect: %s",
                action.name,
                ADD_A_STORE,
            )
        return Keeper(action.name, action.checkpoint)

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
        failure = self._parts.keeper.failure
        if failure is not None and (is_over or not exc):
            raise copy_of(failure)

    async def _stop_early(self) -> None:
        """Stop a server whose start was canceled, or has failed: it may run goals already."""
        if self.is_new:
            self._phase = "running"
            with CancelScope(shield=True):
                await self.stop()
            self._started.notify()

    async def drain(
        self, timeout: float = math.inf, *, together: Iterable[ActionServer[Any, Any, Any]] = ()
    ) -> None:
        """Reject new goals as busy, and wait until the active ones have ended, at most `timeout`
        seconds. The steps of active ones are still accepted: of this server's, and of those
        of the servers that drain `together` with it. Goals that have not begun, since the action is
        paused, are not waited for.

        Clients of a fleet then send their goals to other servers. The server keeps rejecting when
        this returns, even if it is canceled; `stop()` ends what is left.
        """
        if self.is_running:
            registries = [one._parts.registry for one in together if one.is_running]
            await self._parts.drain(timeout, registries)

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
        try:
            await self._parts.stop()
        finally:
            self._phase = "stopped"
            logger.info("action server %r has stopped", self.action.name)

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
        meta = None if request.meta is None else checked_meta(request.meta)
        return self._parts.admission.offer(Offer(request, meta))

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
        return await self._parts.past.follow(goal_id, after=after, own=own, attempt=attempt)

    def owner_of(self, goal_id: GoalID) -> bytes:
        """See `Endpoint.owner_of`."""
        return self._parts.logs.owner_of(goal_id)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """See `Endpoint.cancel_goals`."""
        self._check_running()
        answer = await self._parts.cancels.cancel(goal_id, stamp)
        self._watchers.canceled(goal_id, answer)
        return answer

    async def status(self) -> StatusCursor:
        """See `Endpoint.status`."""
        self._check_running()
        self._dispatcher.note_positions()
        return await self._parts.logs.follow_statuses()

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        """See `Endpoint.past_goals`."""
        self._check_running()
        return await self._parts.past.page(page)

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """See `Endpoint.read_past`."""
        self._check_running()
        await self._parts.past.read(wanted, take)

    async def intake(self) -> Intake:
        """See `Endpoint.intake`."""
        self._check_running()
        return await self._parts.levers.look()

    async def change_intake(self, change: IntakeChange) -> Intake:
        """See `Endpoint.change_intake`."""
        self._check_running()
        if change.worker:
            raise TransportError(f"action {self.action.name!r} has no workers: it is not a fleet's")
        return await self._parts.levers.change(change)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        """See `Endpoint.rerun`."""
        self._check_running()
        return await self._parts.past.rerun(goal_id)

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        """See `Endpoint.log_lines`."""
        self._check_running()
        return self._parts.log_keeper.of(goal_id)

    def _check_running(self) -> None:
        if self._phase in ("running", "stopping"):
            return
        if self._phase == "stopped":
            if self._settings.at_stop == "keep":
                raise GoalKept(GOAL_IS_KEPT)  # clients are to come back after the next start
            if self._parts.keeper.failure is not None:
                raise GoalKept(STORE_FAILED)
        raise ServerNotFound(f"the action server {self.action.name!r} is not running")

    def __repr__(self) -> str:
        return f"<ActionServer {self.action.name!r} {self._phase} goals={len(self._goals)}>"
