"""The group of verbs, `fibaction --help`, and the main function.

The module of a verb is imported only when that verb is used, so that help and completion start
quickly.
"""

from __future__ import annotations

import errno
import logging
import signal
import sys
from collections.abc import Iterable
from importlib import import_module
from io import TextIOWrapper
from typing import Any

import click

from fibaction.cli.arguments.options import ADDRESS, URL
from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import CleanFormatter, LogHandler
from fibaction.cli.process.exit_at_once import exit_at_once
from fibaction.cli.process.exit_codes import ExitCode, debugging, report_errors

GROUPS = {
    "Serve": {
        "serve": ("serve", "serve_command", "Run your action servers."),
        "console": ("bridge", "console_command", "Operate actions in the browser."),
        "bridge": ("bridge", "bridge_command", "Serve the actions of one URL at another."),
        "broker": ("brokers", "broker_command", "Run a broker for a fleet on this machine."),
        "router": ("brokers", "router_command", "Run a router of Zenoh, for zenoh://."),
        "mcp": ("serve_mcp", "mcp_command", "Serve actions as tools of language models."),
    },
    "Send and follow goals": {
        "send_goal": ("send_goal", "send_goal_command", "Send a goal, and follow it."),
        "attach": ("follow", "attach_command", "Follow a goal that was sent before."),
        "cancel": ("levers", "cancel_command", "Cancel goals of any client."),
        "goals": ("list_goals", "goals_command", "List goals and their statuses."),
        "echo": ("follow", "echo_command", "Print every status and feedback of an action."),
        "top": ("overview", "top_command", "Watch all actions and goals on a live screen."),
        "stats": ("overview", "stats_command", "Count goals, failures, and how long they take."),
    },
    "Operate": {
        "pause": ("levers", "pause_command", "Let no new goal begin, or be accepted."),
        "resume": ("levers", "resume_command", "Take goals again after a pause or a drain."),
        "drain": ("levers", "drain_command", "Let a server or a worker run empty."),
    },
    "Find and describe actions": {
        "list": ("actions", "list_command", "List the actions that are served."),
        "info": (
            "actions",
            "info_command",
            "Show the servers and the clients of an action.",
        ),
        "type": ("actions", "type_command", "Print the type of an action."),
        "find": ("actions", "find_command", "List the actions of a type."),
        "workers": ("actions", "workers_command", "List the workers of a fleet."),
    },
    "Check a connection": {
        "wait": ("checks", "wait_command", "Wait until an action is served."),
        "ping": ("checks", "ping_command", "Measure the round trip to a server."),
        "doctor": ("checks", "doctor_command", "Say why nothing is found."),
    },
    "ROS beside actions": {
        "topic": ("topics", "topic_command", "List, read, measure and publish topics."),
        "service": ("services", "service_command", "List and call services."),
        "param": ("services", "param_command", "List, read and set parameters of nodes."),
    },
    "Record and replay": {
        "record": ("recordings", "record_command", "Record the goals of a server from outside."),
        "replay": ("recordings", "replay_command", "Answer goals from a recording."),
        "show": ("recordings", "show_command", "Summarise a recording."),
        "export": ("recordings", "export_command", "Write a recording as an MCAP file."),
    },
    "Files": {
        "gen": ("gen", "gen_command", "Write Python types for .action files or a robot."),
        "store": ("store", "store_command", "Back up the file in which a server keeps its goals."),
    },
}
"""The sections of the help, by what a user wants, each with its verbs; of each verb: its module in
`fibaction.cli.verbs`, the name of its command there, and its short help."""

VERBS = {verb: described for verbs in GROUPS.values() for verb, described in verbs.items()}

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""The errors of a write for which there is no room."""


class Verbs(click.Group):
    """The verbs of `VERBS`. A `-` in a verb is read as `_`."""

    def __init__(self, **settings: Any) -> None:
        stubs = {name: click.Command(name, short_help=use) for name, (_, _, use) in VERBS.items()}
        super().__init__(commands=stubs, **settings)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, VERBS))  # the same column in all sections
        for title, verbs in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(verb.ljust(width), use) for verb, (_, _, use) in verbs.items()]
                )

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        verb = args[0] if args[0].startswith("-") else args[0].replace("-", "_")
        name, command, rest = super().resolve_command(ctx, [verb, *args[1:]])
        if command is not None:
            module, attribute, _ = VERBS[command.name or ""]
            command = getattr(import_module(f"fibaction.cli.verbs.{module}"), attribute)
            if signal.getsignal(signal.SIGINT) is exit_at_once:
                # From here on a verb may have something to clean up.
                signal.signal(signal.SIGINT, signal.default_int_handler)
        return name, command, rest

    def invoke(self, ctx: click.Context) -> Any:
        with report_errors():
            return super().invoke(ctx)


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="""\b
Examples:
  fibaction serve robot:server
  fibaction send_goal fibonacci "order: 10" -f
  fibaction -u ros2:// info fibonacci

\b
Exit codes of goals: 0 succeeded, 1 aborted, 3 canceled, 4 rejected, 5 timed out.
Other exit codes: 2 wrong usage, 6 no such server, or the connection was lost.

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
    help="URL of the server: tcp://, unix://, nats://, ros2:// and others.",
)
@click.option(
    "-c",
    "--connection",
    "address",
    metavar="NAME",
    type=ADDRESS,
    help="Name of a server in your configuration file, instead of its URL.",
)
@click.version_option(package_name="fibaction", message="fibaction %(version)s")
@click.pass_context
def cli(context: click.Context, url: str, address: str | None) -> None:
    """Serve functions that take a while, and call, follow and cancel them.

    They are actions, as in ROS 2, which you need only for ros2:// URLs.
    """
    source = context.get_parameter_source("url")
    if address is not None and source is click.core.ParameterSource.COMMANDLINE:
        raise click.UsageError("the server is given twice: by --connection and by --url")


def without_ros_args(arguments: Iterable[str]) -> list[str]:
    """Return the arguments that are not for ROS 2.

    Those for ROS 2, which `ros2 run` and `ros2 launch` add, go from `--ros-args` to `--` or to the
    end, may come several times, and are read by the node from the command line of the process:
    https://design.ros2.org/articles/ros_command_line_arguments.html
    """
    own: list[str] = []
    is_for_ros = False
    for argument in arguments:
        if argument == "--ros-args":
            is_for_ros = True
        elif not is_for_ros:
            own.append(argument)
        elif argument == "--":
            is_for_ros = False
    return own


def main() -> None:
    """Run the command line, and exit with its code. An error is one sentence on stderr."""
    handler = LogHandler()
    handler.setFormatter(CleanFormatter("fibaction: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # A character that the terminal's encoding does not have is printed as a number.
            stream.reconfigure(errors="backslashreplace")
    try:
        cli.main(without_ros_args(sys.argv[1:]), prog_name="fibaction")
    except Exception as exc:
        if debugging():
            raise
        if isinstance(exc, OSError) and exc.errno in _NO_ROOM:
            sys.stderr.write(f"Error: the output cannot be written: {exc.strerror}\n")
            sys.exit(ExitCode.ABORTED)  # as click does if the output is a pipe that was closed
        text = clean(f"{type(exc).__name__}: {exc}")
        sys.stderr.write(f"Error: {text} (this is a bug; FIBACTION_DEBUG=1 shows where)\n")
        sys.exit(ExitCode.BUG)
