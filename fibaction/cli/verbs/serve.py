"""`fibaction serve`: serve the servers of a user's module, by `fibaction.serve`."""

from __future__ import annotations

import gc
import os
from collections.abc import AsyncGenerator, Callable, Generator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from functools import partial
from itertools import repeat
from typing import Literal

import anyio
import click

from fibaction._api import serve
from fibaction._runtime.log import clean_logger
from fibaction.border.abc import StatusStream, Transport
from fibaction.border.urls import transport_for
from fibaction.cli.arguments.import_target import AnyServer, import_servers
from fibaction.cli.arguments.names import names_of
from fibaction.cli.arguments.options import NumberType, reject_inproc, url_of
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import log_events, log_with_time, say
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, run
from fibaction.cli.process.reload import SAME_STOP, run_reloading, started_by
from fibaction.cli.process.signals import LastSeconds, stop_signals
from fibaction.observe.metrics import Metrics
from fibaction.observe.metrics_server import serve_metrics
from fibaction.observe.recordings.recorder import Recorder
from fibaction.stores.sqlite_store import SqliteStore
from fibaction.words.goal_query import DAY, GoalHistory
from fibaction.words.statuses import GoalStatus

LAST_SECONDS = 0.5
"""Seconds between the stop of all servers and the end of the process, at most."""

HANDED_ON = ("store", "sync", "history", "drain", "metrics", "record")
"""Options that each process which `--reload` starts gets, if they have a value."""
COLLECTIONS = (20_000, 20, 20)
"""Thresholds of the garbage collector while goals run; by default the first is 700, and the others
are 10."""

logger = clean_logger(__name__)


@click.command(
    "serve",
    epilog="""\b
Examples:
  fibaction serve robot:server
  fibaction serve robot:make_servers tcp://127.0.0.1:7400 unix:///run/robot.sock ros2://
  fibaction serve robot:drive tcp://127.0.0.1:7400
  fibaction serve robot:server --store goals.db
  fibaction serve robot:server --record today.jsonl --metrics :9464
  fibaction serve robot:server --reload""",
)
@click.argument("target", metavar="MODULE:SERVER")
@click.argument("urls", metavar="[URL]...", nargs=-1)
@click.option("--store", metavar="FILE", help="Keep the goals in this file, over restarts.")
@click.option(
    "--sync",
    type=click.Choice(["full", "normal"]),
    help="With --store: normal is faster, and may lose the last goals if the power fails.",
)
@click.option(
    "--history",
    metavar="DAYS",
    type=NumberType(),
    help="With --store: keep ended goals for this many days, for `fibaction goals --past`.",
)
@click.option(
    "--drain",
    metavar="SECONDS",
    type=NumberType(min_open=False),
    default=0.0,
    help="Before a stop, reject new goals, and give running ones this much time to end.",
)
@click.option("--log-json", is_flag=True, help="Log JSON objects, one per line, with goal IDs.")
@click.option("--metrics", metavar="[HOST]:PORT", help="Serve /metrics and /healthz here, by HTTP.")
@click.option("--record", metavar="FILE", help="Record everything that happens to goals.")
@click.option("--reload", is_flag=True, help="Start again when the module's .py files change.")
@click.option("--started-by", "parent", type=int, hidden=True)
@click.pass_context
def serve_command(
    context: click.Context,
    target: str,
    urls: tuple[str, ...],
    store: str | None,
    sync: Literal["full", "normal"] | None,
    history: float | None,
    drain: float,
    log_json: bool,
    metrics: str | None,
    record: str | None,
    reload: bool,
    parent: int | None,
) -> None:
    """Run the action servers of your module, at one URL or several.

    SERVER is an ActionServer, a function that @action has made an action, a list of several, or a
    function without arguments that returns them.
    The module is looked for in the current folder first.

    Ctrl-C or SIGTERM ends all goals, tells their clients, and stops the servers; a second one stops
    them at once. With --drain, running goals first get time to finish.

    With --store, servers that have no store of their own keep their goals in that file: their
    `recovery` and `at_stop` say what becomes of active ones.
    """
    if sync is not None and store is None:
        raise Failure("--sync is a setting of --store FILE")
    if history is not None and store is None:
        raise Failure(
            "--history is a setting of --store FILE; in a fleet, append ?history_days=7 to the URL"
        )
    where = urls or (url_of(context),)
    if second := next((one for one in urls if "://" not in one and ":" in one), ""):
        raise Failure(
            f"{excerpt(second)!r} is not a URL, and only one MODULE:SERVER can be given: write a"
            f" list of the servers in the module, and name it"
        )
    reject_inproc(*where)  # beside another one it is for clients in the module itself
    sync = sync or "full"
    if record is not None:
        record = os.path.abspath(record)
    if store is not None:
        store = os.path.abspath(store)  # the module may change the folder when it is imported
    with log_with_time(as_json=log_json):
        if reload:
            values = store, store and sync, history, drain or None, metrics, record
            options = dict(zip(HANDED_ON, values, strict=True))
            given = [f"--{name}={value}" for name, value in options.items() if value is not None]
            given += ["--log-json"] if log_json else []
            run_reloading(target, urls, url_of(context), given, drain)
        else:
            with started_by(parent):
                same = None if parent is None else SAME_STOP
                servers = import_servers(target)
                if store is not None:
                    keep_in_file(servers, store, sync, history)
                with LastSeconds(LAST_SECONDS, ExitCode.SUCCEEDED) as last:
                    run(
                        serve_servers,
                        servers,
                        where,
                        metrics=metrics,
                        record=record,
                        drain=drain,
                        same=same,
                        at_end=last.begin,
                        uvloop=True,
                    )


