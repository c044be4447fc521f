"""`store given_up` and `store rerun`: goals in a file that were given up."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalStatus,
    SqliteStore,
    serve,
)
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs.store import run_again_at
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import encode_row, moved
from tests.cli.conftest import Run

PAINT = Action("arm/paint", goal=int, feedback=int, result=str, checkpoint=int)
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
    async with ActionServer(PAINT, paint, store=SqliteStore(path), at_stop="keep") as server:
        for number in range(count):
            goal = await ActionClient(server, PAINT).send_goal(5 + number)
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
    async with ActionServer(PAINT, paint, store=SqliteStore(path), recovery=end) as server:
        for goal_id in goals:
            outcome = await (await ActionClient(server, PAINT).attach(goal_id)).outcome()
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
        async with ActionServer(PAINT, paint, store=SqliteStore(path)) as server:
            goal = await ActionClient(server, PAINT).attach(GoalID.parse(new.split()[0]))
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
        async with ActionServer(PAINT, paint, store=SqliteStore(path)):
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
        server, url = ActionServer(PAINT, paint, store=SqliteStore(path)), "inproc://again"
        async with serve(server, url):
            for goal_id, digits in ((first, str(first)[:12]), (second, str(second))):
                assert await run_again_at(url, digits) == ExitCode.SUCCEEDED
                said = f"goal {goal_id} of /arm/paint runs again as goal "
                assert capsys.readouterr().out.startswith(said)
                with pytest.raises(Failure, match="was not given up at inproc://again"):
                    await run_again_at(url, digits)

    anyio.run(rerun)
