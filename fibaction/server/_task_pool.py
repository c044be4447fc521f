"""`TaskPool`: tasks that run executors, each one after another.

Creating a task costs more than running a short goal, so idle tasks are reused: with the pool, a
server runs short goals 1.6 times as fast as with a task for each
(`python -m tests.benchmarks.parts`).

The pool knows nothing of goals: a job is a coroutine function that is given the `CancelOnce` it
runs in.
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
"""Idle tasks that are kept at most, some kilobytes each."""


Job: TypeAlias = Callable[[CancelOnce], Coroutine[Any, Any, None]]
"""Something to do, in scopes that may have been another job's. It begins in the same turn of the
event loop as others that do not wait, so it must not depend on the task it runs in."""


class TaskPool:
    """Tasks for jobs, each in a task that does nothing else meanwhile."""

    def __init__(self, tasks: TaskGroup, name: str) -> None:
        self._tasks = tasks
        self._name = name
        self._jobs: deque[Job] = deque()
        self._idle: list[Notifier] = []
        self._is_coming = False  # a task is on its way to the next job
        self._on_wait = self._call  # made once, and not for each scopes
        self._closed = False

    def add(self, job: Job) -> None:
        """Do the job, beginning in the next turn of the event loop."""
        self._jobs.append(job)
        self._call()

    def close(self) -> None:
        """End the idle tasks: there will be no more jobs."""
        self._closed = True
        idle, self._idle = self._idle, []
        for news in idle:
            news.notify()

    def _call(self) -> None:
        """Send a task to the next job: the last one has begun to wait, or has ended."""
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
