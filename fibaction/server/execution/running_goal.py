"""`RunningGoal`: the run of an executor, as code that reports from anywhere in it calls it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import contextmanager

from anyio import CancelScope

from fibaction._runtime.own_thread import HomeLoop
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
