"""The verbs in one group, and what all of them share: the server's URL, exit codes, errors.

The module of a verb is imported only when that verb is used, so that help and completion are there
at once.
"""

from __future__ import annotations

import difflib
import logging
import os
import sys
import traceback
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from enum import IntEnum
from functools import partial
from importlib import import_module
from io import TextIOWrapper
from typing import IO, Any, TypeVar, cast

import anyio
import click

from fibaction.action import ActionInfo
from fibaction.connection import ClientConnection, connect
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    ProtocolError,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

URL = "tcp://127.0.0.1:7400"
"""Where a server is if nothing else is said; the TCP transport's own default."""

VERBS = {
    "list": ("fibaction.cli.listing", "list_command", "List the actions that are served."),
    "info": ("fibaction.cli.listing", "info_command", "Say who serves an action, and who uses it."),
    "type": ("fibaction.cli.listing", "type_command", "Say an action's type."),
    "find": ("fibaction.cli.listing", "find_command", "List the actions of a type."),
    "send_goal": ("fibaction.cli.sending", "send_goal_command", "Send a goal, and follow it."),
    "goals": ("fibaction.cli.watching", "goals_command", "List goals and their statuses."),
    "cancel": ("fibaction.cli.reaching", "cancel_command", "Cancel goals, whoever sent them."),
    "attach": ("fibaction.cli.reaching", "attach_command", "Follow a goal that was sent before."),
    "echo": ("fibaction.cli.watching", "echo_command", "Show all that happens at an action."),
    "top": ("fibaction.cli.top", "top_command", "Watch all actions and goals on a live screen."),
    "serve": ("fibaction.cli.running", "serve_command", "Run your action servers."),
    "bridge": (
        "fibaction.cli.running",
        "bridge_command",
        "Serve at one URL what is at another.",
    ),
    "gen": ("fibaction.cli.gen", "gen_command", "Write Python types for an .action file."),
}
"""Each verb: its module, the name of its command in there, and what it is for."""


class ExitCode(IntEnum):
    """What the shell is told."""

    SUCCEEDED = 0
    ABORTED = 1
    USAGE = 2
    CANCELED = 3
    REJECTED = 4
    TIMED_OUT = 5
    UNREACHABLE = 6
    """There is no such server or action, or the connection was lost."""
    BUG = 70
    """`EX_SOFTWARE` of `sysexits.h`: an error of fibaction itself."""
    INTERRUPTED = 130
    """As for a program that SIGINT has ended: Ctrl-C where no goal was to be canceled."""


_CODES: tuple[tuple[type[ActionError], ExitCode], ...] = (
    (GoalRejected, ExitCode.REJECTED),
    (GoalCanceled, ExitCode.CANCELED),
    (GoalAborted, ExitCode.ABORTED),
    (UnknownGoal, ExitCode.USAGE),
    (ServerNotFound, ExitCode.UNREACHABLE),
    (ConnectionLost, ExitCode.UNREACHABLE),
    (AuthenticationFailed, ExitCode.UNREACHABLE),
    (TransportError, ExitCode.USAGE),  # what is left of it: a URL that cannot be used
    (ProtocolError, ExitCode.UNREACHABLE),
)


class Failure(click.ClickException):
    """One sentence for the user on stderr, and the exit code."""

    def __init__(self, message: str, code: ExitCode) -> None:
        super().__init__(message)
        self.exit_code = code  # type: ignore[misc]  # click, too, looks at the instance

    def show(self, file: IO[str] | None = None) -> None:
        if debugging():
            traceback.print_exception(self)
        super().show(file)


def debugging() -> bool:
    """Whether tracebacks are wanted."""
    return bool(os.environ.get("FIBACTION_DEBUG"))


def failure_of(error: ActionError) -> Failure:
    """What the user is told of an error."""
    code = next((code for kind, code in _CODES if isinstance(error, kind)), ExitCode.ABORTED)
    # The advice is for programs; who types a command can do something else.
    text = str(error).replace(
        "or wait for it with wait_for_server()", "or name another with --url or FIBACTION_URL"
    )
    return Failure(text, code)


# For the modules of the verbs


@asynccontextmanager
async def connected(url: str) -> AsyncGenerator[ClientConnection, None]:
    """A connection to whatever the URL names, for as long as the block lasts.

    Raises:
        Failure: It cannot be had. Errors within the block are translated by `run`.
    """
    try:
        connecting = connect(url)
    except ActionError as exc:
        raise failure_of(exc) from exc
    async with connecting as connection:
        yield connection


async def find_action(connection: ClientConnection, name: str) -> ActionInfo:
    """The action of that name; a slash in front may be left out, or be too many.

    Raises:
        Failure: Nobody serves it. The code is `UNREACHABLE`, since whether a name is wrong or its
            server has not started cannot be told apart on a network of servers.
    """
    actions = await connection.actions()
    wanted = shown(name)
    for info in actions:
        if shown(info.name) == wanted:
            return info
    raise no_action(name, actions)


