"""Targets of make in lanes: what is shown, in which order, and what is stopped."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
MAKEFILE = """
quick:
	@echo quick begins; echo quick ends
other:
	@echo the other
slow:
	@echo slow; touch slow.begun; sleep 60; touch slow.ended
fails:
	@while ! [ -f slow.begun ]; do sleep 0.05; done; echo it is broken; false
told:
	@echo $(WORD)
"""


@pytest.fixture(autouse=True)
def makefile(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text(MAKEFILE)


def run(folder: Path, *lanes: str) -> tuple[int, str]:
    """Return the exit status, and what is printed."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests/tools/stages.py"), *lanes],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout


def test_each_target_of_the_lanes_is_made_and_its_output_is_whole(tmp_path: Path) -> None:
    status, said = run(tmp_path, "told WORD=first", "quick, other")
    assert status == 0
    assert "first\n" in said
    output = "---- make quick\nquick begins\nquick ends\n---- make other\nthe other"
    assert output in re.sub(r" \(\d+ s\)$", "", said, flags=re.MULTILINE)
    assert said.splitlines()[-1].startswith("passed: ")


@pytest.mark.parametrize("lanes", [("slow", "quick, fails, other"), ("fails", "slow")])
def test_a_failure_stops_the_rest_and_is_told_of_last(
    tmp_path: Path, lanes: tuple[str, ...]
) -> None:
    begun = time.monotonic()
    status, said = run(tmp_path, *lanes)
    assert status == 1
    assert "the other" not in said
    assert not (tmp_path / "slow.ended").exists()
    assert time.monotonic() - begun < 30
    ending = said[said.index("it is broken") :]
    assert "slow" not in ending
    assert re.fullmatch(r"make fails failed after \d+ s", ending.splitlines()[-1])
