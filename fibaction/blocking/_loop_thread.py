"""`LoopThread`: an event loop in a thread of its own, and calls of other threads into it.

Theory of operation
-------------------

The loop and its thread are anyio's blocking portal. Each call is a task of the portal, so calls of
several threads run side by side. A caller waits for its call in `_Call.mail`: it gets the values on
which it is to call back, such as feedback, and then the end. So callbacks run in the thread of the
caller, and may make calls themselves.

An exception in the caller's thread, `KeyboardInterrupt` above all, cancels the task. The caller
then waits until the task has ended, because its end has canceled the goal: for a few seconds at
most, since each wait of a clean-up is limited.

A goal that was sent is canceled by its block, if it has one; else it continues, as in asyncio. But
the block may be about to begin, and Ctrl-C in that moment is to cancel the goal. So the goal that
the main thread has sent last counts as one with a block (`sent`), until the thread makes another
call, or the block of `connect` ends in another way.

`enter` keeps an async context manager open in one task, which must enter it and leave it. `stop`
ends the loop: calls that still run are canceled, and calls that come later raise `ConnectionLost`.
"""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Generic, TypeVar, cast

import anyio
from anyio import NoEventLoopError, get_cancelled_exc_class
from anyio.from_thread import BlockingPortal, start_blocking_portal
from anyio.lowlevel import current_token

from fibaction.blocking._interrupts import Interrupts, is_main_thread
from fibaction.client.feedback_reader import CALLER
from fibaction.client.goal import SendingGoal
from fibaction.words.errors import ConnectionLost

T = TypeVar("T")
ItemT = TypeVar("ItemT")

_END = object()
_OPENED = object()


class _Call(Generic[T]):
    """One call of another thread: an async function that runs in the event loop."""

    def __init__(self, function: Callable[[_Call[T]], Awaitable[T]]) -> None:
        self.mail: SimpleQueue[Any] = SimpleQueue()
        """Items for the caller to call back on, and last `_END`."""
        self.ended = threading.Event()
        self.answered: anyio.Event
        """Set when the caller has called back. It belongs to the event loop."""
        self._function = function
        self._caller = -threading.get_ident()  # negative: it is not the ID of a task
        self._value: Any = None
        self._error: BaseException | None = None

    async def run(self) -> None:
        """Run the function, in the event loop."""
        CALLER.set(self._caller)
        try:
            self._value = await self._function(self)
        except get_cancelled_exc_class():
            self._error = closed()
            raise
        except BaseException as exc:
            self._error = exc
        finally:
            self.mail.put(_END)
            self.ended.set()

    async def hand_over(self, item: object) -> None:
        """Let the caller call back on an item, and wait until it has."""
        self.answered = anyio.Event()
        self.mail.put(item)
        await self.answered.wait()

    def outcome(self) -> T:
        """Return the value of the function, or raise its error, once it has ended."""
        error, self._error = self._error, None
        if error is None:
            return cast("T", self._value)
        try:
            raise error
        finally:
            del error  # its traceback references this frame


