"""`goals --store` and `store`: the goals in a file, without their server."""

from __future__ import annotations

import re
import shutil
from collections.abc import AsyncGenerator
from contextlib import closing
from pathlib import Path
from signal import SIGINT
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    GoalID,
    GoalStatus,
    SqliteStore,
    serve,
)
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs.store import run_again_at
from fibaction.server.durability import goal_keeper
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import encode_row, moved
from fibaction.testing.contract.stores import a_goal, after_end
from tests.cli.conftest import Run, Start
from tests.support.processes import ended, lines_until

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
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with three goals that no server uses, and that no test changes."""
    path = tmp_path_factory.mktemp("store") / "goals.db"
    anyio.run(fill, path)
    return path


def test_the_goals_of_a_namespace_are_listed_and_names_are_relative_to_it(
    here: Run, filled: Path
) -> None:
    store = ("goals", "--store", str(filled))

    (arm,) = here(*store, "-n", "/arm").lines[1:]
    assert arm.split()[1] == "/arm/drive"
    assert len(here(*store, "-n", "arm", "drive").lines) == 2
    assert len(here(*store, "-n", "arm", "/paint").lines) == 3
    assert here(*store, "-n", "/leg").err == "There are no goals in /leg.\n"


def test_the_newest_goals_of_a_store_are_listed_and_the_others_counted(
    here: Run, filled: Path
) -> None:
    found = here("goals", "--store", str(filled), "--limit", "2", "--json")

    assert [goal["result"] for goal in found.json] == ["done 2", "done 3"]
    assert found.err == "1 more goal is not listed: --limit 0 lists all.\n"
    everything = here("goals", "--store", str(filled), "--limit", "0", "--json")
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


def test_a_store_without_a_history_has_no_past(here: Run, filled: Path) -> None:
    listed = here("goals", "--past", "--store", str(filled), "--json").json
    assert listed == here("goals", "--store", str(filled), "--json").json


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with three goals that no server uses."""
    path = tmp_path / "goals.db"
    anyio.run(fill, path)
    return path


def goals_in(here: Run, path: Path) -> list[Any]:
    return [
        (goal["action"], goal["result"])
        for goal in here("goals", "--store", str(path), "--json").json
    ]


def test_a_store_is_copied_to_one_new_file(here: Run, store: Path, tmp_path: Path) -> None:
    store.chmod(0o640)
    before, target = store.read_bytes(), tmp_path / "backup.db"

    found = here("store", "backup", str(store), str(target))

    assert (found.code, found.out, found.err) == (0, f"{target} has 3 goals\n", "")
    assert goals_in(here, target) == goals_in(here, store)
    assert len(goals_in(here, target)) == 3
    assert store.read_bytes() == before
    assert target.stat().st_mode == store.stat().st_mode
    assert sorted(file.name for file in tmp_path.iterdir()) == ["backup.db", "goals.db"]


