"""The verbs in one group, and what they share: the server's URL, and how it is reached.

The module of a verb is imported only when that verb is used, so that help and completion are there
at once.
"""

from __future__ import annotations

import difflib
import errno
import logging
import sys
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from io import TextIOWrapper
from typing import Any, NoReturn, TypeVar

import anyio
import click

from fibaction._api import ClientConnection
from fibaction.action import ActionInfo
from fibaction.cli.ending import ExitCode, Failure, debugging, telling_errors
from fibaction.cli.escaping import CleanFormatter, clean
from fibaction.cli.output import LogHandler
from fibaction.urls import without_settings

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
    "serve": ("fibaction.cli.serving", "serve_command", "Run your action servers."),
    "bridge": (
        "fibaction.cli.bridging",
        "bridge_command",
        "Serve at one URL what is at another.",
    ),
    "gen": ("fibaction.cli.gen", "gen_command", "Write Python types for an .action file."),
}
"""Each verb: its module, the name of its command in there, and what it is for."""

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""What writing ends with where there is no more room."""


# For the modules of the verbs


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


def run(
    verb: Callable[..., Awaitable[int]], *arguments: Any, uvloop: bool = False, **settings: Any
) -> NoReturn:
    """Run a verb's async function to its end, and exit with the code that it gives. With `uvloop`
    that is done by uvloop, where it is installed: it is quicker, but not at once.

    Raises:
        click.exceptions.Exit: It ended.
    """
    options = {"use_uvloop": uvloop and find_spec("uvloop") is not None}
    verb = partial(verb, *arguments, **settings)
    raise click.exceptions.Exit(anyio.run(verb, backend_options=options))


def url_of(context: click.Context) -> str:
    """The URL that counts for a verb: its own --url, or the one before the verb."""
    return context.params.get("url") or context.find_root().params.get("url") or URL


def refuse_inproc(*urls: str) -> None:
    """Refuse to use these URLs if no other process can be reached by any of them.

    Raises:
        Failure: So it is.
    """
    if all(url.startswith("inproc://") for url in urls):
        raise Failure(
            f"{without_settings(urls[0])} is for clients in the process of the server:"
            f" between processes, use tcp:// or unix://",
            ExitCode.USAGE,
        )


def _url_to_reach(context: click.Context, _: click.Parameter, value: str | None) -> str:
    url = value or url_of(context)
    refuse_inproc(url)
    return url


def url_option(function: FunctionT) -> FunctionT:
    """`--url` behind a verb; the function gets `url`, which is the group's if it is not given."""
    return click.option(
        "-u",
        "--url",
        metavar="URL",
        callback=_url_to_reach,
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

    def invoke(self, ctx: click.Context) -> Any:
        with telling_errors():
            return super().invoke(ctx)


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
    handler = LogHandler()
    handler.setFormatter(CleanFormatter("fibaction: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # What cannot be shown, because of the terminal's encoding, is shown as a number.
            stream.reconfigure(errors="backslashreplace")
    try:
        cli.main(prog_name="fibaction")
    except Exception as exc:
        if debugging():
            raise
        if isinstance(exc, OSError) and exc.errno in _FULL:
            sys.stderr.write(f"Error: the output cannot be written: {exc.strerror}\n")
            sys.exit(ExitCode.ABORTED)  # as click does if the output is a pipe that was closed
        text = clean(f"{type(exc).__name__}: {exc}")
        sys.stderr.write(f"Error: {text} (this is a bug; FIBACTION_DEBUG=1 shows where)\n")
        sys.exit(ExitCode.BUG)
