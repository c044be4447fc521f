"""A task group that can leave tasks behind, for code that may refuse to end.

Theory of operation
-------------------

A task group waits for its tasks, whatever they do. So the tasks of a `DetachedGroup` are in a group
in a task that no task waits for: one of asyncio without a group, or a system task of trio. A task
of the owner stands for them: it waits for their end, raises their errors, and stops waiting when
they are overdue.

`waker` then ends what they wait for, so that they can end themselves. A task that ends in the
middle of code which it never resumes leaves the scopes of that code open, and asyncio and trio
complain with a RuntimeError.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any

from anyio import CancelScope, Event, create_task_group, get_cancelled_exc_class, move_on_after
from anyio.abc import TaskGroup

from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import asyncio_task

if TYPE_CHECKING:
    import asyncio  # noqa: TID251  # anyio has no tasks outside of its groups

__all__ = ["DetachedGroup"]

LAST_TURNS = 0.1
"""Seconds for tasks that were left behind to end, if they can: a few turns of the event loop."""

_outside: set[asyncio.Task[None]] = set()
"""The tasks without a group; asyncio itself keeps only weak references."""


class DetachedGroup:
    """A task group in a task of its own, so that its owner need not wait for all of its tasks.

    It belongs to a task group, its owner, as its tasks would: their exceptions are raised there,
    and the owner does not end before `close()` was called and the tasks have ended. But if they
    have not ended within `grace` seconds after `close()`, the owner calls `on_overdue`, and then
    waits no longer.
    """

    def __init__(
        self,
        owner: TaskGroup,
        name: str,
        *,
        on_open: Callable[[TaskGroup], None],
        on_overdue: Callable[[], None],
        grace: float,
    ) -> None:
        """Open the group; `on_open` is called with it in the next turn of the event loop."""
        self._on_open = on_open
        self._on_overdue = on_overdue
        self._grace = grace
        self._news = Notifier()
        self._closing = Event()
        self._has_ended = False
        self.has_abandoned = False
        """True if a task has ended in the middle of code that it never resumes: the RuntimeErrors
        about that are dropped."""
        self._error: BaseException | None = None
        start_outside(self._run, name)
        owner.start_soon(self._wait, name=name)

    def close(self) -> None:
        """Let the owner end once the tasks have ended, or are overdue."""
        self._closing.set()
        self._news.notify()

    async def _run(self) -> None:
        try:
            async with create_task_group() as tasks:
                self._on_open(tasks)
                await self._closing.wait()
        except get_cancelled_exc_class():
            raise  # the event loop itself ends
        except BaseExceptionGroup as group:
            self._error = _single(group.split(RuntimeError)[1] if self.has_abandoned else group)
        finally:
            self._has_ended = True
            self._news.notify()

    async def _wait(self) -> None:
        with CancelScope(shield=True):
            while not (self._has_ended or self._closing.is_set()):
                await self._news.wait()
            with move_on_after(self._grace):
                await self._end()
            if not self._has_ended:
                self._on_overdue()
                with move_on_after(LAST_TURNS):
                    await self._end()
        if self._error is not None:
            raise self._error

    async def _end(self) -> None:
        while not self._has_ended:
            await self._news.wait()


def _single(group: BaseExceptionGroup[BaseException] | None) -> BaseException | None:
    return group.exceptions[0] if group is not None and len(group.exceptions) == 1 else group


def start_outside(function: Callable[[], Awaitable[None]], name: str) -> None:
    """Run an async function in a task that no task waits for. It must not raise."""
    if asyncio_task() is not None:
        import asyncio  # noqa: TID251  # anyio has no tasks outside of its groups

        task = asyncio.get_running_loop().create_task(_awaited(function), name=name)
        _outside.add(task)
        task.add_done_callback(_outside.discard)
    else:
        import trio

        trio.lowlevel.spawn_system_task(function, name=name, context=copy_context())


async def _awaited(function: Callable[[], Awaitable[None]]) -> None:
    await function()


def waker() -> Callable[[], object]:
    """Return a function that makes this task resume with an error even if scopes shield its wait.

    It is for code that never resumes what has been waiting. It has no effect on a task of asyncio
    that waits for a task which cannot be canceled, nor on a task of trio that waits for a thread or
    has a nursery open.
    """
    task = asyncio_task()
    if task is not None:
        return task.cancel
    import trio

    return partial(_abort, trio.lowlevel.current_task())


def _abort(task: Any) -> None:
    # As trio itself does for a cancellation, which a shield would keep away.
    if task._abort_func is not None and not task.child_nurseries:
        task._attempt_abort(_raise_woken)


def _raise_woken() -> None:
    raise RuntimeError("this task was abandoned")
