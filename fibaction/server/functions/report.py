"""`Report`: the feedback of a function from anywhere in it, and `RunningGoal`, which gets it.

Theory of operation
-------------------

A report does what a `yield` of a generator does: `RunningGoal` appends the feedback to the goal's
log, and says whether to pause. In the thread of the event loop, the call appends, and awaiting it
pauses; so a callback, which cannot await, reports too. In another thread the call does both: it
runs as a task of the event loop, and the thread waits for it. `RunningGoal.waiting` ends the wait
at a cancel, which is then raised in the thread.

Several tasks may report at once. While one of them waits for room, the feedback of the others is
late: each of them waits for its turn, and appends then. So a slow reader loses nothing, and the
order is that of the calls. Callbacks do not wait for their turn: the task that has the last one
waits for theirs, too. Late feedback has a bound; over it, the oldest is appended at once, and
pushes out what the reader has not read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Generator, Iterator
from contextlib import contextmanager
from functools import partial
from threading import get_ident
from types import coroutine
from typing import Any, Generic, TypeVar, cast

from anyio import CancelScope, Lock

from fibaction._runtime.async_only import HomeLoop
from fibaction.words.errors import GoalCanceled


class RunningGoal(ABC):
    """The run of an executor, beside its generator: feedback, and cancels outside an `await`."""

    __slots__ = ("_waits", "home")

    home: HomeLoop | None
    """The event loop of the executor; None before the server has started."""
    _waits: tuple[CancelScope, ...]

    @contextmanager
    def waiting(self) -> Generator[None, None, None]:
        """Wait outside of the executor's task during the block; an interruption ends the wait."""
        # Shielded: the task may be one of a thread that the executor awaits.
        with CancelScope(shield=True) as scope:
            self._waits += (scope,)
            try:
                yield
            finally:
                self._waits = tuple(one for one in self._waits if one is not scope)

    def end_waits(self) -> None:
        """End all waits outside of the executor's task."""
        for scope in self._waits:
            scope.cancel()

    @property
    @abstractmethod
    def is_interrupted(self) -> bool:
        """True if a cancellation was sent and has not arrived, or if the executor is killed; to be
        read in any thread.
        """

    @abstractmethod
    def encode(self, feedback: object) -> bytes:
        """Turn feedback into bytes.

        Raises:
            TypeError: It is not of the feedback's type, or cannot be encoded.
        """

    @abstractmethod
    def keep_result(self, value: object, subject: str) -> None:
        """Keep the result, which is of the goal as soon as the executor has ended; `subject` is
        what has returned it, for the text of an error.

        Raises:
            Misuse: It is not of the result's type.
        """

    @abstractmethod
    def append(self, payload: bytes) -> bool:
        """Append feedback to the goal's log, as a `yield` does; return whether to `pause` then."""

    @abstractmethod
    def send(self, feedback: object) -> bool:
        """Append feedback that is not encoded yet; return whether to `pause` then.

        Raises:
            TypeError: As for `encode`.
        """

    @abstractmethod
    async def pause(self) -> None:
        """Let others run, and wait for room, as a `yield` does."""

    @abstractmethod
    def arrive(self) -> None:
        """Let the cancellation arrive here: the `await`s that follow in the executor are clean-up.

        To be called in the thread of the event loop.
        """

    def check(self) -> None:
        """Raise the error of a pending cancellation, in any thread.

        Raises:
            GoalCanceled: The goal is to stop.
            RuntimeError: The event loop has ended.
        """
        if not self.is_interrupted:
            return
        home = self.home
        if home is None or home.is_here:
            self.arrive()
        else:
            home.run(self._arrive)
        raise GoalCanceled

    async def _arrive(self) -> None:
        self.arrive()


FeedbackT_contra = TypeVar("FeedbackT_contra", contravariant=True)

MOST_LATE = 1000
"""Feedback messages that wait for their turn; more tasks than that hardly report at once."""


class Report(Generic[FeedbackT_contra]):
    """Sends feedback of a function: `await report(feedback)`.

    It is for a function what `yield` is for a generator. The feedback is encoded and sent at once;
    the `await` waits if the client is slow, lets other tasks run, and is where a cancel arrives.

    Helpers, tasks that the function has started, callbacks and threads may call it, too. A callback
    calls it without `await`, and does not wait. In a thread, the call itself waits, and raises
    `GoalCanceled` if the goal is to stop.
    """

    __slots__ = ("_late", "_running", "_takers", "_thread", "_turns")

    def __init__(self, running: RunningGoal) -> None:
        self._running: RunningGoal | None = running
        self._thread = get_ident()  # that of the event loop
        self._late: deque[bytes] = deque()
        self._takers = 0  # tasks that have the turn, or wait for it
        self._turns: Lock | None = None  # most functions never need it

    def __call__(self, feedback: FeedbackT_contra) -> Awaitable[None]:
        """Send feedback.

        Raises:
            TypeError: It is not of the feedback's type, or cannot be encoded.
            GoalCanceled: The goal is to stop, and this is not the thread of the event loop.
            RuntimeError: The function has ended, or the event loop has.
        """
        running = self._running or self._open()
        if get_ident() != self._thread:
            assert running.home is not None
            running.home.run(partial(self._in_thread, feedback))
            return DONE
        if not self._takers and not self._late:
            return _Turn(self) if running.send(feedback) else DONE
        payload = running.encode(feedback)
        if self._takers:
            self._late.append(payload)
            if len(self._late) > MOST_LATE:
                running.append(self._late.popleft())
            return _Turn(self)
        self._append_late(running)
        return _Turn(self) if running.append(payload) else DONE

    def close(self) -> None:
        """Take no more feedback: the function has ended."""
        running = self._open()
        self._append_late(running)
        self._running = None

    async def turn(self) -> None:
        """Wait for the turn of one message, and pause after it."""
        self._turns = self._turns or Lock(fast_acquire=True)
        self._takers += 1
        try:
            async with self._turns:
                running = self._open()
                if self._late:
                    running.append(self._late.popleft())
                await running.pause()
                while self._late and self._takers == 1:
                    running.append(self._late.popleft())  # a callback's, which waits for no turn
                    await running.pause()
        finally:
            self._takers -= 1

    async def _in_thread(self, feedback: FeedbackT_contra) -> None:
        """Send feedback for a thread that waits."""
        running = self._open()
        with running.waiting():
            await self(feedback)
        running.check()

    def _append_late(self, running: RunningGoal) -> None:
        """Append what callbacks have reported while others waited."""
        while self._late:
            running.append(self._late.popleft())

    def _open(self) -> RunningGoal:
        if self._running is None:
            raise RuntimeError("this report is of a goal whose function has ended")
        return self._running


class _Turn:
    """Awaits the turn of one message."""

    __slots__ = ("_report",)

    def __init__(self, report: Report[Any]) -> None:
        self._report = report

    def __await__(self) -> Generator[Any, Any, None]:
        return self._report.turn().__await__()


@coroutine
def _nothing() -> Generator[Any, Any, None]:
    """Wait for nothing."""
    yield from ()


DONE: Awaitable[None] = _nothing()
"""Awaited where there is nothing to wait for. It has ended, and so does each `await` of it, at once
and without a call, which takes a third of the time of an object with `__await__`."""
next(cast("Iterator[None]", DONE), None)