def no_action(name: str, actions: Iterable[ActionInfo]) -> Failure:
    """What to say of a name that nobody serves, with the nearest that somebody does."""
    known = sorted(shown(info.name) for info in actions)
    text = f"nobody serves the action {shown(name)}"
    if near := nearest(shown(name), known):
        text += f"; did you mean {near}?"
    elif known:
        some = known[:10]
        text += f"; there is {', '.join(some)}{', ...' if len(known) > len(some) else ''}"
    else:
        text += ", nor any other"
    return Failure(text, ExitCode.UNREACHABLE)


def shown(name: str) -> str:
    """An action's name as `ros2 action` shows it: with a slash in front."""
    return name if name.startswith(("/", "~")) else f"/{name}"


def nearest(word: str, known: Iterable[str]) -> str:
    """The known word that was probably meant; empty if none is near."""
    return next(iter(difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)), "")


def run(verb: Callable[..., Awaitable[int]], *arguments: Any, **settings: Any) -> None:
    """Run a verb's async function to its end, and exit with the code that it gives.

    Raises:
        Failure: It ended with an `ActionError`, alone or in a group.
        click.exceptions.Exit: It ended.
    """
    try:
        code = anyio.run(partial(verb, *arguments, **settings))
    except KeyboardInterrupt:
        code = ExitCode.INTERRUPTED
    except ActionError as exc:
        raise failure_of(exc) from exc
    except BaseExceptionGroup as group:
        raise _first(group) from group
    raise click.exceptions.Exit(code)


def _first(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """The error behind a group of tasks that ended with it: the first that is for the user."""
    errors = list(_leaves(group))
    for error in errors:
        if isinstance(error, ActionError):
            return failure_of(error)
        if isinstance(error, click.ClickException | OSError):  # OSError: a pipe that is closed
            return error
    return errors[0]


def _leaves(error: Any) -> Iterable[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for part in cast("BaseExceptionGroup[BaseException]", error).exceptions:
            yield from _leaves(part)
    else:
        yield error


def url_of(context: click.Context) -> str:
    """The URL that counts for a verb: its own --url, or the one before the verb."""
    return context.params.get("url") or context.find_root().params.get("url") or URL


def _url_of_group(context: click.Context, _: click.Parameter, value: str | None) -> str:
    return value or url_of(context)


def url_option(function: FunctionT) -> FunctionT:
    """`--url` behind a verb; the function gets `url`, which is the group's if it is not given."""
    return click.option(
        "-u",
        "--url",
        metavar="URL",
        callback=_url_of_group,
        help="Where the server is.  [as in fibaction --help]",
    )(function)


def json_option(function: FunctionT) -> FunctionT:
    """`--json`; the function gets `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON, one value per line.")(
        function
    )


# The group


class Verbs(click.Group):
    """The verbs, as they are described in `VERBS`; `-` in a verb is as good as `_`."""

    def __init__(self, **settings: Any) -> None:
        stubs = {name: click.Command(name, short_help=use) for name, (_, _, use) in VERBS.items()}
        super().__init__(commands=stubs, **settings)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        verb = args[0] if args[0].startswith("-") else args[0].replace("-", "_")
        name, command, rest = super().resolve_command(ctx, [verb, *args[1:]])
        if command is not None:
            module, attribute, _ = VERBS[command.name or ""]
            command = getattr(import_module(module), attribute)
        return name, command, rest


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="""\b
Examples:
  fibaction list -t
  fibaction send_goal fibonacci "order: 10" -f
  fibaction -u ros2:// info fibonacci

\b
Exit codes of goals: 0 succeeded, 1 aborted, 3 canceled, 4 rejected, 5 timed out.
Of all verbs: 2 the command line cannot be used, 6 no such server, or the connection was lost.

FIBACTION_DEBUG=1 shows the traceback of an error.""",
)
@click.option(
    "-u",
    "--url",
    metavar="URL",
    envvar="FIBACTION_URL",
    default=URL,
    show_default=True,
    show_envvar=True,
    help="Where the server is: tcp://, tls://, unix://, ros2:// and others.",
)
@click.version_option(package_name="fibaction", message="fibaction %(version)s")
def cli(url: str) -> None:
    """ROS 2 actions from the shell, with or without ROS."""


def main() -> None:
    """Run the command line, and exit with its code. An error is one sentence on stderr."""
    logging.basicConfig(level=logging.WARNING, format="fibaction: %(message)s")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # What cannot be shown, because of the terminal's encoding, is shown as a number.
            stream.reconfigure(errors="backslashreplace")
    try:
        cli.main(prog_name="fibaction")
    except Exception as exc:
        if debugging():
            raise
        sys.stderr.write(
            f"Error: {type(exc).__name__}: {exc} (this is a bug; FIBACTION_DEBUG=1 shows where)\n"
        )
        sys.exit(ExitCode.BUG)
