"""What `serve` and `bridge` have in common: they log what happens, and run until a signal comes."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import AsyncGenerator, Callable, Generator, Iterable
from contextlib import asynccontextmanager, contextmanager
from signal import SIGINT, SIGTERM

import anyio

from fibaction.abc import Endpoint
from fibaction.background import Background
from fibaction.cli.app import shown

SAME_SIGNAL = 0.1
"""Seconds within which a second signal is the first again: some, such as `timeout`, signal a
process and then its group. Nobody types Ctrl-C twice as fast as that."""


def names_of(endpoints: Iterable[Endpoint]) -> str:
    """The names of actions, as one text."""
    return ", ".join(shown(endpoint.info.name) for endpoint in endpoints)


@asynccontextmanager
async def stop_signals(
    at_once: Callable[[], None] = lambda: None,
) -> AsyncGenerator[anyio.Event, None]:
    """Gives an event that is set by the first SIGINT or SIGTERM. The second ends the process, after
    a call of `at_once`.
    """
    stop = anyio.Event()
    async with Background() as tasks:
        await tasks.start(_watch_signals, stop, at_once)
        yield stop


async def _watch_signals(
    stop: anyio.Event,
    at_once: Callable[[], None],
    *,
    task_status: anyio.abc.TaskStatus[None] = anyio.TASK_STATUS_IGNORED,
) -> None:
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        task_status.started()
        await anext(signals)
        stop.set()
        first = anyio.current_time()
        number = await anext(signals)
        while anyio.current_time() - first < SAME_SIGNAL:
            number = await anext(signals)
        at_once()
        end_by(number)


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
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    files.setLevel(logging.WARNING)  # it would tell of changes that are told of already
    try:
        yield
    finally:
        root.handlers[:] = before[0]
        root.setLevel(before[1])
        files.setLevel(before[2])
