"""Servers from a module of the user's: how they are named, and what may be wrong."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fibaction.cli.arguments import import_target
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.conftest import Invoke

NO_SERVER = "and not an ActionServer or several; there is robot:server"
ASYNC = "is an async function, and not an ActionServer or what gives one; there is robot:server"
NO_ARGUMENTS = "cannot be called without arguments: missing"
NO_MODULE = "is not written as module:server"


@pytest.mark.parametrize(
    ("target", "error"),
    [
        ("robot", f"'robot' {NO_MODULE}; did you mean robot:server?"),
        ("./arm/robot.py:x", f"'./arm/robot.py:x' {NO_MODULE}; did you mean arm.robot:x?"),
        (":server", f"':server' {NO_MODULE}"),
        ("robott:server", "there is no module 'robott'; did you mean robot?"),
        ("robot.arm:server", "there is no module 'robot.arm'"),
        ("package.servr:x", "there is no module 'package.servr'; did you mean package.server?"),
        ("zzz.servr:x", "there is no module 'zzz' in {folder}, nor installed"),
        ("robot:servr", "robot has no 'servr'; did you mean robot:server?"),
        ("robot:zzz", "robot has no 'zzz'; there is server"),
        ("robot:nested.zzz", "robot has no 'nested.zzz'; there is server"),
        ("robot:number.zzz", "robot has no 'number.zzz'"),
        ("package.server:zzz", "package.server has no 'zzz'"),
        ("package.server:x", "package.server:x gives nothing, and not an ActionServer or several"),
        ("robot:number", f"robot:number gives something of type int, {NO_SERVER}"),
        ("robot:empty", f"robot:empty gives nothing, {NO_SERVER}"),
        ("robot:mixed", f"robot:mixed gives in the list something of type int, {NO_SERVER}"),
        ("robot:make_nothing", f"robot:make_nothing gives something of type NoneType, {NO_SERVER}"),
        (
            "robot:make_one",
            f"robot:make_one {NO_ARGUMENTS} a required argument: 'name'; there is robot:server",
        ),
        ("robot:count", f"robot:count {ASYNC}"),
        ("robot:make_later", f"robot:make_later {ASYNC}"),
        ("robot:fail", "robot:fail: robot.py, line 67: RuntimeError: the arm is not plugged in"),
        ("wrong:server", "wrong:server: wrong.py, line 2: SyntaxError: '(' was never closed"),
        (
            "needs:server",
            "needs:server: needs.py, line 1: ModuleNotFoundError: No module named 'no_such_thing'",
        ),
        ("stops:server", "stops:server: stops.py, line 1: AssertionError"),
        ("asks:server", "asks:server: asks.py, line 1: SystemError: no arm: plug it in"),
    ],
)
def test_what_cannot_be_served_is_one_sentence(
    folder: Path, invoke: Invoke, target: str, error: str
) -> None:
    (folder / "wrong.py").write_text("\nprint(\n")
    (folder / "needs.py").write_text("import no_such_thing\n")
    (folder / "stops.py").write_text("assert False\n")
    (folder / "asks.py").write_text("raise SystemError('no arm:\\n  plug it in')\n")
    (folder / "package").mkdir()
    (folder / "package" / "__init__.py").touch()
    (folder / "package" / "server.py").write_text("x = []")
    result = invoke("serve", target, f"unix://{folder}/socket")

    assert result.exit_code == ExitCode.USAGE
    assert result.stdout == ""
    assert result.stderr == f"Error: {error.format(folder=folder)}\n"


def test_a_function_that_is_an_action_is_a_server(folder: Path, invoke: Invoke) -> None:
    (folder / "functions.py").write_text(
        "from fibaction import action\n"
        "@action('arm/drive')\n"
        "async def drive(meters: int) -> str:\n"
        "    return 'there'\n"
        "both = [drive, drive]\n"
        "class Robot:\n"
        "    @action\n"
        "    async def move(self, x: float) -> None: ...\n"
        "    @action('grip')\n"
        "    async def close(self) -> None: ...\n"
        "robot = Robot()\n"
    )
    with pytest.raises(
        Failure, match=r"^functions:Robot.move: <Action 'move'> is a method, and runs"
    ):
        import_target.import_servers("functions:Robot.move")
    for target in ("functions:robot", "functions:Robot"):  # the class is called
        servers = import_target.import_servers(target)
        assert [server.action.name for server in servers] == ["move", "grip"]
    for target, number in (("functions:drive", 1), ("functions:both", 2)):
        servers = import_target.import_servers(target)
        assert [server.action.name for server in servers] == ["arm/drive"] * number
    result = invoke("serve", "functions:zzz", f"unix://{folder}/socket")
    assert result.stderr == "Error: functions has no 'zzz'; there is drive\n"


def test_the_current_folder_is_looked_at_first_and_once(folder: Path) -> None:
    import_target.import_servers("robot:server")
    import_target.import_servers("robot:server")

    assert sys.path[0] == str(folder)
    assert sys.path.count(str(folder)) == 1


def test_a_callable_that_does_not_say_what_it_takes_is_called(folder: Path) -> None:
    with pytest.raises(Failure, match="of type dict"):
        import_target.import_servers("builtins:dict")