def keep_in_file(
    servers: Sequence[AnyServer],
    path: str,
    sync: Literal["full", "normal"],
    days: float | None = None,
) -> None:
    """Let the servers that have no store keep their goals in a file, with a history of so many
    days, if it is to have one.
    """
    history = None if days is None else GoalHistory(seconds=days * DAY)
    store = SqliteStore(path, sync=sync, history=history)
    for server in servers:
        if server.store is None:
            server.keep_in(store)


async def serve_servers(
    servers: Sequence[AnyServer],
    urls: Sequence[str],
    *,
    metrics: str | None = None,
    record: str | None = None,
    drain: float = 0,
    same: float | None = None,
    at_end: Callable[[], None],
) -> int:
    """Serve until a signal comes, then let the goals end and tell their clients.

    With `metrics`, an address, metrics are served there, and with `record` everything is recorded
    in that file. With `drain`, goals have so many seconds to end by themselves. A signal within
    `same` seconds of the first one is ignored: see `stop_signals`.
    `at_end` is called when all servers have stopped.
    """
    async with AsyncExitStack() as stack:
        stop = await stack.enter_async_context(stop_signals(same))
        if metrics is not None:
            await stack.enter_async_context(metrics_of(servers, metrics))
        if record is not None:
            stack.enter_context(recorded(servers, record))
        transports = [transport_for(url) for url in urls]
        where = await stack.enter_async_context(served(servers, *transports))
        there = map(_with_names, where, transports, repeat(servers))
        say(f"serving {names_of(servers)} at {', '.join(there)}, Ctrl-C stops it")
        with rare_collections():
            await stop.wait()
        if drain:
            logger.info("new goals are rejected, and those that run have %g s to end", drain)
            async with anyio.create_task_group() as tasks:
                for server in servers:
                    tasks.start_soon(partial(server.drain, drain, together=servers))
    at_end()
    return ExitCode.SUCCEEDED


def _with_names(url: str, transport: Transport, servers: Sequence[AnyServer]) -> str:
    """Return a URL, with the names of the actions that have others there."""
    names = [server.action.name for server in servers]
    others = [other for name in names if (other := transport.served_as(name)) != name]
    return f"{url} as {', '.join(map(excerpt, others))}" if others else url


@contextmanager
def rare_collections() -> Generator[None, None, None]:
    """Collect garbage less often during the block.

    With 10,000 active goals a full collection stops all for 0.1 s or more. What fibaction makes is
    freed without one, so collections are for the executors.
    """
    before = gc.get_threshold()
    gc.collect()
    gc.freeze()  # what was imported stays
    gc.set_threshold(*COLLECTIONS)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


@asynccontextmanager
async def served(
    servers: Sequence[AnyServer], *urls: str | Transport
) -> AsyncGenerator[tuple[str, ...], None]:
    """Run `fibaction.serve` during the block, and log each change of a goal's status."""
    async with serve(servers, *urls) as where, anyio.create_task_group() as tasks:
        log_events()  # not sooner: if it cannot serve, it is of no interest that servers stop
        for server in servers:
            tasks.start_soon(_log_goals, server.action.name, await server.status())
        yield where
        # Ends the streams of statuses too, after the last status, and with them the tasks above.
        for server in servers:
            tasks.start_soon(server.stop)


async def _log_goals(action: str, changes: StatusStream) -> None:
    with changes:
        while (goal := await changes.receive()) is not None:
            if goal.status is not GoalStatus.UNKNOWN:  # its end was logged before
                logger.info("goal %s of action %r: %s", goal.goal_id, action, goal.status.name)


@asynccontextmanager
async def metrics_of(servers: Sequence[AnyServer], address: str) -> AsyncGenerator[None, None]:
    """Serve the metrics of servers during the block, in which they are started.

    Raises:
        Failure: The address cannot be used, or prometheus-client is not installed.
    """
    check_installed("prometheus_client", "--metrics", "metrics")
    counts = Metrics()
    for server in servers:
        server.watch_by([counts])
    try:
        serving = serve_metrics(counts, address, servers)
    except ValueError as exc:
        raise Failure(str(exc)) from exc
    async with serving as url:
        say(f"metrics at {url}")
        yield


@contextmanager
def recorded(servers: Sequence[AnyServer], path: str) -> Generator[None, None, None]:
    """Record the goals of servers during the block, in which they are started.

    Raises:
        Failure: The file cannot be written to.
    """
    try:
        recorder = Recorder(path)
    except OSError as exc:
        raise Failure(f"cannot record to {path}: {exc.strerror}") from exc
    with recorder:
        for server in servers:
            server.watch_by([recorder])
        yield
