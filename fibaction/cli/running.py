"""`fibaction serve` and `fibaction bridge`: what runs until a signal comes.

Neither has logic of its own: both are `fibaction.serve`, of what a module of the user's has, or of
what another server has.
"""

from __future__ import annotations

import inspect
import logging
import os
import pkgutil
import signal
import sys
import traceback
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, Iterable, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from signal import SIGINT, SIGTERM
from types import ModuleType
from typing import Any, NamedTuple, NoReturn

import anyio
import click

from fibaction.abc import Connection, Endpoint, StatusStream
from fibaction.action import ActionInfo
from fibaction.background import Background
from fibaction.cli.app import (
    ExitCode,
    Failure,
    connected,
    failure_of,
    nearest,
    no_action,
    shown,
    url_of,
)
from fibaction.cli.output import note, say
from fibaction.exceptions import ActionError, ServerNotFound, TransportError
from fibaction.server import ActionServer
from fibaction.serving import serve
from fibaction.states import GoalStatus

LOOK_PAUSE = 0.2
"""Seconds between two looks whether an action is there that a bridge waits for."""
SAME_SIGNAL = 0.1
"""Seconds within which a second signal is the first again: some, such as `timeout`, signal a
process and then its group. Nobody types Ctrl-C twice as fast as that."""

AnyServer = ActionServer[Any, Any, Any]

logger = logging.getLogger(__name__)


# serve


@click.command(
    "serve",
    epilog="""\b
Examples:
  fibaction serve robot:server
  fibaction serve robot:make_servers tcp://127.0.0.1:7400 unix:///run/robot.sock ros2://
  fibaction serve robot:server --reload""",
)
@click.argument("target", metavar="MODULE:SERVER")
@click.argument("urls", metavar="[URL]...", nargs=-1)
@click.option("--reload", is_flag=True, help="Start again when the module's .py files change.")
@click.pass_context
def serve_command(context: click.Context, target: str, urls: tuple[str, ...], reload: bool) -> None:
    """Run the action servers of a module of yours, at one URL or at several at once.

    SERVER is an ActionServer, a list of several, or a function without arguments that gives them.
    The module is looked for in the current folder first.

    Ctrl-C or SIGTERM ends all goals, tells their clients and stops. A second one ends at once.
    """
    where = urls or (url_of(context),)
    with logging_to_stderr(), telling_errors():
        if reload:
            from fibaction.cli.reloading import serve_reloading

            run_until_stopped(serve_reloading, target, where)
        run_until_stopped(serve_servers, load(target), where)


async def serve_servers(servers: Sequence[AnyServer], urls: Sequence[str]) -> int:
    """Serve until a signal comes, then let the goals end and tell their clients."""
    async with stop_signals() as stop, serving(servers, *urls) as where:
        say(f"serving {names_of(servers)} at {', '.join(where)}, Ctrl-C stops it")
        await stop.wait()
    return ExitCode.SUCCEEDED


@asynccontextmanager
async def serving(
    servers: Sequence[AnyServer], *urls: str
) -> AsyncGenerator[tuple[str, ...], None]:
    """`fibaction.serve`, with a line in the log for each change of a goal's status."""
    async with serve(servers, *urls) as where, anyio.create_task_group() as tasks:
        for server in servers:
            tasks.start_soon(_log_goals, server.action.name, await server.status())
        yield where
        # Ends the streams of statuses too, behind the last one, and with them the tasks above.
        for server in servers:
            tasks.start_soon(server.stop)


async def _log_goals(action: str, changes: StatusStream) -> None:
    with changes:
        while (goal := await changes.receive()) is not None:
            if goal.status is not GoalStatus.UNKNOWN:  # it was logged when it ended
                logger.info("goal %s of action %r: %s", goal.goal_id, action, goal.status.name)


def names_of(endpoints: Iterable[Endpoint]) -> str:
    """The names of actions, as one text."""
    return ", ".join(shown(endpoint.info.name) for endpoint in endpoints)


# The user's module


