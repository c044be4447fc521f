"""`fibaction gen`: the types of an `.action` file as a Python module."""

from __future__ import annotations

from pathlib import Path

import click

from fibaction.action_files import action_source
from fibaction.cli.exit_codes import ExitCode, Failure


@click.command(
    "gen",
    epilog="""\b
Examples:
  fibaction gen Fibonacci.action > fibonacci_types.py
  fibaction gen NavigateToPose.action --search ~/ros2_ws/src -o navigate_types.py""",
)
@click.argument("file", type=click.Path(path_type=Path))
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
    file: Path, name: str, type_name: str, search: tuple[Path, ...], output: Path | None
) -> None:
    """Write the types of an .action FILE as a Python module.

    The module has a class for each message, which type checkers understand, and the action in
    capitals. Its lines may be long: run your formatter over it.

    Nested messages are searched for beside the file, in its package and the packages beside that,
    in the folders of --search, and in those of ROS, if setup.bash has been sourced or ROS is
    installed in this virtual environment.
    """
    try:
        source = action_source(file, name=name, search=search, type_name=type_name)
        if output is not None:
            output.write_text(source, encoding="utf-8")
    except OSError as exc:
        raise Failure(f"{exc.filename or file}: {exc.strerror}", ExitCode.USAGE) from exc
    except ValueError as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
    if output is None:
        click.echo(source, nl=False)
