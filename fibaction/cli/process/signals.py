"""Ctrl-C and SIGTERM, and the end of a process whose threads do not end (`LastSeconds`).

- Before a verb runs, Ctrl-C exits at once: `fibaction.cli.main`.
- `send_goal` cancels the goal at the first Ctrl-C and leaves at the second: `send_goal.py`.
- Verbs that watch run `until_interrupted`.
- `serve` and `bridge` stop gracefully at the first signal, and end at once at the second:
  `stop_signals`.
- All others exit at once: `exit_codes.run`.

An event loop handles signals between its tasks only, so a task that computes would keep them
waiting. `SignalReceiver` ends the process if the loop has not taken a signal within `GRACE`; on
Windows, which has no timer of signals, if another one comes before it is taken.

The event loop of Unix learns of a signal from a file descriptor that Python's own handler writes
to, so a handler in Python may be set beside it: that one is called also while the loop is blocked.
The event loop of Windows has no such receiver. There, Python wakes it at each signal, and the
handler of `ReceivedSignals` tells it. Windows has no SIGTERM from elsewhere. It has SIGBREAK, by
Ctrl-Break and by a program that stops another one.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from threading import Thread, Timer
from threading import enumerate as enumerate_threads
from typing import Any, Final, Self, TypeAlias

import anyio

from fibaction._runtime.log import clean_logger
from fibaction.border.event_loop import Background, asyncio_loop
from fibaction.cli.process.exit_codes import ExitCode

Handler: TypeAlias = Callable[[int, object], None]

NUMBERS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)
)
"""The signals that end a verb."""
MOST_WAITING_SIGNALS = 8
"""Signals that may come before they are taken; more count as these."""
logger = clean_logger("fibaction.cli")


def handle_with(handler: Handler) -> None:
    """Make this the handler of the signals."""
    for number in NUMBERS:
        signal.signal(number, handler)


class ReceivedSignals:
    """Receives the signals, one for each `next`, during its block.

    The handler gets each of them at once, also while the event loop is blocked.
    """

    def __init__(self, handler: Handler) -> None:
        self._handler = handler
        self._stack = ExitStack()
        self._signals: AsyncIterator[Any]

    def __enter__(self) -> None:
        """Begin to receive."""
        try:
            self._signals = self._stack.enter_context(anyio.open_signal_receiver(*NUMBERS))
        except NotImplementedError:
            self._signals = self._receive_by_handler()
        else:
            handle_with(self._handler)

    def __exit__(self, *_: object) -> None:
        """Restore the handlers from before."""
        self._stack.close()

    async def next(self) -> None:
        """Wait for the next signal."""
        await anext(self._signals)

    def _receive_by_handler(self) -> AsyncIterator[int]:
        loop = asyncio_loop()
        come, taken = anyio.create_memory_object_stream[int](MOST_WAITING_SIGNALS)
        self._stack.callback(come.close)
        self._stack.callback(taken.close)

        def tell(number: int) -> None:
            if come.statistics().current_buffer_used < MOST_WAITING_SIGNALS:
                come.send_nowait(number)

        def handle(number: int, frame: object) -> None:
            loop.call_soon_threadsafe(tell, number)
            self._handler(number, frame)

        for number in NUMBERS:
            self._stack.callback(signal.signal, number, signal.getsignal(number))
            signal.signal(number, handle)
        return taken


SAME_SIGNAL = 0.1
"""Seconds within which a second signal counts as the first again: some programs, such as `timeout`,
signal a process and then its group. A person does not type Ctrl-C twice as fast as that."""
GRACE = 1.0
"""Seconds for the event loop to take a signal: longer than a short computation, for example the
printing of a large message."""
_SCREEN_OFF = "\x1b[?1049l\x1b[?1000l\x1b[?1003l\x1b[?1006l\x1b[?2004l\x1b[?25h"
"""Escape sequences that end a screen: they restore the lines and the cursor, without the mouse."""


class SignalReceiver:
    """Receives SIGINT and SIGTERM, one for each `next`, during its block.

    If a signal is not taken within `GRACE` seconds, because something computes, the process exits
    with the code for an interruption; on Windows, it does so at the next signal.
    """

    def __init__(self, last_words: Callable[[], object] = lambda: None) -> None:
        """Make a receiver. `last_words` is called before such an exit."""
        self._last_words = last_words
        self._stack = ExitStack()
        self._has_alarm = hasattr(signal, "SIGALRM")
        self._is_waiting = False
        self._signals = ReceivedSignals(self._set_alarm if self._has_alarm else self._exit_at_next)
        self._terminal = _Terminal()

    def __enter__(self) -> Self:
        self._stack.enter_context(self._signals)
        if self._has_alarm:
            before = signal.signal(signal.SIGALRM, self._exit)
            self._stack.callback(signal.signal, signal.SIGALRM, before)
            self._stack.callback(signal.setitimer, signal.ITIMER_REAL, 0)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    async def next(self) -> None:
        """Wait for the next signal."""
        await self._signals.next()
        self._is_waiting = False
        if self._has_alarm:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _set_alarm(self, _number: int, _frame: object) -> None:
        if signal.getitimer(signal.ITIMER_REAL)[0] == 0:  # more signals are no reprieve
            signal.setitimer(signal.ITIMER_REAL, GRACE)

    def _exit_at_next(self, number: int, frame: object) -> None:
        if self._is_waiting:
            self._exit(number, frame)
        self._is_waiting = True

    def _exit(self, _number: int, _frame: object) -> None:
        with suppress(Exception):  # the computation may be within the same stream
            self._terminal.restore()
            self._last_words()
        os._exit(ExitCode.INTERRUPTED)


class _Terminal:
    """The state of the terminal, for an exit without clean-up."""

    def __init__(self) -> None:
        self._state: list[Any] | None = None
        if sys.__stdin__ is not None and sys.__stdin__.isatty():
            with suppress(ModuleNotFoundError):  # as on Windows
                import termios

                self._state = termios.tcgetattr(sys.__stdin__)

    def restore(self) -> None:
        """Restore the state from when this object was made."""
        if self._state is not None:
            import termios

            assert sys.__stdin__ is not None
            termios.tcsetattr(sys.__stdin__, termios.TCSANOW, self._state)
        for stream in (sys.__stdout__, sys.__stderr__):
            if stream is not None and stream.isatty():
                os.write(stream.fileno(), _SCREEN_OFF.encode())
                break


async def until_interrupted(body: Callable[[], Awaitable[object]]) -> bool:
    """Run `body` until it ends, or until Ctrl-C or SIGTERM. Return whether a signal ended it."""
    scope = anyio.CancelScope()

    async def cancel_at_signal() -> None:
        await signals.next()
        scope.cancel()

    with SignalReceiver() as signals:
        async with Background() as tasks:
            tasks.start_soon(cancel_at_signal)
            with scope:
                await body()
    return scope.cancelled_caught


@asynccontextmanager
async def stop_signals(same: float | None = None) -> AsyncGenerator[anyio.Event, None]:
    """Give an event that is set by the first SIGINT or SIGTERM. The second ends the process.

    It does so also behind the block, where Python may wait for threads. A signal within `same`
    seconds counts as the first again; `SAME_SIGNAL` if it is None.
    """
    stop = anyio.Event()
    first: float | None = None

    def handle(number: int, _frame: object) -> None:
        nonlocal first
        now = time.monotonic()
        if first is None:
            first = now
        elif now - first >= (SAME_SIGNAL if same is None else same):
            end_by(signal.Signals(number))

    async def wait_for_first(*, task_status: anyio.abc.TaskStatus[None]) -> None:
        # The second signal is not for a task: an executor or a clean-up may block the event loop,
        # and that signal must end the process at once.
        signals = ReceivedSignals(handle)
        with signals:
            task_status.started()
            await signals.next()
            stop.set()
            await anyio.sleep_forever()

    async with Background() as tasks:
        await tasks.start(wait_for_first)
        yield stop
    if stop.is_set():
        handle_with(handle)  # the receiver has restored Python's, which raises KeyboardInterrupt


def end_by(number: signal.Signals) -> None:
    """End this process as that signal does in a process without a handler."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


class LastSeconds:
    """A block that ends the process if it does not end by itself soon after `begin()`.

    Python waits for threads at the end of the event loop and of the process. An executor may have
    started one that never ends, and the process was told to end.
    """

    def __init__(self, seconds: float, code: int) -> None:
        self._timer = Timer(seconds, end_now, [code])
        self._timer.daemon = True
        self._before: set[Thread] = set()

    def __enter__(self) -> Self:
        self._before.update(enumerate_threads())
        return self

    def begin(self) -> None:
        """Begin to count the seconds."""
        self._timer.start()

    def __exit__(self, *_: object) -> None:
        if all(thread.daemon for thread in set(enumerate_threads()) - self._before):
            self._timer.cancel()


def end_now(code: int) -> None:
    """End this process with that code, without waiting for threads and tasks."""
    logger.warning("this process ends without its threads and tasks that do not end")
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
