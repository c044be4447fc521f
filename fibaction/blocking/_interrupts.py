"""`Interrupts`: Ctrl-C, put off while a connection could not clean up.

Theory of operation
-------------------

Python calls the handler of SIGINT in the main thread, between any two of its steps, and the default
one raises `KeyboardInterrupt` there. In the middle of a start or of a clean-up this would leave a
thread and a goal behind. So from the beginning to the end of a block of `connect` in the main
thread, SIGINT has a handler that knows three modes:

- In user code the signal goes to the handler that was there before, which mostly raises.
- Inside a call (`held`) it is put off until the end of the call.
- While a call waits, or calls user code (`allowed`), it goes to the handler before; what follows
  is the clean-up of the call, so from then on signals are put off.

The two methods at the edges of the block begin in the first mode. A signal at the first step of
`__exit__` must not raise, or the clean-up would never begin: the handler recognises the method by
its frame. A signal in `__enter__` raises, and puts further ones off, because `__enter__` cleans up.

In other threads Python never calls the handler, and nothing is put off.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from enum import Enum, auto
from types import CodeType, FrameType


class _Mode(Enum):
    USER = auto()
    """The program of the user runs."""
    HELD = auto()
    """A call is between two waits."""
    ALLOWED = auto()
    """A call waits."""


class Interrupts:
    """The handler of SIGINT during one block of `connect`."""

    def __init__(self, *, enter: CodeType, leave: CodeType) -> None:
        """Take the code of the methods that begin and end the block."""
        self._enter = enter
        self._leave = leave
        self._mode = _Mode.USER
        self._is_pending = False
        self._before: Callable[[int, FrameType | None], object] | None = None

    def install(self) -> None:
        """Handle SIGINT, if this is the main thread and the handler before is one of Python."""
        before = signal.getsignal(signal.SIGINT)
        if is_main_thread() and callable(before):
            self._before = before
            signal.signal(signal.SIGINT, self._handle)

    def hold(self) -> None:
        """Put off all signals from now on, until `restore`."""
        if is_main_thread():
            self._mode = _Mode.HELD

    def restore(self) -> None:
        """Give SIGINT back to the handler before, and a signal that was put off, too."""
        before = self._before
        if before is None:
            return
        # A handler that the user's program has set in the meantime stays.
        if signal.getsignal(signal.SIGINT) == self._handle:
            signal.signal(signal.SIGINT, before)
        if self._is_pending:
            before(signal.SIGINT, None)

    @contextmanager
    def held(self) -> Generator[None, None, None]:
        """Put off signals during the block."""
        if self._before is None or not is_main_thread():
            yield
            return
        before, self._mode = self._mode, _Mode.HELD
        try:
            yield
        finally:
            self._mode = before
            self._deliver()

    @contextmanager
    def allowed(self) -> Generator[None, None, None]:
        """Let signals through during the block, which is inside one of `held`."""
        if self._before is None or not is_main_thread():
            yield
            return
        self._mode = _Mode.ALLOWED
        try:
            self._deliver()
            yield
        finally:
            self._mode = _Mode.HELD

    def _deliver(self) -> None:
        if self._is_pending and self._mode is not _Mode.HELD:
            self._is_pending = False
            self._handle(signal.SIGINT, None)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        assert self._before is not None
        mode = self._mode
        if mode is _Mode.HELD or (mode is _Mode.USER and _is_inside(frame, self._leave)):
            self._is_pending = True
            return
        if mode is _Mode.ALLOWED or _is_inside(frame, self._enter):
            self._mode = _Mode.HELD  # for the clean-up
        self._before(number, frame)
        self._mode = mode  # it has not raised


def is_main_thread() -> bool:
    """Return whether this is the thread that handles signals."""
    return threading.current_thread() is threading.main_thread()


def _is_inside(frame: FrameType | None, code: CodeType) -> bool:
    while frame is not None:
        if frame.f_code is code:
            return True
        frame = frame.f_back
    return False
