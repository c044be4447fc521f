"""`fibaction gen`: the types of actions as a Python module or as a TypeScript module."""

from __future__ import annotations

from pathlib import Path

import click

from fibaction._api import connect
from fibaction.cli.arguments.import_target import import_servers
from fibaction.cli.process.exit_codes import ExitCode, Failure, advising, run
from fibaction.interfaces.action_files import action_source, load_action
from fibaction.schema.typescript import typescript_source
from fibaction.types.action import ActionInfo


@click.command(
    "gen",
    epilog="""\b
Examples:
  fibaction gen Fibonacci.action > fibonacci_types.py
  fibaction gen NavigateToPose.action --search ~/ros2_ws/src -o navigate_types.py
  fibaction gen --ts http://127.0.0.1:8080 -o robot_types.ts
  fibaction gen --ts robot:server -o robot_types.ts""",
)
@click.argument("source", metavar="FILE")
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
def gen_command(
    source: str,
    is_typescript: bool,
    name: str,
    type_name: str,
    search: tuple[Path, ...],
    output: Path | None,
) -> None:
    """Write the types of an .action FILE as a Python module, or as TypeScript with --ts.

    The Python module has a class for each message, which type checkers understand, and the action
    in capitals. Its lines may be long: run your formatter over it. The TypeScript module has the
    types for the JavaScript client, of all actions of a server if FILE names one.

    Nested messages are searched for beside the file, in its package and the packages beside that,
    in the folders of --search, and in those of ROS, if setup.bash has been sourced or ROS is
    installed in this virtual environment.
    """
    if is_typescript and _is_server(source):
        if name or type_name or search:
            raise Failure(
                f"--name, --type and --search are for .action files, unlike {source}",
                ExitCode.USAGE,
            )
        run(write_types_of_server, source, output)
    file = Path(source)
    try:
        if is_typescript:
            action = load_action(file, name=name, search=search, type_name=type_name)
            text = typescript_source([action.info])
        else:
            text = action_source(file, name=name, search=search, type_name=type_name)
        write(text, output)
    except OSError as exc:
        raise Failure(f"{exc.filename or file}: {exc.strerror}", ExitCode.USAGE) from exc
    except ValueError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc


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
        raise Failure(f"{source} serves no actions, so there are no types", ExitCode.USAGE)
    try:
        write(typescript_source(actions), output)
    except OSError as exc:
        raise Failure(f"{exc.filename or output}: {exc.strerror}", ExitCode.USAGE) from exc
    return ExitCode.SUCCEEDED


def write(text: str, output: Path | None) -> None:
    """Write a text to a file, or to stdout."""
    if output is None:
        click.echo(text, nl=False)
    else:
        output.write_text(text, encoding="utf-8")
