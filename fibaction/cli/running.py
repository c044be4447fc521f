"""What `serve` and `bridge` have in common: they log what happens, and run until a signal comes."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import AsyncGenerator, Callable, Generator, Iterable
from contextlib import asynccontextmanager, contextmanager
from signal import SIGINT, SIGTERM

import anyio

from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.cli.app import shown
from fibaction.cli.escaping import CleanFormatter, clean

SAME_SIGNAL = 0.1
"""Seconds within which a second signal is the first again: some, such as `timeout`, signal a
process and then its group. Nobody types Ctrl-C twice as fast as that."""


def names_of(endpoints: Iterable[Endpoint]) -> str:
    """The names of actions, as one text."""
    return ", ".join(clean(shown(endpoint.info.name)) for endpoint in endpoints)


@asynccontextmanager
async def stop_signals(
    at_once: Callable[[], None] = lambda: None,
) -> AsyncGenerator[anyio.Event, None]:
    """Gives an event that is set by the first SIGINT or SIGTERM. The second ends the process, after
    a call of `at_once`: also behind the block, where Python may wait for threads.
    """
    stop = anyio.Event()
    first = 0.0

    def second(number: int, _frame: object) -> None:
        if time.monotonic() - first >= SAME_SIGNAL:
            at_once()
            end_by(signal.Signals(number))

    async def watch(*, task_status: anyio.abc.TaskStatus[None]) -> None:
        nonlocal first
        with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
            task_status.started()
            await anext(signals)
            first = time.monotonic()
            stop.set()
            # Not by a task: a clean-up may hold the event loop up, and the end is to be at once.
            _handle_with(second)
            await anyio.sleep_forever()

    async with Background() as tasks:
        await tasks.start(watch)
        yield stop
    if stop.is_set():
        _handle_with(second)  # the receiver has left Python's own, which raises KeyboardInterrupt


def _handle_with(handler: Callable[[int, object], None]) -> None:
    for number in (SIGINT, SIGTERM):
        signal.signal(number, handler)


def end_by(number: signal.Signals) -> None:
    """End this process as that signal does where nobody handles it."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


@contextmanager
def logging_to_stderr() -> Generator[None, None, None]:
    """Log what happens, with the time, as long as the block lasts."""
    root, files = logging.getLogger(), logging.getLogger("watchfiles")
    before = root.handlers[:], root.level, files.level
    handler = logging.StreamHandler()
    handler.setFormatter(CleanFormatter("%(asctime)s %(message)s"))
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    files.setLevel(logging.WARNING)  # it would tell of changes that are told of already
    try:
        yield
    finally:
        root.handlers[:] = before[0]
        root.setLevel(before[1])
        files.setLevel(before[2])
