"""An event loop in virtual time, which jumps to the next timer as soon as no task can run.

It never sleeps, and has no threads and no sockets. Each run of the same tasks is the same: asyncio
and anyio keep tasks and cancel scopes in sets, so these get hashes that do not depend on memory
addresses.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # the loop is asyncio's own, with another clock
import gc
import itertools
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from typing import Any, TypeVar
from unittest.mock import patch

import anyio
from anyio._backends import _asyncio as anyio_asyncio

T = TypeVar("T")

TURN = 2e-6
"""Virtual seconds that one turn of the loop takes, so that time passes for busy tasks, too."""
EPOCH = 1000.0
"""The beginning of virtual time. A clock that begins at 0 hides code that takes 0 for "never"."""
PAST = 1_700_000_000 * 10**9
"""The time of day at 0 of virtual time, in nanoseconds since 1970."""


class Deadlock(Exception):
    """A state in which all tasks wait, and no timer is left that could wake one."""


class Livelock(Exception):
    """A run of more turns, or more time, than is allowed."""


class _Task(asyncio.Task[Any]):
    """A task whose place in a set does not depend on its memory address."""

    _numbers = itertools.count(1)

    def __new__(cls, *_args: Any, **_keywords: Any) -> _Task:
        self = super().__new__(cls)
        self.number = next(cls._numbers)
        return self

    number: int

    def __hash__(self) -> int:
        return self.number


class _Scope(anyio_asyncio.CancelScope):
    """A cancel scope whose place in a set does not depend on its memory address."""

    __slots__ = ("_number",)
    _numbers = itertools.count(1)

    def __init__(self, deadline: float = float("inf"), shield: bool = False) -> None:
        super().__init__(deadline, shield)
        self._number = next(self._numbers)

    def __hash__(self) -> int:
        return self._number


class _NoFiles:
    """A selector for the base class, which waits by adding to the time."""

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop = loop

    def select(self, timeout: float | None) -> list[Any]:
        self._loop.pass_time(timeout)
        return []


class VirtualLoop(asyncio.BaseEventLoop):
    """An event loop in virtual time."""

    def __init__(self, *, longest: float = 1e6, most_turns: int = 5_000_000) -> None:
        """Make a loop that may run for `longest` virtual seconds, and for `most_turns` turns."""
        super().__init__()
        # The base class needs a selector, and the last two methods of this class.
        self._selector = _NoFiles(self)
        self.now = EPOCH
        self.turns = 0
        self._longest = longest
        self._end = EPOCH + longest
        self._most_turns = most_turns

    def time(self) -> float:
        return self.now

    def pass_time(self, timeout: float | None) -> None:
        """Let the time until the next timer pass; None if no timer is set.

        Raises:
            Deadlock: No timer is set.
            Livelock: The loop has run for too long.
        """
        if timeout is None:
            raise Deadlock("nothing can run any more:\n" + "\n".join(self.waiting()))
        self.now += timeout if timeout > TURN else TURN
        self.turns += 1
        if self.now > self._end or self.turns > self._most_turns:
            # The clean-up after this error takes some turns, too.
            self._end, self._most_turns = self.now + self._longest, self.turns + self._most_turns
            waiting = "\n".join(self.waiting())
            raise Livelock(f"{self.turns} turns, {self.now - EPOCH:g} virtual seconds:\n{waiting}")

    def create_task(self, coro: Any, **keywords: Any) -> Any:
        return _Task(coro, loop=self, **keywords)

    def waiting(self) -> list[str]:
        """Return a line for each task with the place where it waits."""
        tasks = (task for task in asyncio.all_tasks(self) if isinstance(task, _Task))
        return [
            f"  {task.get_name()}: {_place(task)}"
            for task in sorted(tasks, key=lambda task: task.number)
        ]

    def _process_events(self, event_list: list[Any]) -> None:
        assert not event_list

    def _write_to_self(self) -> None:
        """Do nothing, since the loop never sleeps."""


def _place(task: asyncio.Task[Any]) -> str:
    """Return the chain of coroutines that a task waits in, the innermost last."""
    places: list[str] = []
    awaiting: Any = task.get_coro()
    while awaiting is not None:
        frame = getattr(awaiting, "cr_frame", None) or getattr(awaiting, "ag_frame", None)
        if frame is not None:
            file = frame.f_code.co_filename.rsplit("/", 1)[-1]
            places.append(f"{frame.f_code.co_name} ({file}:{frame.f_lineno})")
        awaiting = getattr(awaiting, "cr_await", None) or getattr(awaiting, "ag_await", None)
    return " > ".join(places) or "at its beginning"


def waiting_tasks() -> list[str]:
    """Return the lines of `VirtualLoop.waiting` for all tasks but this one."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    me = asyncio.current_task()
    assert me is not None
    return [line for line in loop.waiting() if not line.startswith(f"  {me.get_name()}: ")]


@contextmanager
def _numbered() -> Generator[None, None, None]:
    """Number tasks and scopes from 1, and let anyio make numbered scopes."""
    _Task._numbers, _Scope._numbers = itertools.count(1), itertools.count(1)
    with patch.object(anyio_asyncio, "CancelScope", _Scope):
        yield


@contextmanager
def _no_collection_by_chance() -> Generator[None, None, None]:
    """Run the garbage collector only when it is called, since the finalizers of what it frees act.

    It skips older objects, which makes it fast, and the same in each run.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    gc.freeze()
    try:
        yield
        gc.collect()
    finally:
        gc.unfreeze()
        if was_enabled:
            gc.enable()


def run(
    main: Callable[[], Awaitable[T]],
    loop: VirtualLoop | None = None,
    on_error: Callable[[dict[str, Any]], None] | None = None,
) -> T:
    """Run `main` in virtual time; `on_error` gets the errors that asyncio would only log.

    Raises:
        Deadlock, Livelock: `main` does not end.
    """
    virtual = loop or VirtualLoop()
    if on_error is not None:
        virtual.set_exception_handler(lambda _, context: on_error(context))
    with _no_collection_by_chance(), _numbered():
        return anyio.run(main, backend="asyncio", backend_options={"loop_factory": lambda: virtual})
