"""The goals in a file that were given up, and that run again."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import anyio
import pytest

from fibaction import GoalID, StoreError
from fibaction.stores._copy import stored_goals
from fibaction.stores._journal_file import JournalFile, rerun
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.testing.contract.stores import a_goal, after_end
from fibaction.words.statuses import GoalStatus


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with a goal that was given up, one that has ended otherwise, and an active one."""
    path = tmp_path / "goals.db"
    goals = [
        after_end(a_goal(1), status=GoalStatus.ABORTED, goal=b"goal", checkpoint=b"half"),
        after_end(a_goal(2)),
        a_goal(3),
    ]
    with closing(JournalFile(str(path), "full")) as file:
        records = [WholeRecord("paint", goal) for goal in goals]
        file.add(encode_row(file.next_number, list(records)))
    return path


def test_one_is_a_new_goal_afterwards_and_keeps_its_outcome(path: Path) -> None:
    new = anyio.run(rerun, str(path), "paint", a_goal(1).goal_id)

    found = {goal.goal_id: goal for goal in anyio.run(stored_goals, str(path))["paint"]}
    assert set(found) == {a_goal(number).goal_id for number in (1, 2, 3)} | {new}
    assert (found[new].status, found[new].goal, found[new].checkpoint) == (
        GoalStatus.ACCEPTED,
        b"goal",
        b"half",
    )
    old = found[a_goal(1).goal_id]
    assert (old.status, old.result, old.is_given_up) == (GoalStatus.ABORTED, b"result", False)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_no_other_goal_runs_again(path: Path, number: int) -> None:
    goal_id = GoalID(number.to_bytes(16, "big"))
    with pytest.raises(StoreError, match=f"again: goal {goal_id} was not given up"):
        anyio.run(rerun, str(path), "paint", goal_id)


def test_a_file_that_a_server_uses_is_left_alone(path: Path) -> None:
    with closing(JournalFile(str(path), "full")), pytest.raises(StoreError, match="it is in use"):
        anyio.run(rerun, str(path), "paint", a_goal(1).goal_id)
