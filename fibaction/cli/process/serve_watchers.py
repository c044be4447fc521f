"""The watchers of `fibaction serve`: metrics and a recording."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Generator, Sequence
from contextlib import asynccontextmanager, contextmanager

from fibaction.cli.arguments.import_target import AnyServer
from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.observe.metrics import Metrics
from fibaction.observe.metrics_server import serve_metrics
from fibaction.observe.recordings.recorder import Recorder


@asynccontextmanager
async def metrics_of(servers: Sequence[AnyServer], address: str) -> AsyncGenerator[None, None]:
    """Serve the metrics of servers during the block, in which they are started.

    Raises:
        Failure: The address cannot be used, or prometheus-client is not installed.
    """
    try:
        counts = Metrics()
    except ImportError as exc:
        needs = "--metrics needs prometheus-client: pip install 'fibaction[metrics]'"
        raise Failure(needs, ExitCode.USAGE) from exc
    for server in servers:
        server.watch_by([counts])
    try:
        serving = serve_metrics(counts, address, servers)
    except ValueError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
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
        raise Failure(f"cannot record to {path}: {exc.strerror}", ExitCode.USAGE) from exc
    with recorder:
        for server in servers:
            server.watch_by([recorder])
        yield
