"""An event loop whose time is a number: it jumps to the next timer as soon as nothing else can run.

Nothing here waits, and there are no threads and no sockets. Whatever runs in the loop runs the same
way each time: tasks and cancel scopes are kept in sets by asyncio and anyio, and get hashes here
that are not addresses of memory. It knows nothing of what runs in it.
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
"""Virtual seconds that one turn of the loop takes, so that what is busy for long does get older."""
EPOCH = 1000.0
"""When virtual time begins: a clock that begins at 0 hides what takes 0 for "never"."""


class Deadlock(Exception):
    """All tasks wait, and there is nothing left that could wake one."""


class Livelock(Exception):
    """The loop goes on and on: more turns, or more time, than a run may take."""


class _Task(asyncio.Task[Any]):
    """A task whose place in a set does not depend on where in memory it is."""

    _numbers = itertools.count(1)

    def __new__(cls, *_args: Any, **_keywords: Any) -> _Task:
        self = super().__new__(cls)
        self.number = next(cls._numbers)
        return self

    number: int

    def __hash__(self) -> int:
        return self.number


class _Scope(anyio_asyncio.CancelScope):
    """A cancel scope of which the same is true."""

    __slots__ = ("_number",)
    _numbers = itertools.count(1)

    def __init__(self, deadline: float = float("inf"), shield: bool = False) -> None:
        super().__init__(deadline, shield)
        self._number = next(self._numbers)

    def __hash__(self) -> int:
        return self._number


class _NoFiles:
    """What the base class takes for a selector: waiting is adding to the time."""

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop = loop

    def select(self, timeout: float | None) -> list[Any]:
        self._loop.pass_time(timeout)
        return []


class VirtualLoop(asyncio.BaseEventLoop):
    """An event loop in virtual time."""

    def __init__(self, *, longest: float = 1e6, most_turns: int = 5_000_000) -> None:
        """`longest` is how many virtual seconds it may run, `most_turns` how many turns."""
        super().__init__()
        # The base class asks for it, and for the two methods below; its other users have files.
        self._selector = _NoFiles(self)
        self.now = EPOCH
        self.turns = 0
        self._longest = longest
        self._end = EPOCH + longest
        self._most_turns = most_turns

    def time(self) -> float:
        return self.now

    def pass_time(self, timeout: float | None) -> None:
        """Nothing can run for that long; None says that nothing ever can.

        Raises:
            Deadlock: None, that is.
            Livelock: It has run for too long.
        """
        if timeout is None:
            raise Deadlock("nothing can run any more:\n" + "\n".join(self.waiting()))
        self.now += timeout if timeout > TURN else TURN
        self.turns += 1
        if self.now > self._end or self.turns > self._most_turns:
            # What is still to come is the end of it all, which takes some turns, too.
            self._end, self._most_turns = self.now + self._longest, self.turns + self._most_turns
            waiting = "\n".join(self.waiting())
            raise Livelock(f"{self.turns} turns, {self.now - EPOCH:g} virtual seconds:\n{waiting}")

    def create_task(self, coro: Any, **keywords: Any) -> Any:
        return _Task(coro, loop=self, **keywords)

    def waiting(self) -> list[str]:
        """Each task, and where it waits."""
        tasks = (task for task in asyncio.all_tasks(self) if isinstance(task, _Task))
        return [
            f"  {task.get_name()}: {_place(task)}"
            for task in sorted(tasks, key=lambda task: task.number)
        ]

    def _process_events(self, event_list: list[Any]) -> None:
        assert not event_list

    def _write_to_self(self) -> None:
        """Something is new, but nobody sleeps."""


def _place(task: asyncio.Task[Any]) -> str:
    """The chain of coroutines that a task waits in, the innermost last."""
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
    """Each task of the running loop but this one, and where it waits."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    me = asyncio.current_task()
    assert me is not None
    return [line for line in loop.waiting() if not line.startswith(f"  {me.get_name()}: ")]


@contextmanager
def _numbered() -> Generator[None, None, None]:
    """Count tasks and scopes from the beginning, and let anyio make scopes that are counted."""
    _Task._numbers, _Scope._numbers = itertools.count(1), itertools.count(1)
    with patch.object(anyio_asyncio, "CancelScope", _Scope):
        yield


@contextmanager
def _no_collection_by_chance() -> Generator[None, None, None]:
    """The garbage collector comes when it is called: what it frees may have something to say. It
    looks at nothing that was there before, which makes it fast, and the same each time.
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
    """Run `main` in virtual time; `on_error` is told what asyncio would only log.

    Raises:
        Deadlock, Livelock: It does not end.
    """
    virtual = loop or VirtualLoop()
    if on_error is not None:
        virtual.set_exception_handler(lambda _, context: on_error(context))
    with _no_collection_by_chance(), _numbered():
        return anyio.run(main, backend="asyncio", backend_options={"loop_factory": lambda: virtual})
