"""`TaskPool`: tasks that run executors, each one after another.

A task costs more than most goals that need it, so those that are through with one take the next. It
knows nothing of goals: a job is a coroutine function that is given the `Life` it runs in.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Coroutine
from time import perf_counter
from typing import Any, TypeAlias

from anyio import CancelScope, TaskHandle
from anyio.abc import TaskGroup
from anyio.lowlevel import cancel_shielded_checkpoint

from fibaction._notify import Notifier

MOST_IDLE = 16
"""Tasks that are kept although there is nothing to do for them, some kilobytes each."""
SLICE = 0.005
"""Seconds that a task may go on without awaiting before others get their turn: short for a person
and for a heartbeat, long beside a turn of the event loop (some 10 microseconds)."""


class Life:
    """What surrounds an executor, so that it can be interrupted once, and later be killed.

    Two scopes, because an interruption is to arrive once: the outer one, the task's own, delivers
    it, then the inner one shields what follows, the clean-up, until it is killed.
    """

    __slots__ = ("_task", "is_spent", "on_wait", "rest")

    def __init__(self, on_wait: Callable[[], None]) -> None:
        self._task: TaskHandle[None] | CancelScope | None = None
        self.rest = CancelScope(shield=True)
        self.is_spent = False
        """Whether nothing else can run in it."""
        self.on_wait = on_wait
        """To be called when what runs in it begins to wait."""

    def run_by(self, task: TaskHandle[None] | CancelScope) -> None:
        """This task, or what is in this scope, enters `rest`. It may have done so: an eager task
        has begun before anybody knows it.
        """
        self._task = task
        if not self.rest.shield:
            task.cancel()

    def interrupt(self) -> None:
        """Cancel what runs in it."""
        self.is_spent = True
        self.rest.shield = False
        if self._task is not None:
            self._task.cancel()

    def kill(self) -> None:
        """From now on, cancel whatever is awaited in it."""
        self.is_spent = True
        self.rest.cancel()


Job: TypeAlias = Callable[[Life], Coroutine[Any, Any, None]]
"""Something to do, in a life that may have been another job's. It begins in the same turn of the
event loop as others that do not wait, so it must not depend on the task it runs in."""


class TaskPool:
    """Does jobs at once, each in a task in which nothing else is under way."""

    def __init__(self, tasks: TaskGroup, name: str) -> None:
        self._tasks = tasks
        self._name = name
        self._jobs: deque[Job] = deque()
        self._idle: list[Notifier] = []
        self._is_coming = False  # a task for the next job
        self._on_wait = self._call  # made once, and not for each life
        self._closed = False

    def add(self, job: Job) -> None:
        """Do this, beginning in the next turn of the event loop."""
        self._jobs.append(job)
        self._call()

    def close(self) -> None:
        """There will be no more jobs: end the tasks that wait for some."""
        self._closed = True
        idle, self._idle = self._idle, []
        for news in idle:
            news.notify()

    def _call(self) -> None:
        """See that a task comes for the next job: the last one has begun to wait, or has ended."""
        if self._jobs and not self._is_coming:
            self._is_coming = True
            if self._idle:
                self._idle.pop().notify()
            else:
                life = Life(self._on_wait)
                life.run_by(self._tasks.start_soon(self._work, life, name=self._name))

    async def _work(self, life: Life) -> None:
        news = Notifier()
        with life.rest:
            while True:
                self._is_coming = False
                slice_end = perf_counter() + SLICE
                while self._jobs and not life.is_spent:
                    await self._jobs.popleft()(life)
                    if perf_counter() >= slice_end:
                        await cancel_shielded_checkpoint()
                        slice_end = perf_counter() + SLICE
                if life.is_spent or self._closed or len(self._idle) >= MOST_IDLE:
                    break
                self._idle.append(news)
                await news.wait()
        self._call()
