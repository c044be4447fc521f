"""`fibaction serve --reload`: serve in a process that is started again at each change.

The process is `fibaction serve` without `--reload`, started by `watchfiles.run_process`. It serves
at the real URLs, prints what it serves and what is wrong with the module, and stops gracefully at
SIGINT. At a change it is stopped and the next one started; clients reconnect by themselves. If the
module has an error, the process ends with it, and the next change starts another one.

Ctrl-C in a terminal goes to both processes, and then this one stops the other: within `SAME_STOP`
seconds these are one signal. A second Ctrl-C ends the other process, and with it this one.
"""

from __future__ import annotations

import math
import os
import shlex
import signal
import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import NoReturn

import click

from fibaction.cli.arguments.import_target import add_current_folder, no_module, parse
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, report_errors

SAME_STOP = 1.0
"""Seconds within which the process that serves takes a second signal as the first again."""
STOP = 5
"""Seconds that the process has to stop, after its drain, before it is killed."""
PERIOD = 1.0
"""Seconds between two looks of that process for its parent."""


def run_reloading(
    target: str,
    urls: Sequence[str],
    default_url: str,
    options: Sequence[str] = (),
    drain: float = 0,
) -> NoReturn:
    """Serve until a signal comes, with a new process after each change in the module's folder.

    The process gets the `options` of `fibaction serve`, and `drain` seconds more to stop.

    Raises:
        Failure: There is no such module, watchfiles is not installed, or this is Windows.
        click.exceptions.Exit: A signal came.
    """
    check_installed("watchfiles", "--reload", "reload")
    if not hasattr(os, "fork"):
        needs = "--reload needs Linux or macOS: stop and start the server instead"
        raise Failure(needs)
    import watchfiles

    folder = folder_of(parse(target).module)
    python = watchfiles.PythonFilter()

    def counts(change: watchfiles.Change, path: str) -> bool:
        return python(change, path) and "site-packages" not in Path(path).parts

    def report(changes: Iterable[tuple[watchfiles.Change, str]]) -> None:
        names = sorted({str(Path(path).relative_to(folder)) for _, path in changes})
        note(f"{', '.join(names)} changed: starting again")

    signal.signal(signal.SIGINT, _interrupt_once)
    # Not as an argument, where a list of processes would show a token in it.
    os.environ["FIBACTION_URL"] = default_url
    watchfiles.run_process(
        folder,
        target=shlex.join(_command(target, urls, options)),
        target_type="command",
        watch_filter=counts,
        callback=report,
        sigint_timeout=math.ceil(drain) + STOP,
    )
    raise click.exceptions.Exit(ExitCode.SUCCEEDED)


def _interrupt_once(number: int, _frame: object) -> None:
    """Handle SIGINT as Python does, and ignore the next ones: the other process has them, too."""
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _command(target: str, urls: Sequence[str], options: Sequence[str]) -> list[str]:
    flags = [f"-W{one}" for one in sys.warnoptions]
    code = "from fibaction.cli import main; main()"
    # -B: a module's bytecode is taken for that of the next version, if both have the same size and
    # were written in the same second.
    python = [sys.executable, "-B", *flags, "-c", code]
    return [*python, "serve", "--started-by", str(os.getpid()), *options, "--", target, *urls]


def folder_of(module: str) -> Path:
    """Return the folder whose files make up a module; of a package, the outermost.

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
        raise Failure(f"the module {top!r} has no folder that could change")
    return Path(folders[0])


@contextmanager
def started_by(parent: int | None) -> Generator[None, None, None]:
    """Run the block as the process that serves for a parent with that ID, if there is one.

    An error is printed here, with a remark that the parent waits for a change.

    Raises:
        click.exceptions.Exit: The block has ended, for a parent.
    """
    if parent is None:
        yield
        return
    Thread(target=_stop_without, args=(parent,), daemon=True).start()
    try:
        with report_errors():
            yield
    except Failure as failure:
        failure.show()
        note("the servers have not started: waiting for a change")
        raise click.exceptions.Exit(failure.exit_code) from failure


def _stop_without(parent: int) -> None:
    """Stop this process gracefully when its parent has ended, and at once if that takes long."""
    pause = Event()
    while os.getppid() == parent:
        pause.wait(PERIOD)
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGTERM)
        pause.wait(10 * SAME_STOP)
