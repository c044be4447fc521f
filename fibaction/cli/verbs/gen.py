"""`fibaction gen`: the types of actions as a Python module or as a TypeScript module."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from fibaction._api import connect
from fibaction.action_files import InterfaceError, action_source, load_action
from fibaction.border.abc import Connection
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.import_target import import_servers
from fibaction.cli.arguments.names import no_action, shown
from fibaction.cli.arguments.options import reject_inproc, url_of
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import ExitCode, Failure, advising, run
from fibaction.interfaces.files import (
    InterfaceMessage,
    ServiceFile,
    read_interface,
    read_message,
    read_service,
)
from fibaction.interfaces.packages import SearchPath, ros_folders
from fibaction.interfaces.source import RobotSource, types_source
from fibaction.schema.typescript import typescript_source
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ConnectionLost, ServerNotFound, TransportError

_MESSAGE_TYPE = re.compile(r"\w+/(msg|srv)/\w+", re.ASCII)
_SEARCH = "FIBACTION_SEARCH"


def _url(context: click.Context, _: click.Parameter, value: str | None) -> str:
    return value or url_of(context)


@click.command(
    "gen",
    epilog="""\b
Examples:
  fibaction gen Fibonacci.action > fibonacci_types.py
  fibaction gen geometry_msgs/msg/Twist std_srvs/srv/Trigger -o robot_types.py
  fibaction gen NavigateToPose.action --search ~/ros2_ws/src -o navigate_types.py
  fibaction -u ros2:// gen --from-robot > robot.py
  fibaction -u dds:// gen --from-robot /arm/pick /arm/place -o arm.py
  fibaction gen --ts http://127.0.0.1:8080 -o robot_types.ts
  fibaction gen --ts robot:server -o robot_types.ts""",
)
@click.argument("sources", metavar="[FILE... | ACTION...]", nargs=-1)
@click.option(
    "--from-robot",
    is_flag=True,
    help="Write the types of all actions that a robot serves at --url, or of each ACTION.",
)
@click.option(
    "--ts",
    "is_typescript",
    is_flag=True,
    help="Write TypeScript. FILE may then be the URL of a server, or module:server.",
)
@click.option("-n", "--name", default="", help="The action's name.  [default: that of the file]")
@click.option(
    "-t",
    "--type",
    "type_name",
    default="",
    metavar="PKG/action/TYPE",
    help="The ROS 2 type.  [default: from the folders that the file lies in]",
)
@click.option(
    "-s",
    "--search",
    multiple=True,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="A folder with packages of nested messages, or .msg files; can be repeated.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The file to write, instead of stdout. It is not changed after an error.",
)
@click.option(
    "-u",
    "--url",
    metavar="URL",
    callback=_url,
    help="URL of the robot.  [as in fibaction --help]",
)
def gen_command(
    sources: tuple[str, ...],
    from_robot: bool,
    is_typescript: bool,
    name: str,
    type_name: str,
    search: tuple[Path, ...],
    output: Path | None,
    url: str,
) -> None:
    """Write the types of an .action FILE as a Python module, or as TypeScript with --ts.

    FILE may also be .msg and .srv files, and names such as geometry_msgs/msg/Twist: a node takes
    the classes and the services of the module in place of names.

    The Python module has a class for each message, which type checkers understand, and the action
    in capitals. Its lines may be long: run your formatter over it. The TypeScript module has the
    types for the JavaScript client, of all actions of a server if FILE names one.

    Nested messages are searched for next to the file, in its package and the packages next to that,
    in the folders of --search, and in those of ROS, if setup.bash has been sourced or ROS is
    installed in this virtual environment.

    With --from-robot, one Python module gets the types of a robot's actions: all of them where ROS
    and the packages of the types are installed (ros2://), and elsewhere (dds://) those whose files
    are found, and those that the robot tells. Types that cannot be written are listed on stderr.
    """
    if from_robot:
        if is_typescript or name or type_name or search:
            raise Failure(
                "--ts, --name, --type and --search are not for --from-robot: name the folders of"
                " interface files in FIBACTION_SEARCH"
            )
        reject_inproc(url)
        run(write_types_of_robot, url, sources, output)
    if sources and all(map(_is_message_type, sources)):
        if is_typescript or name or type_name:
            raise Failure("--ts, --name and --type are for .action files")
        return _write_message_types(sources, search, output)
    if len(sources) != 1:
        raise click.UsageError("give one FILE, or --from-robot")
    (source,) = sources
    if is_typescript and _is_server(source):
        if name or type_name or search:
            raise Failure(f"--name, --type and --search are for .action files, unlike {source}")
        run(write_types_of_server, source, output)
    _write_types_of_file(
        Path(source), output, is_typescript, name=name, type_name=type_name, search=search
    )


def _write_types_of_file(
    file: Path, output: Path | None, is_typescript: bool, **given: Any
) -> None:
    try:
        if is_typescript:
            text = typescript_source([load_action(file, **given).info])
        else:
            text = _imported(action_source(file, **given))
    except OSError as exc:
        raise Failure(f"{exc.filename or file}: {exc.strerror}") from exc
    except ValueError as exc:
        raise Failure(str(exc)) from exc
    write(text, output)


def _is_message_type(source: str) -> bool:
    return Path(source).suffix in (".msg", ".srv") or bool(_MESSAGE_TYPE.fullmatch(source))


def _write_message_types(
    sources: Sequence[str], search: Sequence[Path], output: Path | None
) -> None:
    folders = [*search, *map(Path, filter(None, os.environ.get(_SEARCH, "").split(os.pathsep)))]
    path = SearchPath((), folders, ros_folders())
    found: list[InterfaceMessage | ServiceFile] = []
    try:
        for source in sources:
            if not _MESSAGE_TYPE.fullmatch(source):
                found.append(read_interface(Path(source), folders))
            elif "/msg/" in source:
                found.append(read_message(source, path))
            else:
                found.append(read_service(source, path))
        text = _imported(types_source(found))
    except OSError as exc:
        raise Failure(f"{exc.filename}: {exc.strerror}") from exc
    except ValueError as exc:
        raise Failure(str(exc)) from exc
    write(text, output)


def _is_server(source: str) -> bool:
    return "://" in source or (":" in source and not Path(source).exists())


async def write_types_of_server(source: str, output: Path | None) -> int:
    """Write the TypeScript of all actions of a server, named by its URL or as module:server.

    Raises:
        Failure, ActionError: It cannot be reached or imported, or has no actions.
    """
    actions: list[ActionInfo]
    if "://" in source:
        async with connect(source) as connection:
            with advising("or give another URL"):
                actions = await connection.actions()
    else:
        actions = [server.info for server in import_servers(source)]
    if not actions:
        raise Failure(f"{source} serves no actions, so there are no types")
    write(typescript_source(actions), output)
    return ExitCode.SUCCEEDED


async def write_types_of_robot(url: str, names: Sequence[str], output: Path | None) -> int:
    """Write the types of the actions of a robot, or of those that are named.

    Remarks on stderr tell what cannot be written.

    Raises:
        Failure, ActionError: The robot cannot be reached, or a named action cannot be written, or
            none can.
    """
    source = RobotSource()
    problems: list[str] = []
    async with connect(url) as connection:
        for info in await _named(connection, names):
            try:
                texts = await connection.interface_texts(info)
                source.add(info.name, info.type_name, texts)
            except InterfaceError as exc:
                advice = f"write it alone, with --from-robot {shown(info.name)}"
                problems.append(f"{shown(info.name)} is not written: {exc}; {advice}")
            except (ConnectionLost, ServerNotFound):
                raise
            except TransportError as exc:
                problems.append(f"{shown(info.name)} is not written: {exc}")
    for problem in problems:
        note(problem)
    if problems and (names or not source):
        raise Failure("nothing is written, because types are not known")
    if not source:
        raise Failure(f"{without_settings(url)} serves no actions", ExitCode.UNREACHABLE)
    write(_imported(source.source()), output)
    return ExitCode.SUCCEEDED


async def _named(connection: Connection, names: Sequence[str]) -> list[ActionInfo]:
    """Return the actions of these names, or all if there are none.

    Raises:
        Failure: An action is not served.
    """
    found = {shown(info.name): info for info in await connection.actions()}
    if missing := [name for name in names if shown(name) not in found]:
        raise no_action(missing[0], found.values())
    return [found[one] for one in dict.fromkeys(map(shown, names))] or list(found.values())


def _imported(source: str) -> str:
    """Return the source of a module, after a run of it, so that who imports it can rely on that."""
    code = compile(source, "the generated module", "exec", dont_inherit=True)
    exec(code, {"__name__": "generated"})
    return source


def write(text: str, output: Path | None) -> None:
    """Write a text to a file, or to stdout.

    Raises:
        Failure: The file cannot be written.
    """
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise Failure(f"{output}: {exc.strerror}") from exc
