"""`fibaction top`: show all actions and goals on a live screen, with the extra `fibaction[tui]`."""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager

import click

from fibaction._api import ClientConnection, connect
from fibaction.border.event_loop import Background
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.completion import namespace_option
from fibaction.cli.arguments.names import ROOT, Namespace
from fibaction.cli.arguments.options import url_option
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.observe.monitor import Monitor
from fibaction.words.errors import ActionError

MOST_LINES = 100
"""Lines of the log that are kept while the screen is shown: more would scroll away in the end."""


@click.command(
    "top",
    epilog="""\b
Examples:
  fibaction top
  fibaction top -n /robot1

\b
Keys: c cancels the goal under the cursor, after a question; f or Enter shows the goal, its
feedback and its end; / filters; s sorts; q quits.""",
)
@namespace_option
@url_option
def top_command(namespace: Namespace, url: str) -> None:
    """Watch all actions and goals on a live screen: progress, rates, the latest feedback, ends."""
    check_installed("textual", "fibaction top", "tui")
    # Textual draws on stderr.
    if not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise Failure(
            "fibaction top needs a terminal, on stderr as well; fibaction goals --watch does not"
        )
    run(top, url, namespace)


async def top(url: str, namespace: Namespace) -> int:
    """Show the screen until the user quits.

    Raises:
        Failure: The namespace has no actions.
        ActionError: The server cannot be reached; or the connection is lost and is not reopened.
    """
    where = without_settings(url)
    if namespace != ROOT:
        where += f"  {namespace.path}"
    async with connect(url) as whole:
        connection = namespace.narrow(whole)
        await connection.actions()  # raises an error before the screen is taken
        await show(connection, where)
    return ExitCode.SUCCEEDED


async def show(connection: ClientConnection, where: str) -> None:
    """Show the actions of a connection. `where` is the server, for the first line.

    Raises:
        ActionError: It is lost and is not reopened.
    """
    from fibaction.cli.output.screen import TopScreen
    from fibaction.cli.output.screen_tables import FeedbackText

    monitor = Monitor(summarize=FeedbackText.of)
    screen = TopScreen(monitor, where)
    lost: list[BaseException] = []

    async def feed() -> None:
        try:
            await monitor.run(connection)
        except* ActionError as errors:
            lost.append(errors)
            screen.exit()

    with log_held_back():
        async with Background() as tasks:
            tasks.start_soon(feed)
            await until_interrupted(screen.run_async)
    if lost:
        raise lost[0]


@contextmanager
def log_held_back() -> Generator[None, None, None]:
    """Keep the log until the block ends, and write it then.

    While there is a screen, textual takes what is written to stderr and does not show it.
    """
    root, kept = logging.getLogger(), _RecentRecords()
    before = root.handlers[:]
    root.handlers[:] = [kept]
    try:
        yield
    finally:
        root.handlers[:] = before
        for record in kept.records:
            root.callHandlers(record)


class _RecentRecords(logging.Handler):
    """Keeps the last records of the log."""

    def __init__(self) -> None:
        super().__init__()
        self.records: deque[logging.LogRecord] = deque(maxlen=MOST_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)
