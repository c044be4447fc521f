"""`fibaction top`: all actions and goals on a live screen. It needs the extra `fibaction[tui]`."""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager
from importlib.util import find_spec

import click

from fibaction._api import ClientConnection, connect
from fibaction._tasks import Background
from fibaction.cli.app import run, url_option
from fibaction.cli.board import Board
from fibaction.cli.ending import ExitCode, Failure
from fibaction.cli.observing import observe, until_interrupted
from fibaction.exceptions import ActionError
from fibaction.urls import without_settings

MOST_LINES = 100
"""Of the log that are kept while a screen is shown: more would scroll away in the end."""


@click.command(
    "top",
    epilog="""\b
Example:
  fibaction top

\b
Keys: c cancels the goal under the cursor, f or Enter follows it, q quits.""",
)
@url_option
def top_command(url: str) -> None:
    """Watch all actions and goals on a live screen: rates, and the latest feedback."""
    if find_spec("textual") is None:
        raise Failure("fibaction top needs textual: pip install 'fibaction[tui]'", ExitCode.USAGE)
    # It is stderr that textual draws on.
    if not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise Failure(
            "fibaction top needs a terminal, on stderr as well; fibaction goals --watch does not",
            ExitCode.USAGE,
        )
    run(top, url)


async def top(url: str) -> int:
    """Show the screen until somebody quits.

    Raises:
        ActionError: The server cannot be reached; or it is lost, and will not be looked for.
    """
    async with connect(url) as connection:
        await connection.actions()  # what is wrong is told before the screen is taken
        await show(connection, url)
    return ExitCode.SUCCEEDED


async def show(connection: ClientConnection, url: str) -> None:
    """Show what happens at that connection.

    Raises:
        ActionError: It is lost, and will not be opened again.
    """
    from fibaction.cli.screen import Screen

    board = Board()
    screen = Screen(board, without_settings(url))
    lost: list[BaseException] = []

    async def feed() -> None:
        try:
            await observe(connection, board, feedback=True)
        except* ActionError as errors:
            lost.append(errors)
            screen.exit()

    with log_held_back():
        async with Background() as tasks:
            tasks.start_soon(feed)
            tasks.start_soon(board.keep)
            await until_interrupted(screen.run_async)
    if lost:
        raise lost[0]


@contextmanager
def log_held_back() -> Generator[None, None, None]:
    """Keep what is logged until the block ends, and write it then: while there is a screen, textual
    takes what is written to stderr, and shows it to nobody.
    """
    root, kept = logging.getLogger(), _Kept()
    before = root.handlers[:]
    root.handlers[:] = [kept]
    try:
        yield
    finally:
        root.handlers[:] = before
        for record in kept.records:
            root.callHandlers(record)


class _Kept(logging.Handler):
    """What was logged last."""

    def __init__(self) -> None:
        super().__init__()
        self.records: deque[logging.LogRecord] = deque(maxlen=MOST_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)
