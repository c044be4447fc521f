"""A program that uses the installed wheel: what it gets, and what type checkers make of it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """\
from collections.abc import AsyncGenerator
from dataclasses import dataclass

import anyio

from fibaction import Action, ActionServer, GoalHandle, connect, serve
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.tcp import TcpTransport


@dataclass
class Goal:
    order: int


@dataclass
class Feedback:
    numbers: list[int]


@dataclass
class Result:
    total: int


SUM = Action("sum", goal=Goal, feedback=Feedback, result=Result)
reveal_type(SUM)  # Action[Goal, Feedback, Result]


async def add(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    reveal_type(goal.request.order)  # int
    yield Feedback([1, 2])
    yield Result(goal.request.order + 3)


async def main() -> None:
    server = ActionServer(SUM, add)
    reveal_type(server)  # ActionServer[Goal, Feedback, Result]
    reveal_type(TcpTransport("127.0.0.1", 0))  # TcpTransport
    transport = InProcessTransport("consumer")
    async with serve(server, transport), connect(transport, SUM) as client:
        reveal_type(client)  # ActionClient[Goal, Feedback, Result]
        async with client.send_goal(Goal(order=4)) as goal:
            async for feedback in goal.feedback:
                print(feedback)
                reveal_type(feedback)  # Feedback
            result = await goal.result()
            reveal_type(result)  # Result
            reveal_type((await goal.outcome()).result)  # Result | None
        client.send_goal("four")  # refused
        print(result)


anyio.run(main)
"""


def lines(mark: str) -> dict[int, str]:
    """What stands behind a mark, by the number of the line."""
    found = (re.search(mark, line) for line in PROGRAM.splitlines())
    return {number: match[1] for number, match in enumerate(found, 1) if match}


REVEALED = lines(r"reveal_type\(.*  # (.+)$")
REFUSED = list(lines(r"(# refused)$"))


@pytest.fixture
def program(tmp_path: Path) -> Path:
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    return file


def checked(command: list[str], program: Path) -> str:
    """What a type checker says, which found at least one error."""
    done = subprocess.run(
        [sys.executable, "-m", *command, program.name],
        cwd=program.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout


def test_mypy_knows_all_types_of_an_installed_fibaction(program: Path, consumer: Path) -> None:
    said = checked(
        ["mypy", "--strict", "--config-file=", f"--python-executable={consumer / 'python'}"],
        program,
    )
    notes = re.findall(r'py:(\d+): note: Revealed type is "(.+)"', said)
    assert {int(line): re.sub(r"\b\w+\.", "", name) for line, name in notes} == REVEALED
    assert [int(line) for line in re.findall(r"py:(\d+): error:", said)] == REFUSED


def test_pyright_knows_all_types_of_an_installed_fibaction(program: Path, consumer: Path) -> None:
    (program.parent / "pyrightconfig.json").write_text('{"typeCheckingMode": "strict"}')
    said = checked(["basedpyright", "--outputjson", f"--pythonpath={consumer / 'python'}"], program)
    revealed: dict[int, str] = {}
    refused: list[int] = []
    for each in json.loads(said)["generalDiagnostics"]:
        line = each["range"]["start"]["line"] + 1
        if each["severity"] == "information":
            revealed[line] = each["message"].partition('" is ')[2].strip('"')
        else:
            refused.append(line)
    assert revealed == REVEALED
    assert refused == REFUSED


def test_the_program_runs_with_the_wheel_and_what_it_requires(
    program: Path, consumer: Path
) -> None:
    runnable = (line for line in PROGRAM.splitlines() if not re.search("reveal_type|refused", line))
    program.write_text("\n".join(runnable))
    done = subprocess.run(
        [consumer / "python", "-W", "error", program.name],
        cwd=program.parent,
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.stderr) == ("Feedback(numbers=[1, 2])\nResult(total=7)\n", "")


def test_without_its_extra_the_command_line_says_what_is_missing(consumer: Path) -> None:
    done = subprocess.run([consumer / "fibaction", "list"], capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stdout == ""
    assert re.fullmatch(r".*fibaction\[cli\].*\n", done.stderr)