class Target(NamedTuple):
    """What `module:server` says."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.module}:{self.attribute}"


def parse(target: str) -> Target:
    """Take `module:server` apart.

    Raises:
        Failure: It is something else.
    """
    path, _, attribute = target.partition(":")
    module = path.removesuffix(".py").strip("/").removeprefix("./").replace("/", ".")
    names = [*module.split("."), *attribute.split(".")]
    if all(name.isidentifier() for name in names) and module == path:
        return Target(module, attribute)
    near = f"{module}:{attribute or 'server'}"
    hint = f"; did you mean {near}?" if all(map(str.isidentifier, module.split("."))) else ""
    raise Failure(f"{target!r} is not written as module:server{hint}", ExitCode.USAGE)


def load(target: str) -> list[AnyServer]:
    """Import the module, from the current folder or from where else Python finds it, and take the
    servers from it.

    Raises:
        Failure: That cannot be done; the text says why, and what may have been meant.
    """
    found = parse(target)
    add_current_folder()
    try:
        module = import_module(found.module)
    except ModuleNotFoundError as exc:
        if f"{found.module}.".startswith(f"{exc.name}."):
            raise no_module(found.module) from exc
        raise _broken(found, exc) from exc
    except Exception as exc:  # whatever the user's module does
        raise _broken(found, exc) from exc
    value = _attribute(found, module)
    return _servers_in(found, module, _called(found, module, value))


def add_current_folder() -> None:
    """Let Python find modules in the current folder, as it does for `python -m`."""
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)


def no_module(name: str) -> Failure:
    """What to say of a module that is not there, with the nearest that is."""
    *parents, last = name.split(".")
    paths: Iterable[str] = [str(Path.cwd())]
    for depth in range(len(parents)):
        # Those that were imported: the first that was not is the one that is missing.
        parent = sys.modules.get(".".join(parents[: depth + 1]))
        if parent is None:
            parents, last = parents[:depth], parents[depth]
            break
        paths = getattr(parent, "__path__", ())
    known = [found.name for found in pkgutil.iter_modules(paths)]
    text = f"there is no module {'.'.join([*parents, last])!r}"
    if near := nearest(last, known):
        text += f"; did you mean {'.'.join([*parents, near])}?"
    elif not parents:
        text += f" in {Path.cwd()}, nor installed"
    return Failure(text, ExitCode.USAGE)


def _attribute(target: Target, module: ModuleType) -> Any:
    value: Any = module
    for name in target.attribute.split("."):
        if not hasattr(value, name):
            servers = _servers_of(value)
            public = [known for known in dir(value) if not known.startswith("_")]
            text = f"{target.module} has no {target.attribute!r}"
            if near := nearest(name, servers) or nearest(name, public):
                text += f"; did you mean {target.module}:{near}?"
            elif servers:
                text += f"; there is {', '.join(servers)}"
            raise Failure(text, ExitCode.USAGE)
        value = getattr(value, name)
    return value


def _servers_of(module: Any) -> list[str]:
    """The names of the servers in a module."""
    names: dict[str, object] = getattr(module, "__dict__", {})
    return [name for name, value in names.items() if isinstance(value, ActionServer)]


def _called(target: Target, module: ModuleType, value: Any) -> Any:
    """What the user's function gives; anything else as it is."""
    if issubclass(type(value), ActionServer) or not callable(value):
        return value
    if inspect.iscoroutinefunction(value) or inspect.isasyncgenfunction(value):
        text = "is an async function, and not an ActionServer or what gives one"
        raise _no_server(target, module, text)
    with suppress(ValueError):  # some of what is built in does not say what it takes
        try:
            inspect.signature(value).bind()
        except TypeError as exc:
            text = f"cannot be called without arguments: {exc}"
            raise _no_server(target, module, text) from exc
    try:
        return value()
    except Exception as exc:  # whatever the user's function does
        raise _broken(target, exc) from exc


def _servers_in(target: Target, module: ModuleType, value: Any) -> list[AnyServer]:
    several = issubclass(type(value), list | tuple)
    found: list[Any] = list(value) if several else [value]
    wrong = [type(one).__name__ for one in found if not isinstance(one, ActionServer)]
    if wrong or not found:
        place = "in the list " if several else ""
        what = f"gives {place}something of type {wrong[0]}" if wrong else "gives nothing"
        raise _no_server(target, module, f"{what}, and not an ActionServer or several")
    return found


def _no_server(target: Target, module: ModuleType, text: str) -> Failure:
    """What to say of something that is no server, with those that the module has."""
    others = [f"{target.module}:{name}" for name in _servers_of(module)]
    there = f"; there is {', '.join(others)}" if others else ""
    return Failure(f"{target} {text}{there}", ExitCode.USAGE)


