"""The way of a goal through the modules, as a ratchet: it can only become shorter.

`python -m tests.tools.goal_way` prints the way, and its docstring says what is counted.
"""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from fibaction import GoalID
from tests.tools.goal_way import STORE, WAYS, Figures, recorded

ROOT = Path(__file__).parent.parent

BOUNDS = {
    "in-process": Figures(calls=161, modules=30, changes=131),
    "TCP": Figures(calls=309, modules=43, changes=245),
    "dds": Figures(calls=1368, modules=89, changes=973),
    "in-process with a store": Figures(calls=227, modules=34, changes=185),
}
"""The most of each figure on each way, on Python 3.11. Lower them, and never raise one."""
TOLERANCE = 0.05
"""The part of a bound that a figure may be below it, before the bound must be lowered."""

only_here = pytest.mark.skipif(
    sys.version_info[:2] != (3, 11), reason="other versions of Python count calls differently"
)


def complaints(way: str, figures: Figures, bounds: Figures) -> list[str]:
    """Return a sentence for each figure over its bound, and for each bound that is too high."""
    sentences = []
    for name, figure, bound in zip(Figures._fields, figures, bounds, strict=True):
        if figure > bound:
            sentences.append(
                f"{way}: a goal takes {figure} {name}, and {bound} are the most: make its way"
                " shorter, `python -m tests.tools.goal_way` prints it"
            )
        elif figure < bound * (1 - TOLERANCE):
            sentences.append(f"{way}: lower the bound of {name} from {bound} to {figure}")
    return sentences


@cache
def printed(*options: str) -> list[str]:
    """Return what the command prints, in a process of its own: what other tests have left behind,
    and the time that they take, would be on the way too.
    """
    command = [sys.executable, "-m", "tests.tools.goal_way", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def figures_of(lines: list[str]) -> dict[str, Figures]:
    found = (re.fullmatch(r"(.+): (\d+) calls, (\d+) modules, (\d+) .*", line) for line in lines)
    return {one[1]: Figures(int(one[2]), int(one[3]), int(one[4])) for one in found if one}


@only_here
@pytest.mark.parametrize("way", WAYS)
def test_the_way_of_a_goal_becomes_no_longer(way: str) -> None:
    assert complaints(way, figures_of(printed("--figures"))[way], BOUNDS[way]) == []


def test_the_way_is_the_same_when_it_is_counted_again() -> None:
    assert figures_of(printed("--figures")) == figures_of(printed("--modules"))


def test_with_a_store_an_end_is_written_before_it_is_told() -> None:
    lines = printed()
    start = lines.index(next(line for line in lines if line.startswith(f"{STORE}: ")))
    functions = [line.split()[0] for line in lines[start + 1 :] if line]
    way = ["GoalKeeper._write_end", "SqliteJournal.end", "GoalLogs._tell_end"]
    assert [name for name in functions if name in way] == way


def test_the_way_begins_at_the_client_and_passes_the_server() -> None:
    functions = [line.split()[0] for line in printed() if line]
    assert functions[1] == "ActionClient.send_goal"
    assert "ActionServer.offer_goal" in functions


def test_a_figure_over_its_bound_and_a_bound_that_is_too_high_are_told() -> None:
    bounds = Figures(100, 20, 40)
    assert complaints("TCP", Figures(100, 19, 38), bounds) == []
    longer, lower = complaints("TCP", Figures(101, 18, 40), bounds)
    assert longer.startswith("TCP: a goal takes 101 calls, and 100 are the most")
    assert lower == "TCP: lower the bound of modules from 20 to 18"


def test_only_calls_inside_the_packages_are_recorded() -> None:
    before = sys.getprofile()
    with recorded() as way:
        sorted([1, 2], key=lambda number: -number)
        GoalID.random()
    GoalID.random()
    assert [step[:3] for step in way] == [("fibaction/words/goals.py", "GoalID.random", 0)]
    assert sys.getprofile() is before
