"""`goals --store`: the goals in a file, without their server."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalHistory,
    GoalStatus,
    SqliteStore,
)
from fibaction.server.durability import goal_keeper
from fibaction.testing.contract.stores import a_goal, after_end
from tests.cli.conftest import Run

PAINT = Action("paint", goal=int, feedback=int, result=str)
DRIVE = Action("arm/drive", goal=int, feedback=int, result=str)


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield 1
    yield f"done {goal.request}"


async def fill(path: Path) -> None:
    store = SqliteStore(path)
    async with ActionServer(PAINT, work, store=store) as paint:
        async with ActionServer(DRIVE, work, store=store) as drive:
            await ActionClient(paint, PAINT).call(1)
            await ActionClient(drive, DRIVE).call(2)
            await ActionClient(paint, PAINT).call(3)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "goals.db"
    anyio.run(fill, path)
    return path


def test_the_goals_of_a_namespace_are_listed_and_names_are_relative_to_it(
    here: Run, path: Path
) -> None:
    store = ("goals", "--store", str(path))

    (arm,) = here(*store, "-n", "/arm").lines[1:]
    assert arm.split()[1] == "/arm/drive"
    assert len(here(*store, "-n", "arm", "drive").lines) == 2
    assert len(here(*store, "-n", "arm", "/paint").lines) == 3
    assert here(*store, "-n", "/leg").err == "There are no goals in /leg.\n"


def test_the_newest_goals_of_a_store_are_listed_and_the_others_counted(
    here: Run, path: Path
) -> None:
    found = here("goals", "--store", str(path), "--limit", "2", "--json")

    assert [goal["result"] for goal in found.json] == ["done 2", "done 3"]
    assert found.err == "1 more goal is not listed: --limit 0 lists all.\n"
    everything = here("goals", "--store", str(path), "--limit", "0", "--json")
    assert (len(everything.json), everything.err) == (3, "")


def test_a_goal_that_runs_again_tells_its_attempt_and_its_parent(here: Run, tmp_path: Path) -> None:
    anyio.run(begin_twice, tmp_path / "goals.db")
    [goal] = here("goals", "--store", str(tmp_path / "goals.db"), "--json").json

    assert (goal["status"], goal["attempt"]) == ("EXECUTING", 2)
    assert goal["parent"] == {"goal_id": "1" * 32, "step": "paint"}


def test_a_result_of_another_encoding_is_told_in_place_of_it(here: Run, tmp_path: Path) -> None:
    anyio.run(end_with, tmp_path / "goals.db", b"\xc1")
    [goal] = here("goals", "--store", str(tmp_path / "goals.db"), "--json").json

    assert (goal["status"], goal["result"]) == ("ABORTED", None)
    assert goal["reason"].startswith("its result cannot be read: ")


async def end_with(path: Path, result: bytes) -> None:
    goal = a_goal(status=GoalStatus.EXECUTING)
    async with SqliteStore(path).open("paint", max_results=1, claim=print, lose=print) as journal:
        journal.accept(goal, lambda error: None)
        goal = after_end(a_goal(), result=result, status=GoalStatus.ABORTED, keep_until=2**62)
        journal.end(goal, lambda error: None)


async def begin_twice(path: Path) -> None:
    meta = {"parent": "1" * 32, "step": "paint"}
    goal = a_goal(status=GoalStatus.EXECUTING, attempt=2, meta=meta)
    store = SqliteStore(path)
    async with store.open("paint", max_results=1, claim=print, lose=print) as journal:
        journal.accept(goal, lambda error: None)


async def forget(path: Path) -> None:
    """Let goals end at a server that forgets them, and has a history, and one that remembers it."""
    for result_timeout, goal in ((0, 1), (0, 2), (3600, 3)):
        store = SqliteStore(path, history=GoalHistory())
        server = ActionServer(PAINT, work, store=store, result_timeout=result_timeout)
        async with server:
            await ActionClient(server, PAINT).call(goal, labels={"order": f"{goal}"})


def test_the_history_of_a_store_is_listed_without_a_server(
    here: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(goal_keeper, "OUTCOME_GRACE", 0.0)
    past = ("goals", "--past", "--store", str(tmp_path / "goals.db"))
    anyio.run(forget, tmp_path / "goals.db")

    assert [goal["result"] for goal in here(*past, "--json").json] == ["done 1", "done 2", "done 3"]
    (second,) = here(*past, "--label", "order=2", "--json").json
    assert (second["result"], second["labels"]) == ("done 2", {"order": "2"})
    assert here(*past, "arm/drive").err == "There are no goals of /arm/drive.\n"
    (last,) = here(*past, "--limit", "1", "--json").json
    assert last["result"] == "done 3"


def test_a_store_without_a_history_has_no_past(here: Run, path: Path) -> None:
    listed = here("goals", "--past", "--store", str(path), "--json").json
    assert listed == here("goals", "--store", str(path), "--json").json
