"""docs/cli.md: the commands on the page print what the page says."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.cli.conftest import ROOT, Run
from tests.pages import blocks_of
from tests.processes import ended, lines_until
from tests.walks import Step, steps_of

PAGE = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
TYPED = re.compile(r"fibaction (?:list|type|find|info|send_goal)\b(?!.* --detach)")
"""Commands whose output is the same each time, but for what is below."""
CHANGING = {
    r"\b[0-9a-f]{32}\b": "ID",
    r"\b127\.0\.0\.1:\d+": "ADDRESS",
    r'"stamp":\d+': "STAMP",
}
STEPS = [
    step
    for block in blocks_of(PAGE)
    if block.language == "console"
    for step in steps_of(block.code)
    if TYPED.match(step.command)
]


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
def test_a_command_prints_what_the_page_says(fibaction: Run, server: str, step: Step) -> None:
    _, *arguments = shlex.split(step.command)
    done = fibaction(*arguments, url=server)

    assert same([*done.lines, *done.err.splitlines()]) == same(step.expected)


def test_each_of_these_verbs_is_on_the_page() -> None:
    verbs = {step.command.split()[1] for step in STEPS}
    assert verbs == {"list", "type", "find", "info", "send_goal"}
