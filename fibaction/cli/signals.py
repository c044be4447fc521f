"""Ctrl-C and SIGTERM.

- Before a verb runs, Ctrl-C exits at once: `fibaction.cli.main`.
- `send_goal` cancels the goal at the first Ctrl-C and leaves at the second: `send_goal.py`.
- Verbs that watch run `until_interrupted`.
- `serve` and `bridge` stop gracefully at the first signal, and end at once at the second:
  `stop_signals`.
- `serve` ends even if threads of executors do not: `LastSeconds`.
- All others end with `ExitCode.INTERRUPTED`: `exit_codes.report_errors`.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from signal import SIGINT, SIGTERM
from threading import Thread, Timer
from threading import enumerate as enumerate_threads
from typing import Self

import anyio

from fibaction._tasks import Background

logger = logging.getLogger(__name__)

SAME_SIGNAL = 0.1
"""Seconds within which a second signal counts as the first again: some programs, such as `timeout`,
signal a process and then its group. A person does not type Ctrl-C twice as fast as that."""


async def until_interrupted(body: Callable[[], Awaitable[object]]) -> bool:
    """Run `body` until it ends, or until Ctrl-C or SIGTERM. Return whether a signal ended it."""
    scope = anyio.CancelScope()

    async def cancel_at_signal() -> None:
        await anext(signals)
        scope.cancel()

    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
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
    first = 0.0

    def second(number: int, _frame: object) -> None:
        if time.monotonic() - first >= (SAME_SIGNAL if same is None else same):
            end_by(signal.Signals(number))

    async def wait_for_first(*, task_status: anyio.abc.TaskStatus[None]) -> None:
        nonlocal first
        with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
            task_status.started()
            await anext(signals)
            first = time.monotonic()
            stop.set()
            # Not by a task: a clean-up may block the event loop, and the end must come at once.
            _handle_with(second)
            await anyio.sleep_forever()

    async with Background() as tasks:
        await tasks.start(wait_for_first)
        yield stop
    if stop.is_set():
        _handle_with(second)  # the receiver has restored Python's, which raises KeyboardInterrupt


def _handle_with(handler: Callable[[int, object], None]) -> None:
    for number in (SIGINT, SIGTERM):
        signal.signal(number, handler)


def end_by(number: signal.Signals) -> None:
    """End this process as that signal does in a process without a handler."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


class LastSeconds:
    """A block that ends the process if it does not end by itself soon after `begin()`.

    Python waits for its threads at the end of the event loop and of the process. An executor may
    have started one that never ends, and the process was told to end.
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
