"""docs/cli.md: the commands on the page print what the page says."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.conftest import ROOT, Run, Start
from tests.support.pages import NOT_RUN, blocks_of
from tests.support.processes import ended, lines_until
from tests.support.walks import Step, steps_of

PAGE = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
TYPED = re.compile(r"fibaction (?:list|type|find|info|send_goal)\b(?!.* --detach)")
"""Commands whose output is the same each time, but for what is below."""
CHANGING = {
    r"\b[0-9a-f]{32}\b": "ID",
    r"\b127\.0\.0\.1:\d+": "ADDRESS",
    r'"(stamp|at)":\d+': "STAMP",
}
ALL = [
    step
    for block in blocks_of(PAGE)
    if block.language == "console" and not NOT_RUN.search(block.before)
    for step in steps_of(block.code)
]
STEPS = [step for step in ALL if TYPED.match(step.command)]
IN_A_FLEET = [step for step in ALL if step.command.startswith("fibaction -c fleet ")]
FLEET = """
from fibaction import Action, ActionServer


async def run(goal):
    yield goal.request


servers = [
    ActionServer(Action(name, goal=int, feedback=int, result=str), run)
    for name in (
        *("robot1/navigate", "robot2/navigate", "robot10/navigate"),
        *("robot2/arm/pick", "look"),
    )
]
"""


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """The server that the page speaks of."""
    process = subprocess.Popen(
        [
            *(sys.executable, "examples/fibonacci_server.py"),
            *("--url", "tcp://127.0.0.1:0", "--period", "0.2"),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    (line,) = lines_until("serving", process)
    yield line.split(" at ")[1].split(",")[0]
    process.terminate()
    ended(process)


def same(lines: list[str]) -> str:
    """The lines, without what is another one each time."""
    text = "\n".join(lines).rstrip()
    for pattern, name in CHANGING.items():
        text = re.sub(pattern, name, text)
    return text


@pytest.mark.parametrize("step", STEPS, ids=[step.command for step in STEPS])
def test_a_command_prints_what_the_page_says(here: Run, server: str, step: Step) -> None:
    _, *arguments = shlex.split(step.command)
    done = here(*arguments, url=server)

    assert same([*done.lines, *done.err.splitlines()]) == same(step.expected)


def test_each_of_these_verbs_is_on_the_page() -> None:
    verbs = {step.command.split()[1] for step in STEPS}
    assert verbs == {"list", "type", "find", "info", "send_goal"}


def test_the_commands_with_namespaces_print_what_the_page_says(
    here: Run, started: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "fleet.py").write_text(FLEET)
    url = f"unix://{tmp_path}/socket"
    config = tmp_path / "config.toml"
    config.write_text(f'[addresses]\nfleet = "{url}"\n')
    monkeypatch.chdir(tmp_path)
    lines_until("serving", started("serve", "fleet:servers", url))

    for step in IN_A_FLEET:
        _, *arguments = shlex.split(step.command)
        done = here(*arguments, env={"FIBACTION_CONFIG": str(config)})
        assert same([*done.lines, *done.err.splitlines()]) == same(step.expected), step.command
    assert len(IN_A_FLEET) == 7
