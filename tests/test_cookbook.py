"""The cookbook: its recipes are as short as its first page says, and its cells run.

`tests/test_docs.py` runs the programs, `tests/support/test_walks.py` those in files.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from fibaction import ActionServer, serve
from tests.support.pages import blocks_of
from tests.test_notebook_page import DRIVE, drive, run_cells

COOKBOOK = Path(__file__).resolve().parent.parent / "docs" / "cookbook"
INDEX = (COOKBOOK / "index.md").read_text(encoding="utf-8")
NOTEBOOK = (COOKBOOK / "notebook.md").read_text(encoding="utf-8")
LIMITS = {
    "blocking_script": 12,
    "fastapi": 25,
    "notebook": 5,
    "preempting_arm": 25,
    "pydantic_action": 15,
    "worker_pool": 20,
}
"""Lines that the program of a recipe has at most, empty ones not counted."""


def program_of(recipe: str) -> list[str]:
    """Return the lines of the first program of a page that are not empty."""
    blocks = blocks_of((COOKBOOK / f"{recipe}.md").read_text(encoding="utf-8"))
    program = next(block for block in blocks if block.language == "python")
    return [line for line in program.code.splitlines() if line.strip()]


@pytest.mark.parametrize(("recipe", "limit"), LIMITS.items())
def test_a_recipe_is_short(recipe: str, limit: int) -> None:
    program = program_of(recipe)

    assert len(program) <= limit
    assert max(map(len, program)) <= 100


def test_the_first_page_has_every_recipe_and_its_lines() -> None:
    recipes = {path.stem for path in COOKBOOK.glob("*.md")} - {"index"}
    rows = re.findall(r"\((\w+)\.md\)[^|]*\| (\d+) \|$", INDEX, re.MULTILINE)

    assert set(re.findall(r"\((\w+)\.md\)", INDEX)) == recipes
    assert {name: int(lines) for name, lines in rows} == LIMITS


@pytest.mark.asyncio
async def test_the_cells_of_the_notebook_run(monkeypatch: pytest.MonkeyPatch) -> None:
    robot: Any = ModuleType("robot")
    robot.DRIVE = DRIVE
    monkeypatch.setitem(sys.modules, "robot", robot)
    async with serve(ActionServer(DRIVE, drive), "tcp://127.0.0.1:0") as (url,):
        names = await run_cells(NOTEBOOK, url)
        await names["client"].aclose()
