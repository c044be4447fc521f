"""`LoopBlock`: an async block as a plain one, in an event loop of its own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Generic, TypeVar

from fibaction.blocking._interrupts import Interrupts
from fibaction.blocking._loop_thread import LoopThread, check_is_no_loop

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
        self._close()

    def _close(self) -> None:
        self._interrupts.hold()
        try:
            self._loop.stop()
        finally:
            self._interrupts.restore()
