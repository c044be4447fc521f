"""The goals in a file that a server may be using."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import anyio
import pytest

from fibaction import StoreError
from fibaction._runtime.text import excerpt
from fibaction.stores import _copy
from fibaction.stores._copy import back_up, stored_goals
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.testing.contract.stores import a_goal
from fibaction.words.statuses import GoalStatus
from tests.stores.journals import add
from tests.stores.test_sqlite_store import KILLED

COUNT = """
import sys, anyio
from fibaction.stores._copy import stored_goals
print(len(anyio.run(stored_goals, sys.argv[1])))
"""


def read(path: Path) -> dict[str, list[int]]:
    goals = anyio.run(stored_goals, str(path))
    return {action: [goal.stamp for goal in found] for action, found in goals.items()}


def why_not(path: Path) -> str:
    with pytest.raises(StoreError) as caught:
        read(path)
    text = str(caught.value)
    failing, _, reason = text.partition(": ")
    assert failing == f"cannot read the goals in {excerpt(str(path))}"
    return reason


def test_the_goals_of_a_file_are_read_in_use_and_afterwards(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        add(file, 2)
        add(file, 3, "drive")
        add(file, 1)
        # In another process: this one would lose its lock.
        child = subprocess.run([sys.executable, "-c", COUNT, str(path)], capture_output=True)
        assert child.stdout == b"2\n"
    before = path.read_bytes()
    assert read(path) == {"paint": [1, 2], "drive": [3]}
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["goals.db"]


def test_a_file_that_is_not_there_is_an_error(path: Path) -> None:
    assert why_not(path) == "there is no such file"
    assert not path.exists()


def test_a_folder_is_an_error(tmp_path: Path) -> None:
    assert why_not(tmp_path) == "it is not a file"


def test_any_other_error_is_one_sentence(path: Path) -> None:
    assert why_not(path.with_name("x" * 300)).startswith("File name too long")


def test_the_log_beside_a_file_is_read_through_a_link_as_well(path: Path) -> None:
    link = path.with_name("link.db")
    link.symlink_to(path)
    with closing(JournalFile(str(path), "full")) as file:
        add(file, 1)  # it is in the log only
        child = subprocess.run([sys.executable, "-c", COUNT, str(link)], capture_output=True)
    assert child.stdout == b"1\n"


def test_outcomes_whose_time_is_over_are_not_shown(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        old = a_goal(1)
        old.status, old.keep_until = GoalStatus.SUCCEEDED, 1
        file.add(encode_row(file.next_number, [WholeRecord("paint", old)]))
        add(file, 2)
    assert read(path) == {"paint": [2]}


def test_a_file_that_changes_all_the_time_is_an_error(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_copy, "COPY_PAUSE", 0)
    monkeypatch.setattr(_copy, "TICK", 10**18)
    path.touch()
    assert why_not(path) == "it changes all the time; try again when there is less work"


def test_a_copy_has_everything_that_was_told_before(path: Path) -> None:
    backup = path.with_name("backup.db")
    program = [sys.executable, "-c", KILLED, str(path), "normal"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            for _ in range(5):  # meanwhile the log begins anew several times
                told = [child.stdout.readline().split() for _ in range(2000)]
                count = anyio.run(back_up, str(path), str(backup))
                goals = {goal.stamp: goal for goal in anyio.run(stored_goals, str(path))["a"]}
                kept = {goal.stamp: goal for goal in anyio.run(stored_goals, str(backup))["a"]}
                assert len(kept) == count
                for what, number in told:
                    for of_copy in (goals, kept):
                        assert of_copy[int(number)].status.is_terminal or what == "accepted"
        finally:
            child.kill()
            child.stdout.read()


def test_a_store_that_a_killed_process_has_left_is_backed_up(path: Path, left: Path) -> None:
    backup = path.with_name("backup.db")
    assert anyio.run(back_up, str(left), str(backup)) == 20
    assert read(backup) == {"paint": [*range(1, 21)]}
    assert not backup.with_name("backup.db-wal").exists()
    assert left.with_name("goals.db-wal").exists()


def test_a_backup_that_cannot_be_written_leaves_nothing(path: Path) -> None:
    with closing(JournalFile(str(path), "full")):
        pass
    backup = path.with_name("folder.db")
    backup.mkdir()
    with pytest.raises(OSError, match=r"folder\.db"):
        anyio.run(back_up, str(path), str(backup))
    assert sorted(file.name for file in path.parent.iterdir()) == ["folder.db", "goals.db"]
