"""`fibaction stats`: how many goals actions have, how they end, and how long they take."""

from __future__ import annotations

import time

import anyio
import click
import msgspec

from fibaction._api import connect
from fibaction.cli.arguments.completion import ACTION, namespace_option
from fibaction.cli.arguments.goal_lookup import ACTIONS_ASKED_AT_ONCE, ActionClients
from fibaction.cli.arguments.names import Namespace, shown
from fibaction.cli.arguments.options import TimeType, json_option, url_option
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import aligned, duration
from fibaction.cli.output.lines import note, say, say_json
from fibaction.cli.process.exit_codes import ExitCode, message_of, run
from fibaction.feeds.statistics import ActionStatistics, Percentiles, SpanStatistics, statistics_of
from fibaction.words.errors import ActionError

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
