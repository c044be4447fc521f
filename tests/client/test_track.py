"""`fibaction.track`: a goal's progress on one line, and its result."""

from __future__ import annotations

import io
import sys
from collections.abc import AsyncGenerator
from typing import Any

import pytest

from fibaction import Action, ActionClient, ActionServer, GoalAborted, GoalHandle, Progress, track

pytestmark = pytest.mark.anyio

COPY = Action("copy", goal=int, feedback=Progress, result=str)
COUNT = Action("count", goal=int, feedback=int, result=str)
Items = AsyncGenerator[Progress | str, None]


async def copy(goal: GoalHandle[int]) -> Items:
    for number in range(goal.request):
        yield Progress(number + 1, goal.request, f"file [{number + 1}]")
    yield f"{goal.request} files"


async def tracked(server: ActionServer[int, Any, str], goal: int = 4, text: str = "") -> str:
    """Track a goal, and return what was written."""
    written = io.StringIO()
    async with server, ActionClient(server, server.action).send_goal(goal) as sent:
        assert await track(sent, text, file=written) == f"{goal} files"
    return written.getvalue()


def copying() -> ActionServer[int, Progress, str]:
    return ActionServer(COPY, copy)


def counting() -> ActionServer[int, int, str]:
    return ActionServer(COUNT, count)


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(goal.request):
        yield number
    yield f"{goal.request} files"


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """Let modules be missing."""
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)


async def test_tqdm_draws_a_bar_if_it_is_installed() -> None:
    written = await tracked(copying(), text="copying")
    assert "copying" in written
    last = written.rstrip().rsplit("\r", 1)[-1]
    assert last.startswith("file [4]: 100%|")
    assert " 4/4 [" in last


async def test_tqdm_counts_feedback_that_tells_no_progress() -> None:
    assert "numbers: 3it [" in await tracked(counting(), 3, "numbers")


async def test_rich_draws_a_bar_if_tqdm_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "tqdm.auto")
    written = await tracked(copying())
    assert "file [4]" in written
    assert "100%" in written
    assert "numbers" in await tracked(counting(), 3, "numbers")


async def half_a_copy(goal: GoalHandle[int]) -> Items:
    """Tell two of three files, and then fail or succeed."""
    yield Progress(2, 3, "file [2]")
    if goal.request == 0:
        raise GoalAborted("the disk is full")
    yield f"{goal.request} files"


async def failed() -> str:
    """Track a goal that fails, and return what was written."""
    written = io.StringIO()
    async with (
        ActionServer(COPY, half_a_copy) as server,
        ActionClient(server, COPY).send_goal(0) as sent,
    ):
        with pytest.raises(GoalAborted, match="the disk is full"):
            await track(sent, file=written)
    return written.getvalue()


@pytest.mark.parametrize(
    ("missing", "full", "half"),
    [
        ((), " 3/3 [", " 2/3 ["),
        (("tqdm.auto",), "100%", " 67%"),
        (("tqdm.auto", "rich.console"), "file [2] 100 %\n", "file [2] 60 %\n"),
    ],
    ids=["tqdm", "rich", "text"],
)
async def test_the_progress_ends_full_only_if_the_goal_succeeds(
    missing: tuple[str, ...], full: str, half: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    without(monkeypatch, *missing)

    def last(written: str) -> str:
        return written.rstrip(" ").rsplit("\r", 1)[-1]

    assert full in last(await tracked(ActionServer(COPY, half_a_copy)))
    written = last(await failed())
    assert half in written
    assert full not in written
    if missing == ("tqdm.auto",):
        for feedback in (0, 2):  # without a total, and without any feedback
            assert full in await tracked(counting(), feedback)


async def test_lines_of_text_tell_the_progress_without_both(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without(monkeypatch, "tqdm.auto", "rich.console")
    written = await tracked(copying(), 3)
    assert written.splitlines() == ["file [1] 30 %", "file [2] 60 %", "file [3] 100 %"]

    async def steady(goal: GoalHandle[int]) -> Items:
        for number in range(100):
            yield Progress(number, 100)
        yield Progress(5, text="cleaning\nup")
        yield "1 files"

    lines = (await tracked(ActionServer(COPY, steady), 1, "copying")).splitlines()
    assert lines[:10] == [f"copying {tens} %" for tens in range(0, 100, 10)]
    assert lines[10:] == ["cleaning\\x0aup"]
    assert await tracked(counting(), 2, "copying") == "copying feedback 1\ncopying feedback 2\n"


async def test_the_line_goes_to_stderr_and_ends_with_the_goal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "tqdm.auto", "rich.console")

    async def failing(goal: GoalHandle[int]) -> Items:
        yield Progress(1, 2)
        raise GoalAborted("stuck")

    async with (
        ActionServer(COPY, failing) as server,
        ActionClient(server, COPY).send_goal(1) as sent,
    ):
        with pytest.raises(GoalAborted, match="stuck"):
            await track(sent)
    out, err = capsys.readouterr()
    assert (out, err) == ("", "50 %\n")
