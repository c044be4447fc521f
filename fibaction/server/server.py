"""`ActionServer`: decides on goals, runs their executors, and tells everybody about it.

It is the shell around `GoalRegistry`, and adds what the protocol leaves out: tasks, time, user
callbacks and the log. It knows no transports: being an `Endpoint`, it is called by them.
"""

from __future__ import annotations

import inspect
import logging
import math
import time
from collections import deque
from collections.abc import Awaitable, Coroutine
from functools import partial
from types import TracebackType
from typing import Any, Generic, Literal, NamedTuple, Self
from weakref import WeakValueDictionary

import anyio
from anyio import create_task_group, current_time

from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.exceptions import (
    CancelRejected,
    GoalRejected,
    ProtocolError,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.goals import CancelAnswer, GoalID, GoalInfo
from fibaction.server._task_pool import Life, TaskPool
from fibaction.server.callbacks import SERVER_STOPPING, Callback, Callbacks
from fibaction.server.executor import Execution, Executor, GoalHandle
from fibaction.server.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.server.registry import Admission, Cancellation, Ending, EndKind, Goal, GoalRegistry
from fibaction.server.status_broadcast import StatusBroadcast, StatusSubscription
from fibaction.states import GoalStatus

EXPIRY_STEP = 0.1
"""Seconds between two looks for expired results at most: an answer is exact to the moment all the
same, this only limits how often memory is freed."""

RECENT_TIME, RECENT_GOALS = 1.0, 1000
"""Seconds that the feedback of a goal outlives it, while somebody follows the statuses, and of how
many goals at most: who has just learned of a goal asks for its feedback, and it may be over."""

SERVER_STOPPED = "server stopped"
CANCELED_UNASKED = "the executor ended as canceled, but nobody had asked for that"

logger = logging.getLogger("fibaction.server")


class _Offer(NamedTuple):
    """A goal that a client has sent."""

    goal_id: GoalID
    goal: bytes
    feedback: bool
    client: str


class _Run(Generic[GoalT, FeedbackT, ResultT]):
    """An active goal: what the protocol, the executor and the followers know of it."""

    __slots__ = ("execution", "goal", "log")

    def __init__(
        self, goal: Goal, log: FeedbackLog, execution: Execution[GoalT, FeedbackT, ResultT]
    ) -> None:
        self.goal = goal
        self.log = log
        self.execution = execution


class ActionServer(Endpoint, Generic[GoalT, FeedbackT, ResultT]):
    """One action, served: `async with` it, or hand it to `serve`.

    It can be entered once. User callbacks may be sync or async; whatever they raise becomes an
    answer to the client and a line in the log, never the end of the server.
    """

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        executor: Executor[GoalT, FeedbackT, ResultT],
        *,
        on_goal: Callback[GoalT] | None = None,
        on_cancel: Callback[GoalHandle[GoalT]] | None = None,
        interrupt_on_cancel: bool = True,
        feedback: Literal["every", "latest"] = "every",
        feedback_window: int = 64,
        stall_timeout: float = 10.0,
        result_timeout: float = 10.0,
        max_results: int = 1000,
        shutdown_timeout: float = 5.0,
    ) -> None:
        """Describe a server; nothing runs yet.

        Args:
            action: What is served.
            executor: An async generator function; called with a `GoalHandle` for each goal.
            on_goal: Called with each goal that is of the right type; raises `GoalRejected` to
                reject it. Without it, every such goal is accepted.
            on_cancel: Called when a goal's cancel is asked for; raises `CancelRejected` to refuse.
                Without it, every cancel is accepted.
            interrupt_on_cancel: Whether an accepted cancel raises the backend's cancellation inside
                the executor. If not, the executor looks at `goal.cancel_requested` by itself.
            feedback: `every`: nothing is lost, and the executor waits at its `yield` for the goal's
                own client. `latest`: it never waits, and a slow reader sees the newest.
            feedback_window: How many feedback messages of a goal are remembered: so many may be
                unread before the executor waits, or before a slow reader loses the oldest.
            stall_timeout: Seconds that the executor waits for a client which does not read.
            result_timeout: Seconds that an outcome is kept after the goal's end; 0 not at all,
                `math.inf` for ever. Whoever already waits for it gets it in any case.
            max_results: How many outcomes are kept at most; the oldest give way.
            shutdown_timeout: Seconds that executors have for their clean-up when the server stops.

        Raises:
            TypeError: The action has no types of its own, or the executor is not
                callable, a coroutine function, or a generator function that is not async.
            ValueError: A number is out of range, or `feedback` is no policy.
        """
        if object in action.feedback.classes:
            raise TypeError(f"{action!r} has no types, and a server needs them; define an Action")
        _check_is_executor(executor)
        if feedback not in ("every", "latest"):
            raise ValueError(f"feedback is 'every' or 'latest', not {feedback!r}")
        if feedback_window < 1:
            raise ValueError(f"feedback_window is at least 1, not {feedback_window}")
        for name, value in (
            ("stall_timeout", stall_timeout),
            ("result_timeout", result_timeout),
            ("max_results", max_results),
            ("shutdown_timeout", shutdown_timeout),
        ):
            if not value >= 0:
                raise ValueError(f"{name} is 0 or more, not {value}")
        self.action = action
        self._executor = executor
        self._on_goal = on_goal
        self._on_cancel = on_cancel
        self._interrupt_on_cancel = interrupt_on_cancel
        self._latest = feedback == "latest"
        self._window = feedback_window
        self._stall_timeout = stall_timeout
        self._shutdown_timeout = shutdown_timeout

        self._protocol = GoalRegistry(result_timeout=result_timeout, max_results=max_results)
        self._runs: dict[GoalID, _Run[GoalT, FeedbackT, ResultT]] = {}
        self._unread: WeakValueDictionary[GoalID, FeedbackLog] = WeakValueDictionary()
        self._recent: deque[tuple[float, FeedbackLog]] = deque(maxlen=RECENT_GOALS)
        self._statuses = StatusBroadcast()
        self._callbacks = Callbacks(action.name)
        self._started = Notifier()
        self._decided = Notifier()
        self._ended = Notifier()
        self._background: Background
        self._crew: TaskPool
        self._phase: Literal["new", "running", "stopping", "stopped"] = "new"
        self._is_stopping = self._stops  # made once, and not for each goal

    # Running

    @property
    def is_new(self) -> bool:
        """Whether the server has yet to be entered."""
        return self._phase == "new"

    @property
    def is_running(self) -> bool:
        """Whether it takes goals: it was entered, and has not begun to stop."""
        return self._phase == "running"

    async def __aenter__(self) -> Self:
        """Start.

        Raises:
            RuntimeError: It was started before.
        """
        if not self.is_new:
            raise RuntimeError(f"{self!r} was started before; make another one")
        self._background = Background()
        tasks = await self._background.__aenter__()
        tasks.start_soon(self._forget_expired, name=f"expiry of {self.action.name}")
        self._crew = TaskPool(tasks, f"goal of {self.action.name}")
        self._phase = "running"
        self._started.notify()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, as `stop()` does. An exception of the block goes on as itself."""
        try:
            # In a task of its own: asyncio can cancel this one itself, which no scope shields.
            with anyio.CancelScope(shield=True):
                async with create_task_group() as tasks:
                    tasks.start_soon(self.stop)
        finally:
            await self._background.__aexit__(exc_type, exc, traceback)

    async def stop(self) -> None:
        """Accept no more goals, end all that there are, and answer everybody who waits.

        Executors are interrupted, and have `shutdown_timeout` seconds for their clean-up. Their
        goals end ABORTED, `server stopped`. No scope can cut it short; if asyncio cancels the task
        itself while it stops, that time is over at once. Doing it twice is harmless. An executor
        that waits for it waits for itself, and is ended when that time is over.
        """
        if not self.is_running:
            return
        self._phase = "stopping"
        self._callbacks.stop()
        for run in self._runs.values():
            run.execution.interrupt()
        try:
            with anyio.move_on_after(self._shutdown_timeout, shield=True):
                while self._runs:
                    await self._ended.wait()
        finally:
            self._end_all()

    def _end_all(self) -> None:
        """The time to stop is over: nothing is left to run, and nobody to wait."""
        for run in tuple(self._runs.values()):
            logger.warning(
                "goal %s of action %r did not stop in time (%g s), and is killed",
                run.goal.goal_id,
                self.action.name,
                self._shutdown_timeout,
            )
            self._finish(run, Ending(EndKind.FAILED, reason=SERVER_STOPPED))
            run.execution.kill()
        self._phase = "stopped"
        self._crew.close()
        self._statuses.finish()
        logger.info("action server %r has stopped", self.action.name)

    async def _forget_expired(self) -> None:
        while True:
            while (next_expiry := self._next_expiry()) == math.inf:
                await self._ended.wait()
            now = current_time()
            # What ends from now on may have to go before what has ended: its feedback.
            sooner = min(next_expiry, now + RECENT_TIME)
            await anyio.sleep_until(max(sooner, now + EXPIRY_STEP))
            self._expire(current_time())

    def _next_expiry(self) -> float:
        recent = self._recent[0][0] if self._recent else math.inf
        return min(recent, self._protocol.next_expiry)

    def _expire(self, now: float) -> None:
        while self._recent and self._recent[0][0] <= now:
            self._recent.popleft()
        for goal_id in self._protocol.expire(now):
            if self._statuses:
                self._statuses.publish(GoalInfo(goal_id, 0, GoalStatus.UNKNOWN))

    # What clients ask for

    @property
    def info(self) -> ActionInfo:
        """What is served here."""
        return self.action.info

    async def wait_for_server(self) -> None:
        """Return as soon as this server runs."""
        while self.is_new:
            await self._started.wait()
        self._check_running()

    async def send_goal(
        self, goal_id: GoalID, goal: bytes, *, feedback: bool = True
    ) -> FeedbackCursor:
        """See `Endpoint.send_goal`."""
        offered = self.offer_goal(goal_id, goal, feedback=feedback)
        return offered if isinstance(offered, FeedbackCursor) else await offered

    def offer_goal(
        self, goal_id: GoalID, goal: bytes, *, feedback: bool = True, client: str = ""
    ) -> FeedbackCursor | Coroutine[Any, Any, FeedbackCursor]:
        """See `Endpoint.offer_goal`. Only an async `on_goal` has to be waited for."""
        offer = _Offer(goal_id, goal, feedback, client)
        todo = self._admit(goal_id, goal)
        if todo is Admission.WAIT:
            return self._offer_again(offer)
        if todo is Admission.REPEAT:
            return self._follow(goal_id, feedback=feedback, own=feedback, after=0)
        try:
            request = self._decode(goal)
            if self._on_goal is not None:
                asking = self._callbacks.ask("on_goal", self._on_goal, request, GoalRejected)
                if asking is not None:
                    return self._accept_later(offer, request, asking)
            return self._accept(offer, request)
        except GoalRejected as exc:
            raise self._reject(goal_id, exc.reason) from None
        except BaseException:
            self._withdraw(goal_id)
            raise

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False
    ) -> FeedbackCursor:
        """See `Endpoint.feedback`."""
        self._check_running()
        return self._follow(goal_id, after=after, own=own)

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """See `Endpoint.cancel_goals`."""
        self._check_running()
        while goal_id is not None and self._protocol.is_undecided(goal_id):
            await self._decided.wait()
        cancellation = self._protocol.cancel(goal_id, stamp, now=current_time())
        if self._on_cancel is None or len(cancellation.candidates) < 2:
            for goal in cancellation.candidates:
                await self._cancel(cancellation, goal)
        else:
            # Side by side: one goal whose callback takes long must not keep the others going.
            async with create_task_group() as tasks:
                for goal in cancellation.candidates:
                    tasks.start_soon(self._cancel, cancellation, goal)
        return cancellation.answer()

    async def status(self) -> StatusSubscription:
        """See `Endpoint.status`."""
        self._check_running()
        self._expire(current_time())
        return self._statuses.follow(self._protocol.statuses())

    def _check_running(self) -> None:
        if self._phase not in ("running", "stopping"):
            raise ServerNotFound(f"the action server {self.action.name!r} is not running")

    # A goal's way

    def _admit(self, goal_id: GoalID, goal: bytes) -> Admission:
        self._check_running()
        if self._phase == "stopping":
            raise GoalRejected(SERVER_STOPPING, goal_id=goal_id)
        return self._protocol.admit(goal_id, goal, now=current_time())

    async def _offer_again(self, offer: _Offer) -> FeedbackCursor:
        while self._protocol.is_undecided(offer.goal_id):
            await self._decided.wait()
        goal_id, goal, feedback, client = offer
        offered = self.offer_goal(goal_id, goal, feedback=feedback, client=client)
        return offered if isinstance(offered, FeedbackCursor) else await offered

    async def _accept_later(
        self, offer: _Offer, request: GoalT, asking: Awaitable[None]
    ) -> FeedbackCursor:
        try:
            await asking
            return self._accept(offer, request)
        except GoalRejected as exc:
            raise self._reject(offer.goal_id, exc.reason) from None
        except BaseException:
            self._withdraw(offer.goal_id)
            raise

    def _reject(self, goal_id: GoalID, reason: str) -> GoalRejected:
        """A goal is not accepted. Gives what to raise."""
        self._protocol.reject(goal_id, reason, now=current_time())
        self._decided.notify()
        logger.info("goal %s of action %r: rejected: %s", goal_id, self.action.name, reason)
        return GoalRejected(reason, goal_id=goal_id)

    def _withdraw(self, goal_id: GoalID) -> None:
        """Canceled while deciding: if the goal is sent again, it is decided anew."""
        self._protocol.withdraw(goal_id)
        self._decided.notify()

    def _decode(self, goal: bytes) -> GoalT:
        try:
            return self.action.goal.decode(goal)
        except ProtocolError as exc:
            raise GoalRejected(str(exc)) from exc

    def _accept(self, offer: _Offer, request: GoalT) -> FeedbackCursor:
        if self._stops():
            raise GoalRejected(SERVER_STOPPING)
        goal_id = offer.goal_id
        goal = self._protocol.accept(goal_id, stamp=time.time_ns(), client=offer.client)
        self._decided.notify()
        log = FeedbackLog(goal, window=self._window, latest=self._latest)
        handle = GoalHandle(goal, request, self._is_stopping)
        execution = Execution(self.action, self._executor, handle, log, self._stall_timeout)
        run = self._runs[goal_id] = _Run(goal, log, execution)
        self._tell_status(run)
        self._crew.add(partial(self._run_goal, run))
        return log.follow(feedback=offer.feedback, hold=offer.feedback)

    async def _run_goal(self, run: _Run[GoalT, FeedbackT, ResultT], life: Life) -> None:
        try:
            if run.execution.handle.cancel_requested:
                ending = Ending(EndKind.CANCELED)
            else:
                self._execute(run)
                ending = await run.execution.run(life)
        except BaseException as exc:
            # Python itself is to end: KeyboardInterrupt, SystemExit.
            self._finish(run, Ending(EndKind.FAILED, reason=type(exc).__name__))
            raise
        if run.goal.outcome is None:  # or it was given up as killed
            self._finish(run, ending)

    def _stops(self) -> bool:
        return not self.is_running

    def _execute(self, run: _Run[GoalT, FeedbackT, ResultT]) -> None:
        self._protocol.execute(run.goal)
        self._tell_status(run)

    def _tell_status(self, run: _Run[GoalT, FeedbackT, ResultT]) -> None:
        run.log.tell_status()
        if self._statuses:
            self._statuses.publish(run.goal.info)

    async def _cancel(self, cancellation: Cancellation, goal: Goal) -> None:
        if not goal.status.is_active:
            return  # it has ended since it was chosen
        if self._on_cancel is not None and goal.status is not GoalStatus.CANCELING:
            handle = self._runs[goal.goal_id].execution.handle
            try:
                asking = self._callbacks.ask("on_cancel", self._on_cancel, handle, CancelRejected)
                if asking is not None:
                    await asking
            except CancelRejected as exc:
                cancellation.refuse(exc.reason)
                return
        before = goal.status
        if cancellation.accept(goal) and goal.status is not before:
            run = self._runs[goal.goal_id]
            self._tell_status(run)
            if self._interrupt_on_cancel:
                run.execution.interrupt()

    def _finish(self, run: _Run[GoalT, FeedbackT, ResultT], ending: Ending) -> None:
        goal = run.goal
        if goal.status is GoalStatus.ACCEPTED:
            self._execute(run)  # the table has no way from ACCEPTED to an end
        if ending.kind is EndKind.CANCELED and goal.status is GoalStatus.EXECUTING:
            unasked = ending.reason or CANCELED_UNASKED
            reason = SERVER_STOPPED if self._phase == "stopping" else unasked
            ending = Ending(EndKind.CANCELED, ending.result, reason)
        now = current_time()
        self._protocol.finish(goal, ending, now=now)
        del self._runs[goal.goal_id]
        if self._statuses:
            self._recent.append((now + RECENT_TIME, run.log))
        if self._statuses or run.log.is_followed:
            self._unread[goal.goal_id] = run.log
        self._tell_status(run)
        run.log.finish()
        self._expire(now)
        self._ended.notify()

    def _follow(
        self, goal_id: GoalID, *, feedback: bool = True, own: bool, after: int | None
    ) -> FeedbackCursor:
        goal = self._protocol.find(goal_id, now=current_time())
        if goal is None:
            raise UnknownGoal(goal_id)
        run = self._runs.get(goal_id)
        log = self._unread.get(goal_id) if run is None else run.log
        if log is None:  # nobody has its feedback any more
            log = FeedbackLog(goal)
        return log.follow(feedback=feedback, hold=own, after=after)

    def __repr__(self) -> str:
        return f"<ActionServer {self.action.name!r} {self._phase} goals={len(self._runs)}>"


def _check_is_executor(executor: object) -> None:
    """See at once, and not at the first goal, that a keyword was forgotten.

    What cannot be known before it is called, such as what a lambda returns, is left to the goal.
    """
    while isinstance(executor, partial):
        executor = executor.func
    if not callable(executor):
        raise TypeError(f"the executor is an async generator function, and not {executor!r}")
    name = getattr(executor, "__name__", type(executor).__name__)
    for function in (executor, executor.__call__):
        if inspect.iscoroutinefunction(function):
            raise TypeError(
                f"the executor {name!r} is a coroutine function: yield its feedback, and yield its"
                f" result last, instead of returning it"
            )
        if inspect.isgeneratorfunction(function):
            raise TypeError(
                f"the executor {name!r} is a generator function that is not async: write"
                f" `async def`, and await what takes time"
            )
