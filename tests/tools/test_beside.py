"""Two makes at the same time: what is shown, in which order, and what is stopped."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MAKEFILE = """
quick:
	@echo quick begins; echo quick ends
other:
	@echo the other
slow:
	@echo slow; touch slow.begun; sleep 60; touch slow.ended
fails:
	@while ! [ -f slow.begun ]; do sleep 0.05; done; echo it is broken; false
"""


def run(folder: Path, *targets: str) -> tuple[int, str]:
    """Return the exit status, and what is printed."""
    (folder / "Makefile").write_text(MAKEFILE)
    program = Path(__file__).with_name("beside.py")
    done = subprocess.run(
        [sys.executable, str(program), *targets],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return done.returncode, done.stdout


def test_both_are_made_and_the_output_of_the_second_is_whole_and_last(tmp_path: Path) -> None:
    assert run(tmp_path, "other", "quick other") == (
        0,
        "the other\nquick begins\nquick ends\nthe other\n",
    )


@pytest.mark.parametrize("targets", [("slow", "quick fails other"), ("fails", "slow")])
def test_a_failure_stops_the_other_and_is_told_last(
    tmp_path: Path, targets: tuple[str, str]
) -> None:
    status, said = run(tmp_path, *targets)
    assert status == 1
    assert "the other" not in said
    assert not (tmp_path / "slow.ended").exists()
    ending = said[said.index("it is broken") :]
    assert "slow" not in ending
    assert "fails] Error 1" in ending.splitlines()[-1]
