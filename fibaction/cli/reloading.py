"""`fibaction serve --reload`: the servers run in a process that is started anew at each change.

This process keeps the URLs meanwhile. It bridges them to a Unix socket at which the other one
serves, so that clients stay connected, and a goal that is sent between two servers waits for the
next one. The other process is new each time: what the module before it had open is closed by then.
"""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import anyio
import click
from anyio.abc import Process

from fibaction._api import connect, serve
from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.action import ActionInfo
from fibaction.cli.app import run
from fibaction.cli.ending import ExitCode, Failure, telling_errors
from fibaction.cli.loading import AnyServer, add_current_folder, load, no_module, parse
from fibaction.cli.output import note, say
from fibaction.cli.running import logging_to_stderr, names_of, stop_signals
from fibaction.cli.serving import serving
from fibaction.exceptions import TransportError

READY = b"r"
"""What the process says when it serves."""
LAST_WORDS = 0.1
"""Seconds in which what the process has said last is passed on, before the URLs are left. It is in
this machine's memory by then, so this is long."""

_wire = logging.getLogger("fibaction.wire")
_START = (
    # Ctrl-C goes to all processes of a terminal, and it is the parent who says what comes of it.
    # A signal that is ignored would be ignored by what the user's module starts, too.
    "import signal\n"
    "for number in signal.SIGINT, signal.SIGTERM: signal.signal(number, lambda *_: None)\n"
    "from fibaction.cli.reloading import main\n"
    "main()"
)


# The process that keeps the URLs


async def serve_reloading(target: str, urls: Sequence[str]) -> int:
    """Serve until a signal comes, with a new process after each change of the module's folder.

    Raises:
        Failure: There is no such module, or what this needs is not installed.
    """
    if find_spec("watchfiles") is None:
        raise Failure("--reload needs watchfiles: pip install 'fibaction[reload]'", ExitCode.USAGE)
    if not hasattr(socket, "AF_UNIX"):
        raise Failure("--reload needs Unix sockets, and there are none here", ExitCode.USAGE)
    folder = folder_of(parse(target).module)
    with TemporaryDirectory(prefix="fibaction-") as private:
        inner = f"unix://{private}/socket"
        life = Life(target, inner, folder)
        with _without_lines_of(inner):
            async with stop_signals(life.kill) as stop, Background() as tasks:
                tasks.start_soon(life.go_on, stop)
                await _serve(life, inner, urls)
    return ExitCode.SUCCEEDED


async def _serve(life: Life, inner: str, urls: Sequence[str]) -> None:
    """Serve what the module has, and serve anew when it has other actions, or other types."""
    infos = await life.infos()
    async with connect(inner) as behind:
        while infos:
            endpoints = [behind.endpoint(info) for info in infos]
            async with serve(endpoints, *urls) as where:
                served = infos
                while infos == served:
                    say(f"serving {names_of(endpoints)} at {', '.join(where)}, Ctrl-C stops it")
                    infos = await life.infos()
                if not infos:
                    await anyio.sleep(LAST_WORDS)