class LoopThread:
    """An event loop in a thread of its own."""

    def __init__(self, interrupts: Interrupts) -> None:
        self._interrupts = interrupts
        self._lock = threading.Lock()
        self._portal: BlockingPortal | None = None
        self._thread: AbstractContextManager[BlockingPortal]
        self._host: _Call[None] | None = None
        self._leaving: anyio.Event
        self._sent: SendingGoal[Any, Any] | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread = start_blocking_portal(name="fibaction.blocking")
        self._portal = self._thread.__enter__()

    def stop(self) -> None:
        """Leave the context manager that is open, and end the thread."""
        if self._portal is None:
            return
        try:
            if self._host is not None:
                self._leave(self._host)
        finally:
            with self._lock:
                portal, self._portal = self._portal, None
            portal.call(portal.stop, True)
            self._thread.__exit__(None, None, None)

    def enter(self, manager: AbstractAsyncContextManager[T]) -> T:
        """Enter an async context manager, which `stop` leaves, and return its value."""
        opened: list[T] = []

        async def host(call: _Call[None]) -> None:
            self._leaving = anyio.Event()
            async with manager as value:
                opened.append(value)
                call.mail.put(_OPENED)
                await self._leaving.wait()

        with self._interrupts.held():
            call = _Call(host)
            future = self._submit(call.run)
            try:
                with self._interrupts.allowed():
                    has_ended = call.mail.get() is _END
            except BaseException:
                future.cancel()
                call.ended.wait()
                raise
            if has_ended:
                call.outcome()
            self._host = call
        return opened[0]

    def _leave(self, host: _Call[None]) -> None:
        self._submit(self._leaving.set)
        host.ended.wait()
        host.outcome()

    def run(self, function: Callable[[], Awaitable[T]]) -> T:
        """Run an async function in the event loop, and return its value, or raise its error."""
        return self.run_with_callback(lambda _: function(), None)

    def run_with_callback(
        self,
        function: Callable[[Callable[[ItemT], Awaitable[None]]], Awaitable[T]],
        callback: Callable[[ItemT], object] | None,
    ) -> T:
        """Run an async function that can let this thread call `callback`."""
        check_is_no_loop()
        self.let_go()
        with self._interrupts.held():
            call = _Call[T](lambda call: function(call.hand_over))
            future = self._submit(call.run)
            try:
                with self._interrupts.allowed():
                    while (item := call.mail.get()) is not _END:
                        assert callback is not None
                        callback(item)
                        self._submit(call.answered.set)
            except BaseException:
                future.cancel()
                call.ended.wait()
                raise
            return call.outcome()

    def sent(self, goal: SendingGoal[Any, Any]) -> None:
        """Take note of a goal that was sent, and whose block may be about to begin."""
        if is_main_thread():
            self._sent = goal
        else:
            goal.detach()

    def begin_block(self, goal: SendingGoal[Any, Any]) -> None:
        """Let the end of this block, or of that of `connect`, cancel the goal."""
        goal.attach()
        if self._sent is goal:
            self._sent = None

    def let_go(self) -> None:
        """Let the goal that was sent last continue by itself: it has no block."""
        if self._sent is not None and is_main_thread():
            self._sent.detach()
            self._sent = None

    def _submit(self, function: Callable[[], Any]) -> Future[Any]:
        with self._lock:  # the portal may not be stopped while it is asked
            if self._portal is None:
                raise closed()
            return self._portal.start_task_soon(function)


def closed() -> ConnectionLost:
    """Return the error of a call that comes too late."""
    return ConnectionLost(
        "this connection was closed here: use its clients and goals inside the block of connect()"
    )


def check_is_no_loop() -> None:
    """Raise an error in a thread whose event loop this call would block.

    Raises:
        RuntimeError: An event loop runs in this thread.
    """
    try:
        current_token()
    except NoEventLoopError:
        return
    raise RuntimeError(
        "fibaction.blocking would block the event loop that runs in this thread: use"
        " `async with fibaction.connect(...)`, or `await` it, instead"
    )


OpenedT = TypeVar("OpenedT")
ValueT = TypeVar("ValueT")


class LoopBlock(Generic[OpenedT, ValueT]):
    """A block that starts an event loop in a thread, and enters an async block there."""

    def __init__(
        self,
        make: Callable[[], AbstractAsyncContextManager[OpenedT]],
        value: Callable[[LoopThread, OpenedT], ValueT],
    ) -> None:
        """Prepare a block: `make` makes the async block, and `value` turns its value into that of
        this one.
        """
        self._make = make
        self._value = value
        self._interrupts = Interrupts(enter=self.__enter__.__code__, leave=self.__exit__.__code__)
        self._loop = LoopThread(self._interrupts)

    def __enter__(self) -> ValueT:
        check_is_no_loop()
        try:
            self._interrupts.install()
            with self._interrupts.held():
                self._loop.start()
                opened = self._loop.enter(self._make())
            return self._value(self._loop, opened)
        except BaseException:
            self._close()
            raise

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc_type is not KeyboardInterrupt:
            self._loop.let_go()
        self._close()

    def _close(self) -> None:
        self._interrupts.hold()
        try:
            self._loop.stop()
        finally:
            self._interrupts.restore()
