"""Cancels what an executor awaits, exactly once.

Theory of operation
-------------------

anyio and trio cancel by level: once a scope is canceled, every `await` in it raises. An executor
that catches the cancellation to clean up could then await nothing. So here a cancellation is an
edge: the first `await` raises, and the clean-up that follows may await without limits, until it is
killed.

Two parts do this together. `CancelOnce` has two scopes. The outer one belongs to the task:
canceling it delivers the cancellation. The inner one, `rest`, can shield its content from the outer
one. It shields from the beginning, since a task of the pool is used for one goal after another;
`interrupt()` removes the shield and cancels the outer scope, and `kill()` does so for good.

`Stepper` drives the executor's coroutine step by step, in place of the task. So it sees the
cancellation arrive (`throw`, or trio's `outcome.Error` in `send`). If the coroutine waits after
that, it is in its clean-up, and the shield is set again. `Stepper` also sets the time by which the
coroutine should have waited (`slice_end`), since executors that never wait must let other tasks
run.

A server may be cut off from a store that it shares, or frozen. Then its goals may run elsewhere,
and `fence` interrupts the coroutine, and says that it may not continue. `Stepper` lets the task
wait for that cancellation in place of the step (`_detour`). Only a coroutine that shields itself
continues.

Code of anyio and trio expects a cancellation by level: the exit of `anyio.abc.Process`, for
example, waits for its process, and kills it when it is canceled again. So while the coroutine waits
in such an exit, which its cancellation passes, the shield is open, and each `await` there is
canceled (`leaves_by_level`). When the executor's own code waits, the shield is set again.

Inside a task group of the executor's own, the backend's rule holds: the group is canceled with all
its tasks, and clean-up there needs a shield of its own. On trio, a nursery that is open around
clean-up absorbs the cancellation.

An executor may survive being killed: it catches each cancellation and awaits again, or it waits
where no cancellation arrives. Since `Stepper` drives the coroutine, it can stop doing so: it
abandons the coroutine after MOST_KILLS cancellations, or when `CancelOnce.abandon()` is called. To
the task, the coroutine has then returned (see `executor_ends`).

That may leave scopes of the coroutine open, for which asyncio and trio end the task's group.
So it is done at the end of a server only (`DOOMED`). Before that, a coroutine that survives
MOST_KILLS cancellations is spared: it keeps running, and gets no further one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Generator
from contextvars import Context
from enum import IntEnum
from gc import get_referents
from time import perf_counter
from types import FrameType, TracebackType
from typing import Any, Generic, TypeVar

from anyio import CancelScope, TaskHandle, current_effective_deadline, get_cancelled_exc_class
from anyio.lowlevel import checkpoint

from fibaction.server.execution.executor_ends import MOST_KILLS, AbandonedCoroutine, keep_for_ever
from fibaction.server.execution.turns import Turns

T = TypeVar("T")
BY_LEVEL = ("anyio", "trio")
"""The packages whose code expects that each `await` is canceled until its scope is left."""
BENEATH = (*BY_LEVEL, "asyncio", "contextlib")
"""The packages in whose code that of the first ones waits."""
_KINDS = (("cr_frame", "cr_await"), ("ag_frame", "ag_await"), ("gi_frame", "gi_yieldfrom"))
"""The attributes of what can wait: its frame, and what it awaits."""


class ScopesPhase(IntEnum):
    """A phase of the scopes of executors, in the order in which they come. Scopes are used for one
    executor after another, until one of them is interrupted.
    """

    USABLE = 0
    SPENT = 1
    """A cancellation was delivered in them, or to their task."""
    KILLED = 2
    """Every `await` is canceled; an executor that survives it is spared."""
    DOOMED = 3
    """Every `await` is canceled; an executor that survives it is abandoned."""
    ABANDONED = 4
    """An executor was given up inside, whose own scopes are still open."""


class CancelOnce:
    """The two scopes around an executor, which cancel it once, and kill it later."""

    __slots__ = (
        "_task",
        "on_wait",
        "phase",
        "rest",
        "steps",
        "turns",
        "wake",
    )

    def __init__(self, on_wait: Callable[[], None], turns: Turns | None = None) -> None:
        self.turns = turns or Turns()
        """The turns of all executors of the server that do not wait."""
        self._task: TaskHandle[None] | CancelScope | None = None
        self.rest = CancelScope(shield=True)
        self.phase = ScopesPhase.USABLE
        """The phase of the scopes; no other job can run in them unless they are usable."""
        self.on_wait = on_wait
        """The function that is called when the coroutine inside begins to wait."""
        self.steps: Stepper[Any] | None = None
        """The coroutine that runs in these scopes now; None if none does."""
        self.wake: Callable[[], object] | None = None
        """The function that ends a wait of the task even if scopes shield it; None if none can."""

    def run_by(self, task: TaskHandle[None] | CancelScope) -> None:
        """Set the task, or the outer scope, in which `rest` is entered.

        `rest` may have been entered already, since an eager task begins before its handle is known.
        """
        self._task = task
        if not self.rest.shield:
            task.cancel()

    def interrupt(self) -> None:
        """Deliver a cancellation."""
        self.reach(ScopesPhase.SPENT)
        self.rest.shield = False
        if self._task is not None:
            self._task.cancel()

    def kill(self, *, for_good: bool = True) -> None:
        """Cancel every `await` from now on; abandon a coroutine that survives it, if `for_good`."""
        self.reach(ScopesPhase.DOOMED if for_good else ScopesPhase.KILLED)
        self.interrupt()

    def spare(self) -> None:
        """Cancel nothing more, until `kill` is called again."""
        self.phase = ScopesPhase.SPENT
        self.rest.shield = True

    def reach(self, phase: ScopesPhase) -> None:
        """Note that the scopes are at least in this phase."""
        self.phase = max(self.phase, phase)

    def abandon(self) -> None:
        """Give up the coroutine inside, and end the wait of its task, if anything can."""
        if self.steps is not None:
            self.steps.abandon()
            if self.wake is not None:
                self.wake()


class Current:
    """The coroutine of a thread whose step runs now; the watchdog reads it from another thread."""

    __slots__ = ("steps",)

    def __init__(self) -> None:
        self.steps: Stepper[Any] | None = None


class Stepper(Generator[Any, Any, T], Generic[T]):
    """A coroutine that is awaited step by step: see the theory of operation above."""

    __slots__ = (
        "_arrived",
        "_by_level",
        "_by_outcome",
        "_context",
        "_coroutine",
        "_current",
        "_delayed",
        "_detour",
        "_kills",
        "_on_abandoned",
        "_on_spared",
        "_passes",
        "_scopes",
        "fence",
        "pending",
        "slice_end",
    )

    def __init__(
        self,
        coroutine: Coroutine[Any, Any, T],
        scopes: CancelOnce,
        context: Context,
        on_abandoned: Callable[[], T],
        on_spared: Callable[[], None] = lambda: None,
        current: Current | None = None,
    ) -> None:
        """Prepare to await the coroutine. `on_abandoned` is called if it is abandoned, and returns
        a value in place of the coroutine's; `on_spared` is called if it is spared. `current` has
        this object while a step runs.
        """
        self.pending = False
        """True if a cancellation was sent and has not arrived."""
        self._coroutine: Coroutine[Any, Any, T] | AbandonedCoroutine[T] = coroutine
        self._scopes = scopes
        self._context = context
        self._on_abandoned = on_abandoned
        self._on_spared = on_spared
        self._current = current or Current()
        self._arrived = False
        self._passes = False  # true until a scope of the coroutine's own is canceled
        self._by_level = False
        self._by_outcome = False
        self._kills = 0
        self.fence: Callable[[], bool] | None = None
        """The function that interrupts the coroutine, and returns True, if it may not continue."""
        self._detour: Coroutine[Any, Any, None] | None = None
        self._delayed: Any = None  # the value of the step that is not taken
        self.slice_end = 0.0
        """The time from which the coroutine lets others run, by `perf_counter`."""
        scopes.steps = self

    def interrupt(self) -> None:
        """Cancel the coroutine, once."""
        self.pending = True
        self._scopes.interrupt()

    def abandon(self) -> None:
        """Never resume the coroutine again; the next step ends the wait for it."""
        scopes = self._scopes
        if scopes.phase is ScopesPhase.ABANDONED:
            return  # its last cancellation arrives after its time was over
        keep_for_ever(self._coroutine)
        scopes.steps = None
        scopes.reach(ScopesPhase.ABANDONED)
        scopes.rest.shield = True  # or tasks that the coroutine has started were canceled forever
        self._coroutine = AbandonedCoroutine(self._on_abandoned())

    def __await__(self) -> Generator[Any, Any, T]:
        return self

    def __next__(self) -> Any:
        return self.send(None)

    def send(self, value: Any) -> Any:
        if value is not None:
            # trio resumes a task with an `outcome.Error`, and raises its exception further inside.
            self._by_outcome = True
            self._note_arrival(getattr(value, "error", None))
        if self.fence is not None and (self._detour is not None or self.fence()):
            try:
                return self._wait_instead(value)
            except StopIteration:  # the coroutine shields itself
                value, self._delayed = self._delayed, None
                self._detour = self.fence = None
        current = self._current
        outer = current.steps  # an eager task begins in the step of another one
        # Before the watchdog can see this step.
        self.slice_end = perf_counter() + self._scopes.turns.slice
        current.steps = self
        try:
            return self._suspend(self._context.run(self._coroutine.send, value))
        finally:
            current.steps = outer
            del value  # see `throw`

    def throw(
        self,
        typ: type[BaseException] | BaseException,
        val: BaseException | object = None,
        tb: TracebackType | None = None,
    ) -> Any:
        # With one argument it is the exception itself; the other two are deprecated.
        assert isinstance(typ, BaseException)
        self._note_arrival(typ)
        current = self._current
        outer = current.steps
        self.slice_end = perf_counter() + self._scopes.turns.slice
        current.steps = self
        # A new cancellation, as of the task itself: a scope inside would absorb anyio's as its own.
        error = type(typ)() if self._arrived or self._by_level else typ
        try:
            return self._suspend(self._context.run(self._coroutine.throw, error))
        finally:
            current.steps = outer
            # The exception references the frames it passes, and those this one, since Python 3.12.
            del typ, error

    def arrive(self) -> None:
        """Let the cancellation arrive as an error of the caller: what follows is clean-up, whose
        `await`s are not canceled before the coroutine is killed.
        """
        self.pending, self.fence = False, None
        if self._scopes.phase < ScopesPhase.KILLED:
            self._scopes.rest.shield = True

    def _wait_instead(self, value: Any) -> Any:
        """Let the task wait for the cancellation, in place of a step.

        Raises:
            StopIteration: None arrives.
        """
        if self._detour is None:
            self._detour, self._delayed, value = checkpoint(), value, None
        return self._detour.send(value)

    def close(self) -> None:
        self._coroutine.close()

    def _note_arrival(self, error: BaseException | None) -> None:
        """Note that the cancellation has arrived, if the error is one; count those that kill."""
        if isinstance(error, get_cancelled_exc_class()):
            if self.pending:
                self.pending = False
                self._arrived = self._passes = True
                self.fence = None  # what follows is clean-up
                if self._detour is not None:
                    self._detour.close()
                    self._detour = self._delayed = None
            elif self._scopes.phase >= ScopesPhase.KILLED:
                self._kills += 1
                if self._kills > MOST_KILLS:
                    self._survive()
            elif not (self._arrived or self._by_level):
                self._passes = False

    def _survive(self) -> None:
        if self._scopes.phase >= ScopesPhase.DOOMED:
            self.abandon()
        else:
            self._kills = 0
            self._scopes.spare()
            self._on_spared()

    def _suspend(self, waiting_for: Any) -> Any:
        self._scopes.on_wait()
        if self._passes and self._scopes.phase < ScopesPhase.KILLED:
            rest = self._scopes.rest
            rest.shield = True
            self._arrived = self._arrived and self._by_outcome and self._is_unwinding()
            self._by_level = leaves_by_level(self._coroutine)
            rest.shield = not (self._arrived or self._by_level)
        return waiting_for

    def _is_unwinding(self) -> bool:
        """Return whether the coroutine most likely waits in a nursery that the cancellation passes.

        Such a nursery must see that the cancellation comes from outside, or it would absorb it.
        """
        return current_effective_deadline() == -math.inf


def leaves_by_level(coroutine: Any) -> bool:
    """Return whether the coroutine waits in the `__aexit__` of a resource of `BY_LEVEL` that its
    cancellation passes, and not in other code which that calls.
    """
    canceled, leaves = get_cancelled_exc_class(), False
    for frame in _frames_of(coroutine):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package not in BENEATH:
            leaves = False
        elif package in BY_LEVEL and frame.f_code.co_name == "__aexit__":
            leaves = leaves or any(isinstance(one, canceled) for one in frame.f_locals.values())
    return leaves


def _frames_of(awaited: Any) -> Generator[FrameType, None, None]:
    """Yield the frames of a coroutine that waits, from the outermost one."""
    while awaited is not None:
        kind = next((one for one in _KINDS if hasattr(awaited, one[0])), None)
        if kind is not None:
            yield getattr(awaited, kind[0])
            awaited = getattr(awaited, kind[1])
        else:  # a step of an async generator names it to the garbage collector only
            steps: list[Any] = [one for one in get_referents(awaited) if hasattr(one, "ag_await")]
            awaited = steps[0] if steps else None
