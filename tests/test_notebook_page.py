"""The cells of docs/howto/blocking.md, run as a notebook runs them, without Jupyter."""

from __future__ import annotations

import ast
import inspect
import io
import sys
from collections.abc import AsyncGenerator
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionServer, GoalHandle, serve
from tests.support.pages import Block, blocks_of

PAGE = Path(__file__).resolve().parent.parent / "docs" / "howto" / "blocking.md"
ADDRESS = "tcp://127.0.0.1:7400"
DRIVE = Action("drive", goal=int, feedback=int, result=str)


async def drive(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for meters in range(1, goal.request + 1):
        yield meters
    yield f"drove {goal.request} m"


async def run_cell(code: str, names: dict[str, Any]) -> None:
    made = eval(compile(code, "cell", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT), names)
    if inspect.iscoroutine(made):
        await made


async def run_cells(page: str, url: str) -> dict[str, Any]:
    """Run the cells of a section, each in a task, and return their names."""
    names: dict[str, Any] = {}
    blocks = blocks_of(page)
    for block, following in pairwise([*blocks, Block("", "", 0, "")]):
        if block.language != "python":
            continue
        output = io.StringIO()
        with redirect_stdout(output):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(run_cell, block.code.replace(ADDRESS, url), names)
        expected = following.code if following.language == "text" else ""
        printed = f"{output.getvalue()}\n".split("\n")
        # Not `splitlines`, which splits at the carriage returns, too.
        shown = [line.rpartition("\r")[2] for line in printed]
        assert "\n".join(shown).strip() == expected.strip()
    return names


@pytest.mark.asyncio
async def test_each_cell_runs_in_a_task_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    robot: Any = ModuleType("my_robot")
    robot.DRIVE = DRIVE
    monkeypatch.setitem(sys.modules, "my_robot", robot)
    async with serve(ActionServer(DRIVE, drive), "tcp://127.0.0.1:0") as (url,):
        section = PAGE.read_text(encoding="utf-8").partition("\n## In a Jupyter notebook\n")[2]
        await run_cells(section, url)
