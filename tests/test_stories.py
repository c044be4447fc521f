"""The section "Who uses it for what": its programs are in `examples/`, and print what it shows."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.pages import Block, blocks_of
from tests.support.ros_domain import own_domain
from tests.support.walks import steps_of

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 120.0
"""Seconds for a program, which imports large libraries for most of its time."""
PAGE = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8")
BLOCKS = blocks_of(PAGE.partition("\n## Who uses it for what\n")[2])
EXCERPTS = [block for block in BLOCKS if block.language == "python"]
EXCERPT_OF = re.compile(r"it is a part of (?P<program>examples/\w+\.py) -->\n\Z")
SHOWN = {
    Path(step.command).name: step.expected
    for block in BLOCKS
    if block.language == "console"
    for step in steps_of(block.code)
}
"""The output of each program, with `...` for what differs."""


def program_of(block: Block) -> str:
    """Return the program that the block is a part of."""
    found = EXCERPT_OF.search(block.before)
    assert found is not None, f"a block of docs/choosing.md does not name its program: {block.code}"
    return found["program"]


@pytest.mark.parametrize("block", EXCERPTS, ids=program_of)
def test_an_excerpt_is_a_part_of_the_program(block: Block) -> None:
    assert block.code in (ROOT / program_of(block)).read_text(encoding="utf-8")


def pattern_of(expected: list[str]) -> str:
    """Return a pattern for what a page shows; a line `...` is any lines."""
    return "".join(
        "(?:.*\n)*" if line == "..." else re.escape(line).replace(r"\.\.\.", ".*") + "\n"
        for line in expected
    )


def test_each_story_has_an_excerpt_and_a_run() -> None:
    assert len(SHOWN) == 4
    assert {Path(program_of(block)).name for block in EXCERPTS} == set(SHOWN)


@pytest.mark.timeout(2 * PATIENCE)
@pytest.mark.parametrize("program", SHOWN)
def test_a_program_tells_its_story_from_any_folder(program: str, tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(ROOT / "examples" / program)]
    with own_domain():
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(pattern_of(SHOWN[program]), done.stdout), done.stdout


def test_another_story_than_the_one_on_the_page_is_found() -> None:
    pattern = pattern_of(["moved", "...", "CANCELED at [...]"])

    assert re.fullmatch(pattern, "moved\nat 1\nat 2\nCANCELED at [2, 0]\n")
    assert re.fullmatch(pattern, "moved\nCANCELED at []\n")
    assert not re.fullmatch(pattern, "moved\nat 1\nSUCCEEDED at [2, 0]\n")
