"""Names executors that block the event loop, in the log.

Theory of operation
-------------------

A step of an executor runs from one wait to the next, in `Stepper`. While it runs, no other task of
its event loop does, so only another thread can tell that it does not end. `Stepper` therefore notes
itself in `Current` while it runs: two stores for each step, and no lock. One thread, the `Watchdog`
of the process, looks there every quarter of the smallest limit. A step is the same one as before if
both the `Stepper` and its `slice_end` are the same, since each step sets a later time.

A step over the limit is named once, with two lines of code: the outermost one that is not
fibaction's, which is the executor's own, and the innermost one. They are read from the frames of
the loop's thread (`sys._current_frames`). That thread continues meanwhile, so the warning is
dropped if the step has ended by then. The thread also tells the end of a step that it has named.

The watchdog runs as long as a server with a limit is open. It waits without a timeout while no
executor is active (`is_asleep`), and the next one wakes it. The order of the accesses replaces a
lock: an executor becomes active before it reads `is_asleep`, and the watchdog sets `is_asleep`
before it looks for active executors once more.

A call into C that keeps Python's global lock keeps the watchdog from running, too. It is named as
soon as it returns, before its step continues.
"""

from __future__ import annotations

import linecache
import math
import sys
from collections.abc import Callable
from threading import TIMEOUT_MAX, Event, Lock, Thread, get_ident, local
from time import perf_counter
from types import FrameType
from typing import Any, NamedTuple, Protocol

from fibaction._runtime.async_only import HomeLoop
from fibaction._runtime.log import clean_logger
from fibaction.server.execution.interruption import Current, Stepper
from fibaction.server.execution.turns import EXECUTOR_SLICE
from fibaction.server.goal_handle import GoalHandle
from fibaction.words.goals import GoalID

CHECKS = 4
"""Checks within the seconds of a limit."""

POLL = 0.05
"""Seconds between two checks while a step blocks, at most; its whole time is told as exactly."""

JOIN_TIMEOUT = 1.0
"""Seconds for the thread to end. It ends at once, unless a handler of the log blocks it."""

ADVICE = "; await what takes time, or call it with anyio.to_thread.run_sync"

logger = clean_logger("fibaction.server")


class Watched(Protocol):
    """An executor that runs. Its goal may change, when it takes over another one."""

    handle: GoalHandle[Any]


class _Blocked(NamedTuple):
    """A step that was named in the log."""

    steps: Stepper[Any]
    slice_end: float
    goal_id: GoalID

    def is_now(self, steps: Stepper[Any] | None) -> bool:
        """Return whether this step is the one that runs now, which is of `steps`."""
        return steps is self.steps and self.steps.slice_end == self.slice_end


class Watch:
    """The executors of one server, and the seconds that a step of theirs may take."""

    def __init__(self, action: str, limit: float) -> None:
        """Watch nothing before `open()`; a limit of 0 or infinity never does."""
        self.current = Current()
        """The step that runs now in the server's thread, of any server."""
        self.home: HomeLoop | None = None
        """The event loop of the executors; None before `open()`."""
        self._action = action
        self._limit = limit if limit < math.inf else 0
        self._interval = min(max(limit / CHECKS, EXECUTOR_SLICE), TIMEOUT_MAX)
        self._active: dict[Stepper[Any], Watched] = {}
        self._named: list[_Blocked] = []  # one at most; two threads may take it out
        self._thread = 0
        self._watchdog: Watchdog | None = None

    def open(self, home: HomeLoop | None = None) -> None:
        """Watch the executors of this thread from now on; `home` is its event loop."""
        self._thread = get_ident()
        self.home = home
        self.current = _here.current
        if self._limit:
            try:
                self._watchdog = _watchdogs.add(self)
            except RuntimeError as exc:  # the system has no threads, or no more of them
                logger.warning(
                    "goals of action %r that block the event loop are not named here: %s",
                    self._action,
                    exc,
                )

    def close(self) -> None:
        """Watch nothing any more; the watchdog has ended if this was the last watch."""
        if self._watchdog is not None:
            _watchdogs.remove(self)
            self._watchdog = None
            self._tell_end(perf_counter())

    def begin(self, steps: Stepper[Any], executor: Watched) -> None:
        """Watch an executor until its end."""
        if self._watchdog is not None:
            self._active[steps] = executor
            if self._watchdog.is_asleep:
                self._watchdog.wake()

    def end(self, steps: Stepper[Any]) -> None:
        """Watch an executor no longer."""
        self._active.pop(steps, None)

    # The other methods are called in the watchdog's thread.

    @property
    def is_active(self) -> bool:
        """True if an executor has begun, and has not ended."""
        return bool(self._active)

    def check(self, now: float) -> float:
        """Name the step that blocks now; return the seconds until the next check."""
        steps = self.current.steps
        named = self._named.copy()  # `close` may take it out meanwhile
        if named:
            if not named[0].is_now(steps):
                self._tell_end(now)
        elif steps is not None and now - _beginning(steps.slice_end) >= self._limit:
            self._name(steps, steps.slice_end, now)
        return min(self._interval, POLL) if self._named else self._interval

    def _name(self, steps: Stepper[Any], slice_end: float, now: float) -> None:
        executor = self._active.get(steps)
        if executor is None:
            return  # it is another server's
        blocked = _Blocked(steps, slice_end, executor.handle.goal_id)
        places = _places_in(self._thread)
        if not blocked.is_now(self.current.steps):
            return  # the step has ended, and the places may be those of another one
        self._named.append(blocked)
        where = ("", ", at %s", ", at %s, and in it at %s")[len(places)]
        logger.warning(
            "goal %s of action %r has blocked the event loop for %.1f s so far" + where + ADVICE,
            blocked.goal_id,
            self._action,
            now - _beginning(slice_end),
            *map(_text_of, places),
        )

    def _tell_end(self, now: float) -> None:
        try:
            blocked = self._named.pop()
        except IndexError:
            return
        logger.warning(
            "goal %s of action %r blocked the event loop for %.1f s in all",
            blocked.goal_id,
            self._action,
            now - _beginning(blocked.slice_end),
        )