def _broken(target: Target, error: Exception) -> Failure:
    """What to say of an exception of the user's code: where it was, and what."""
    file, line, text = "", 0, str(error)
    if isinstance(error, SyntaxError) and error.filename:
        file, line, text = error.filename, error.lineno or 0, error.msg
    else:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if Path(frame.filename).is_relative_to(Path.cwd())]
        for frame in (own or frames)[-1:]:
            file, line = frame.filename, frame.lineno or 0
    with suppress(ValueError):
        file = str(Path(file).relative_to(Path.cwd()))
    said = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return Failure(f"{target}: {file}, line {line}: {said}", ExitCode.USAGE)


# bridge


@click.command(
    "bridge",
    epilog="""\b
Examples:
  fibaction bridge ros2:// tcp://127.0.0.1:7400
  fibaction bridge tcp://127.0.0.1:7400 ros2:// fibonacci""",
)
@click.argument("from_url", metavar="FROM_URL")
@click.argument("to_url", metavar="TO_URL")
@click.argument("names", metavar="[NAME]...", nargs=-1)
def bridge_command(from_url: str, to_url: str, names: tuple[str, ...]) -> None:
    """Serve at TO_URL the actions that are served at FROM_URL.

    Without a NAME it is all that there are when the bridge starts. An action that is named is
    waited for. If the server is away for a while, the bridge goes on when it is back.

    Ctrl-C or SIGTERM ends the bridge; the goals go on at their server. A second one ends at once.
    """
    if from_url == to_url:
        raise Failure("a bridge from a URL to itself would lead nowhere", ExitCode.USAGE)
    with logging_to_stderr(), telling_errors():
        run_until_stopped(bridge, from_url, to_url, names)


async def bridge(from_url: str, to_url: str, names: Sequence[str]) -> int:
    """Serve what is at one URL at another, until a signal comes.

    Raises:
        Failure: There is nothing to serve.
    """
    async with stop_signals() as stop, connected(from_url) as connection:
        infos = await _wait_for(names, connection, stop) if names else await connection.actions()
        if stop.is_set():
            return ExitCode.SUCCEEDED
        endpoints = list(_endpoints(connection, infos, choose=not names))
        if not endpoints:
            raise Failure(f"there is no action to bridge at {from_url}", ExitCode.UNREACHABLE)
        async with serve(endpoints, to_url) as (where,):
            say(f"bridging {names_of(endpoints)} from {from_url} to {where}, Ctrl-C stops it")
            await stop.wait()
    return ExitCode.SUCCEEDED


async def _wait_for(
    names: Sequence[str], connection: Connection, stop: anyio.Event
) -> list[ActionInfo]:
    """Wait until all that were named are there; an empty list if it is to stop before."""
    told = False
    while not stop.is_set():
        infos: list[ActionInfo] = []
        with suppress(ServerNotFound):
            infos = await connection.actions()
        known = {shown(info.name): info for info in infos}
        missing = [name for name in names if shown(name) not in known]
        if not missing:
            return list({shown(name): known[shown(name)] for name in names}.values())
        if not told:
            text = f"waiting for {', '.join(map(shown, missing))}"
            note(f"{no_action(missing[0], infos).message}: {text}" if infos else text)
            told = True
        with anyio.move_on_after(LOOK_PAUSE):
            await stop.wait()
    return []


def _endpoints(
    connection: Connection, infos: Iterable[ActionInfo], *, choose: bool
) -> Generator[Endpoint, None, None]:
    """The endpoints of actions; with `choose` without those that cannot be had here.

    Raises:
        TransportError: One cannot be had: ROS does not know its type.
    """
    for info in infos:
        try:
            yield connection.endpoint(info)
        except TransportError as exc:
            if not choose:
                raise
            note(f"{shown(info.name)} is left out: {exc}")


# Running until a signal comes


def run_until_stopped(verb: Callable[..., Awaitable[int]], *arguments: Any) -> NoReturn:
    """Run an async function with uvloop, where that is installed, and exit with its code.

    Raises:
        click.exceptions.Exit: It ended.
    """
    options = {"use_uvloop": find_spec("uvloop") is not None}
    raise click.exceptions.Exit(anyio.run(verb, *arguments, backend_options=options))


@contextmanager
def telling_errors() -> Generator[None, None, None]:
    """What `app.run` does about errors, and for what comes before the event loop, too: Ctrl-C may
    be typed while a module is imported.

    Raises:
        Failure: The block ended with an `ActionError`.
        click.exceptions.Exit: It was interrupted.
    """
    try:
        yield
    except ActionError as exc:
        raise failure_of(exc) from exc
    except KeyboardInterrupt:
        raise click.exceptions.Exit(ExitCode.INTERRUPTED) from None


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
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    logging.getLogger("watchfiles").setLevel(logging.WARNING)  # each change is told of here
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
