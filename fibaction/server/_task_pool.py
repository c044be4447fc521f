"""`TaskPool`: tasks that run executors, each one after another.

Creating a task costs more than running a short goal, so idle tasks are reused. With the pool, a
server runs short goals 1.6 times as fast as with a new task for each goal
(`python -m tests.benchmarks.parts`).

The pool does not depend on goals: a job is a coroutine function that takes the `CancelOnce` it runs
in.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Coroutine
from time import perf_counter
from typing import Any, TypeAlias

from anyio.abc import TaskGroup
from anyio.lowlevel import cancel_shielded_checkpoint

from fibaction._notify import Notifier
from fibaction.server._interruption import SLICE, CancelOnce

MOST_IDLE = 16
"""The most idle tasks that are kept, some kilobytes each."""


Job: TypeAlias = Callable[[CancelOnce], Coroutine[Any, Any, None]]
"""A coroutine function that is run in scopes which earlier jobs may have used. Jobs that do not
wait run in the same turn of the event loop and in the same task, so a job must not depend on its
task."""


class TaskPool:
    """A pool of tasks; each runs one job at a time."""

    def __init__(self, tasks: TaskGroup, name: str) -> None:
        self._tasks = tasks
        self._name = name
        self._jobs: deque[Job] = deque()
        self._idle: list[Notifier] = []
        self._is_coming = False  # a task was woken or started for the next job
        self._on_wait = self._call  # one bound method for all scopes
        self._closed = False

    def add(self, job: Job) -> None:
        """Run a job, beginning in the next turn of the event loop."""
        self._jobs.append(job)
        self._call()

    def close(self) -> None:
        """End the idle tasks, after the last job was added."""
        self._closed = True
        idle, self._idle = self._idle, []
        for news in idle:
            news.notify()

    def _call(self) -> None:
        """Wake or start a task for the next job, if there is a job without a task.

        Called when a job was added, when a running job begins to wait, and when a task ends.
        """
        if self._jobs and not self._is_coming:
            self._is_coming = True
            if self._idle:
                self._idle.pop().notify()
            else:
                scopes = CancelOnce(self._on_wait)
                scopes.run_by(self._tasks.start_soon(self._work, scopes, name=self._name))

    async def _work(self, scopes: CancelOnce) -> None:
        news = Notifier()
        with scopes.rest:
            while True:
                self._is_coming = False
                slice_end = perf_counter() + SLICE
                while self._jobs and not scopes.is_spent:
                    await self._jobs.popleft()(scopes)
                    if perf_counter() >= slice_end:
                        await cancel_shielded_checkpoint()
                        slice_end = perf_counter() + SLICE
                if scopes.is_spent or self._closed or len(self._idle) >= MOST_IDLE:
                    break
                self._idle.append(news)
                await news.wait()
        self._call()
