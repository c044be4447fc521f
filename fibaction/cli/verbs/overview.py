"""`fibaction top` and `stats`: all actions and goals on a live screen, and in numbers.

The screen needs the extra `fibaction[tui]`. The numbers tell how many goals actions have, how they
end, and how long they take.
"""

from __future__ import annotations

import logging
import sys
import time
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager

import anyio
import click
import msgspec

from fibaction._api import ClientConnection, connect
from fibaction.border.event_loop import Background
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.completion import ACTION, namespace_option
from fibaction.cli.arguments.goal_lookup import ACTIONS_ASKED_AT_ONCE, ActionClients
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.arguments.options import TimeType, json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import aligned, duration
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, message_of, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.feeds.statistics import ActionStatistics, Percentiles, SpanStatistics, statistics_of
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


DAY = 24 * 3600 * 10**9
HEADINGS = (
    *("ACTION", "IN", "GOALS", "PER MIN", "SUCCEEDED", "CANCELED", "ABORTED"),
    *("WAITED P50", "P95", "RAN P50", "P95", "NOW"),
)


@click.command(
    "stats",
    epilog="""\b
Examples:
  fibaction stats
  fibaction stats drive pick --since 7d
  fibaction stats drive --json""",
)
@click.argument("names", metavar="[NAME]...", type=ACTION, nargs=-1)
@click.option(
    "--since",
    type=TimeType(),
    help="The begin of the longer span: a time as for fibaction goals.  [default: 24h]",
)
@namespace_option
@json_option
@url_option
def stats_command(
    names: tuple[str, ...], since: int | None, namespace: Namespace, as_json: bool, url: str
) -> None:
    """Count the goals of the actions that you name, or of all actions: those accepted and ended,
    why they were aborted, and how long they waited and ran. The half of them took at most P50, and
    95 of 100 at most P95.

    Each action has a line for the last ten minutes, and one for a day or for the time --since. The
    numbers are from the history of the server's store; without one, from the goals that it still
    remembers.
    """
    absolute = tuple(namespace.absolute(name) for name in names)
    run(print_statistics, url, absolute, namespace, since, as_json=as_json)


async def print_statistics(
    url: str, names: tuple[str, ...], namespace: Namespace, since: int | None, *, as_json: bool
) -> int:
    """Print the statistics of actions.

    Raises:
        Failure: A named action is not served, or the namespace has no actions.
    """
    begin = time.time_ns() - DAY if since is None else since
    found: dict[str, ActionStatistics] = {}
    limit = anyio.CapacityLimiter(ACTIONS_ASKED_AT_ONCE)
    async with connect(url) as connection:
        clients = await ActionClients(namespace.narrow(connection), *names).now()

        async def ask(name: str) -> None:
            try:
                async with limit:
                    found[name] = await statistics_of(clients[name].endpoint, begin)
            except ActionError as exc:
                note(f"{shown(name)} is left out: {message_of(exc)}")

        async with anyio.create_task_group() as tasks:
            for name in clients:
                tasks.start_soon(ask, name)
    told = [(name, found[name]) for name in clients if name in found]
    if as_json:
        for name, statistics in told:
            say_json({"action": name, **msgspec.to_builtins(statistics)})
    elif told:
        for line in lines_of(told):
            say(line)
    return ExitCode.SUCCEEDED if told or not clients else ExitCode.UNREACHABLE


def lines_of(told: list[tuple[str, ActionStatistics]]) -> list[str]:
    """Return the statistics in columns below a line of headings, and then the failures."""
    table: list[tuple[str, ...]] = [HEADINGS]
    failures: list[str] = []
    for name, statistics in told:
        action = excerpt(shown(name))
        now = f"{statistics.running} running, {statistics.waiting} waiting"
        recent, whole = statistics.recent, statistics.whole
        table += [(action, *_cells(recent), now), (action, *_cells(whole), "")]
        if whole.failures:
            failures += ["", f"{action} was aborted in {duration(whole.seconds)}:"]
            failures += aligned(
                [["", str(one.goals), excerpt(one.reason)] for one in whole.failures]
            )
        if not statistics.past:
            failures += ["", f"{action}: no history, only the goals that the server remembers"]
    return aligned(table) + failures


def _cells(span: SpanStatistics) -> tuple[str, ...]:
    ends = (str(span.ended[name]) for name in ("SUCCEEDED", "CANCELED", "ABORTED"))
    rate = f"{span.per_minute:.3g}"
    times = (*_times(span.waited), *_times(span.ran))
    return duration(span.seconds), str(span.accepted), rate, *ends, *times


def _times(times: Percentiles | None) -> tuple[str, str]:
    return ("-", "-") if times is None else (_time(times.p50), _time(times.p95))


def _time(seconds: float) -> str:
    return f"{seconds * 1000:.3g} ms" if seconds < 1 else duration(seconds)