def _beginning(slice_end: float) -> float:
    """Return the time at which a step began, if it has a whole slice; else some milliseconds
    before.
    """
    return slice_end - EXECUTOR_SLICE


# The thread


class Watchdog(Thread):
    """The thread that checks all watches of the process; it ends when none is left."""

    def __init__(self) -> None:
        super().__init__(name="fibaction watchdog", daemon=True)
        self.watches: tuple[Watch, ...] = ()
        self.is_asleep = False
        """True if it has to be woken for an executor that begins."""
        self._news = Event()

    def wake(self) -> None:
        """Let the thread check all watches now."""
        self.is_asleep = False
        self._news.set()

    def run(self) -> None:
        """Check all watches, again and again."""
        was_woken = True
        while True:
            self._news.clear()
            if not self.watches:
                return
            timeout: float | None = self.check(perf_counter())
            # Not at once after it was woken: many short goals would wake it one after another.
            if not was_woken and not self._are_active():
                self.is_asleep = True
                timeout = timeout if self._are_active() else None
            was_woken = self._news.wait(timeout)
            self.is_asleep = False

    def _are_active(self) -> bool:
        return any(watch.is_active for watch in self.watches)

    def check(self, now: float) -> float:
        """Check all watches; return the seconds until the next check."""
        return min((watch.check(now) for watch in self.watches), default=0)


class _Watchdogs:
    """The watchdog of this process, while there is one."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._running: Watchdog | None = None

    def add(self, watch: Watch) -> Watchdog:
        """Let the watchdog check a watch, and start it if it does not run.

        Raises:
            RuntimeError: No thread can be started.
        """
        with self._lock:
            watchdog = self._running
            # In a process that was forked, the thread is gone, and its watches are the parent's.
            if watchdog is None or not watchdog.is_alive():
                watchdog = Watchdog()
                watchdog.watches = (watch,)
                watchdog.start()
                self._running = watchdog
            else:
                watchdog.watches += (watch,)
                watchdog.wake()  # its limit may be smaller than those of the others
            return watchdog

    def remove(self, watch: Watch) -> None:
        """Let the watchdog check a watch no longer, and end it with the last one."""
        with self._lock:
            watchdog = self._running
            if watchdog is not None:
                watchdog.watches = tuple(one for one in watchdog.watches if one is not watch)
                if not watchdog.watches:
                    self._running = None
                    watchdog.wake()
                    watchdog.join(JOIN_TIMEOUT)


class _Here(local):
    """The step that runs in each thread."""

    def __init__(self) -> None:
        self.current = Current()


_here = _Here()
_watchdogs = _Watchdogs()


# The lines of code


class _Place(NamedTuple):
    """A line of code."""

    file: str
    line: int
    function: str


def _places_in(thread: int) -> list[_Place]:
    """Return the places at which the step of a thread stands: the executor's own, then the
    innermost one if it is another; none if they cannot be read.
    """
    frame = _frame_of(thread)
    innermost: _Place | None = None
    own: _Place | None = None
    while frame is not None:
        module: str = frame.f_globals.get("__name__", "")
        if module == Stepper.__module__:
            break
        place = _Place(frame.f_code.co_filename, frame.f_lineno or 0, frame.f_code.co_qualname)
        innermost = innermost or place
        if module.partition(".")[0] != "fibaction":
            own = place
        frame = frame.f_back
    if frame is None or innermost is None:
        return []
    return [own, innermost] if own not in (None, innermost) else [innermost]


def _frame_of(thread: int) -> FrameType | None:
    """Return the innermost frame of a thread; None if this Python cannot tell, or not safely.

    Without the global lock, frames of other threads must not be looked into.
    """
    has_lock: bool = getattr(sys, "_is_gil_enabled", lambda: True)()
    frames: Callable[[], dict[int, FrameType]] | None = getattr(sys, "_current_frames", None)
    return frames().get(thread) if frames and has_lock else None


def _text_of(place: _Place) -> str:
    text = f"{place.file}:{place.line} in {place.function}"
    source = linecache.getline(place.file, place.line).strip()
    return f"{text}: {source}" if source else text