class Life:
    """The processes that serve, one after the other."""

    def __init__(self, target: str, url: str, folder: Path) -> None:
        self._target = target
        self._url = url
        self._folder = folder
        self._process: Process | None = None
        self._infos: list[ActionInfo] | None = None
        self._news = Notifier()
        self._one = anyio.CancelScope()

    async def infos(self) -> list[ActionInfo]:
        """Wait until a process serves that was not told of yet, and give the actions that it has;
        an empty list if it is the end.
        """
        while self._infos is None:
            await self._news.wait()
        infos, self._infos = self._infos, None
        return infos

    async def go_on(self, stop: anyio.Event) -> None:
        """Start a process, and another one after each change, until it is to stop."""
        async with anyio.create_task_group() as tasks:
            over = anyio.Event()
            tasks.start_soon(self._follow_files, over)
            tasks.start_soon(self._follow_stop, stop)
            try:
                while not stop.is_set():
                    with anyio.CancelScope() as self._one:
                        await self._serve_once()
                        await anyio.sleep_forever()
            finally:
                over.set()
        self._tell([])

    def kill(self) -> None:
        """End the process at once, if there is one."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.kill()

    async def _follow_files(self, over: anyio.Event) -> None:
        import watchfiles

        def counts(change: watchfiles.Change, path: str) -> bool:
            return python(change, path) and "site-packages" not in Path(path).parts

        python = watchfiles.PythonFilter()
        # It waits in a thread, which looks at the event, but not whether this task is canceled.
        async for changes in watchfiles.awatch(self._folder, watch_filter=counts, stop_event=over):
            note(f"{_names((path for _, path in changes), self._folder)} changed: starting again")
            self._one.cancel()

    async def _follow_stop(self, stop: anyio.Event) -> None:
        await stop.wait()
        self._one.cancel()

    async def _serve_once(self) -> None:
        """Start a process, and wait for its end; if that is canceled, end it."""
        ours, theirs = socket.socketpair()
        with ours:
            with theirs:
                self._process = process = await self._start(theirs.fileno())
            try:
                await anyio.wait_readable(ours)
                if ours.recv(1):
                    await self._look()
                code = await process.wait()
            finally:
                ours.close()  # which is how it is asked to stop
                with anyio.CancelScope(shield=True):
                    await process.wait()
                self._process = None
            note(f"the servers have ended with exit code {code}: waiting for a change")

    async def _start(self, parent: int) -> Process:
        flags = [f"-W{one}" for one in sys.warnoptions]
        return await anyio.open_process(
            # -B: what Python keeps of a module may be taken for that of the next one, if both have
            # the same size and are of the same second.
            [sys.executable, "-B", *flags, "-c", _START, str(parent), self._target, self._url],
            stdin=None,
            stdout=None,
            stderr=None,
            pass_fds=(parent,),
        )

    async def _look(self) -> None:
        """See what the process serves."""
        with suppress(TransportError):  # it has ended again, which is told of elsewhere
            async with connect(self._url) as connection:
                self._tell(await connection.actions())

    def _tell(self, infos: list[ActionInfo]) -> None:
        self._infos = infos
        self._news.notify()


def folder_of(module: str) -> Path:
    """The folder whose files make up a module; of a package, the outermost.

    Raises:
        Failure: There is no such module.
    """
    add_current_folder()
    top = module.partition(".")[0]
    spec = find_spec(top)
    if spec is None:
        raise no_module(top)
    folders = list(spec.submodule_search_locations or ())
    if spec.has_location and spec.origin is not None:
        folders.append(str(Path(spec.origin).parent))
    if not folders:
        raise Failure(f"the module {top!r} has no folder that could change", ExitCode.USAGE)
    return Path(folders[0])


def _names(paths: Iterable[str], folder: Path) -> str:
    return ", ".join(sorted({str(Path(path).relative_to(folder)) for path in paths}))


@contextmanager
def _without_lines_of(inner: str) -> Generator[None, None, None]:
    """Leave out of the log what is said of the connection between the processes."""

    def is_for_users(record: logging.LogRecord) -> bool:
        return inner not in record.getMessage()

    _wire.addFilter(is_for_users)
    try:
        yield
    finally:
        _wire.removeFilter(is_for_users)


# The process that serves


@click.command(add_help_option=False)
@click.argument("parent", type=int)
@click.argument("target")
@click.argument("url")
def main(parent: int, target: str, url: str) -> None:
    """Be the process that serves, for the one at the other end of the socket with that number."""
    with telling_errors(), logging_to_stderr(), socket.socket(fileno=parent) as other:
        _wire.setLevel(logging.WARNING)  # its only client is the parent
        run(serve_for, other, load(target), url, uvloop=True)


async def serve_for(parent: socket.socket, servers: Sequence[AnyServer], url: str) -> int:
    """Serve until the parent closes its end of the socket, also by its own end."""
    async with serving(servers, url):
        parent.send(READY)
        await anyio.wait_readable(parent)
    return ExitCode.SUCCEEDED