def test_without_a_target_the_copy_is_beside_the_store_with_the_time(
    here: Run, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(store.parent)

    found = here("store", "backup", "goals.db")

    name = found.out.partition(" has ")[0]
    assert re.fullmatch(r"goals-\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.db", name)
    assert len(goals_in(here, store.parent / name)) == 3


def test_a_store_in_use_is_copied_and_a_server_starts_with_the_copy(
    here: Run, started: Start, folder: Path
) -> None:
    url, store, target = f"unix://{folder}/socket", folder / "goals.db", folder / "backup.db"
    server = started("serve", "robot:server", url, "--store", str(store))
    lines_until("serving", server)
    assert here("send_goal", "count", "3", url=url).code == 0

    assert here("store", "backup", str(store), str(target)).out == f"{target} has 1 goal\n"

    assert here("send_goal", "count", "2", url=url).code == 0  # the server goes on
    server.send_signal(SIGINT)
    assert ended(server)[0] == 0
    again = started("serve", "robot:server", url, "--store", str(target))
    lines_until("serving", again)
    (line,) = here("goals", "count", "--json", url=url).json
    assert line["status"] == "SUCCEEDED"
    again.send_signal(SIGINT)
    assert ended(again)[0] == 0


# What cannot be done


@pytest.mark.parametrize("name", ["backup.db", "backup.db-wal"])
def test_a_file_that_exists_is_not_replaced(
    here: Run, store: Path, tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text("mine")

    found = here("store", "backup", str(store), str(tmp_path / "backup.db"))

    assert (found.code, found.err) == (2, f"Error: {tmp_path / name} exists: name a new file\n")
    assert (tmp_path / name).read_text() == "mine"


def test_the_folder_of_the_copy_has_to_be_there(here: Run, store: Path, tmp_path: Path) -> None:
    target = tmp_path / "none" / "backup.db"

    found = here("store", "backup", str(store), str(target))

    assert found.code == 2
    assert found.err == f"Error: cannot write {target}: No such file or directory\n"


def test_a_store_without_its_log_is_not_copied(here: Run, store: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone.db"

    with closing(JournalFile(str(store), "full")):
        shutil.copy(store, alone)

    found = here("store", "backup", str(alone))

    assert found.code == 7
    assert ": the file next to it that ends in -wal is missing, and" in found.err


ARM_PAINT = Action("arm/paint", goal=int, feedback=int, result=str, checkpoint=int)
REASON = "the server was restarted"


async def paint(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.restored is None:
        await goal.checkpoint(goal.request - 1)
        yield 1
        await anyio.sleep_forever()
    yield f"on from {goal.restored}"


async def give_up(path: Path, count: int) -> list[GoalID]:
    """Let a server die with goals at work, and the next one give them up."""
    goals = []
    async with ActionServer(ARM_PAINT, paint, store=SqliteStore(path), at_stop="keep") as server:
        for number in range(count):
            goal = await ActionClient(server, ARM_PAINT).send_goal(5 + number)
            await anext(goal.feedback)
            goals.append(goal.goal_id)

    def end(goal: GoalHandle[int]) -> None:
        raise GoalAborted(REASON)

    file = JournalFile(str(path), "full")
    for goal_id in goals:  # as if the server had been killed
        stored = file.goals().of("arm/paint").active[goal_id]
        stored.is_running = True
        file.add(encode_row(file.next_number, [moved("arm/paint", stored)]))
    file.close()
    async with ActionServer(ARM_PAINT, paint, store=SqliteStore(path), recovery=end) as server:
        for goal_id in goals:
            outcome = await (await ActionClient(server, ARM_PAINT).attach(goal_id)).outcome()
            assert (outcome.status, outcome.reason) == (GoalStatus.ABORTED, REASON)
    return goals


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "goals.db"


def test_goals_of_a_store_that_were_given_up_are_listed_and_run_again(
    here: Run, path: Path
) -> None:
    first, second = anyio.run(give_up, path, 2)
    found = here("store", "given_up", str(path))
    assert (found.code, found.err) == (0, "")
    assert found.lines == [
        f"{first}  /arm/paint  attempt 1",
        f"    reason: {REASON}",
        "    goal: 5",
        "    checkpoint: 4",
        f"{second}  /arm/paint  attempt 1",
        f"    reason: {REASON}",
        "    goal: 6",
        "    checkpoint: 5",
    ]
    (one, _) = here("store", "given_up", str(path), "--json").json
    assert one.pop("ended_at") > 1_700_000_000 * 10**9
    assert one == {
        "action": "arm/paint",
        "goal_id": str(first),
        "attempt": 1,
        "reason": REASON,
        "client": "",
        "goal": 5,
        "checkpoint": 4,
    }

    again = here("store", "rerun", str(path), str(first)[:12])
    assert (again.code, again.err) == (0, "")
    head, _, new = again.out.partition(" as goal ")
    assert head == f"goal {first} of /arm/paint runs again"
    assert new.endswith(" when its server starts\n")

    async def result() -> str:
        async with ActionServer(ARM_PAINT, paint, store=SqliteStore(path)) as server:
            goal = await ActionClient(server, ARM_PAINT).attach(GoalID.parse(new.split()[0]))
            return await goal.result()

    assert anyio.run(result) == "on from 4"
    assert [one["goal_id"] for one in here("store", "given_up", str(path), "--json").json] == [
        str(second)
    ]
    listed = here("goals", "--store", str(path), "--json").json
    statuses = {one["goal_id"]: one["status"] for one in listed}
    assert statuses[str(first)] == "ABORTED", "what was told does not change"


def test_only_what_was_given_up_runs_again(here: Run, path: Path) -> None:
    async def nothing() -> None:
        async with ActionServer(ARM_PAINT, paint, store=SqliteStore(path)):
            pass

    anyio.run(nothing)
    found = here("store", "given_up", str(path))
    assert (found.code, found.out) == (0, "")
    assert found.err == f"No goals were given up at {path}.\n"
    assert here("store", "given_up", str(path), "--json") == (0, "", "")
    found = here("store", "rerun", str(path), "91c7")
    assert found.code == ExitCode.USAGE
    assert found.err == f"Error: no goal with an ID that begins with 91c7 was given up at {path}\n"


def test_one_runs_again_at_the_server_that_runs(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def rerun() -> None:
        first, second = await give_up(path, 2)
        server, url = ActionServer(ARM_PAINT, paint, store=SqliteStore(path)), "inproc://again"
        async with serve(server, url):
            for goal_id, digits in ((first, str(first)[:12]), (second, str(second))):
                assert await run_again_at(url, digits) == ExitCode.SUCCEEDED
                said = f"goal {goal_id} of /arm/paint runs again as goal "
                assert capsys.readouterr().out.startswith(said)
                with pytest.raises(Failure, match="was not given up at inproc://again"):
                    await run_again_at(url, digits)

    anyio.run(rerun)
