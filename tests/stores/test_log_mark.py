"""A write-ahead log that was removed: when it is noticed, and what does not count as one."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import pytest

from fibaction import ActionServer, SqliteStore, StoreError
from fibaction.stores._copy import stored_goals
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.testing.contract.stores import a_goal
from tests.server.painting import PAINT, paint
from tests.stores.journals import add, stamps

MISSING = (
    "the file next to it that ends in -wal is missing, and with it the newest goals; put it back,"
    " restore both files from a copy, or make it an empty file to continue without those goals"
)


def log_of(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def is_refused(path: Path) -> bool:
    reason = ""
    try:
        stamps(path)
    except StoreError as exc:
        reason = str(exc)
    assert reason in ("", f"cannot keep goals in {path}: {MISSING}")
    return bool(reason)


@pytest.mark.promise("KEEP-10")
def test_a_store_whose_log_was_removed_after_a_kill_is_refused_at_each_start(left: Path) -> None:
    log = log_of(left).rename(left.with_name("elsewhere"))
    before = left.read_bytes()
    for _ in range(2):
        assert is_refused(left)
    assert sorted(os.listdir(left.parent)) == ["elsewhere", "goals.db"]
    assert left.read_bytes() == before
    log.rename(log_of(left))
    assert stamps(left) == [*range(1, 21)]


@pytest.mark.promise("KEEP-10")
def test_a_server_does_not_start_with_a_store_whose_log_was_removed(left: Path) -> None:
    async def start() -> None:
        async with ActionServer(PAINT, paint, store=SqliteStore(left)):
            raise AssertionError("it does not start")

    log_of(left).unlink()
    with pytest.raises(StoreError, match=rf"^cannot keep goals in .*: {MISSING}$"):
        anyio.run(start)


def test_goals_are_not_read_without_a_log_that_was_removed(left: Path) -> None:
    log_of(left).unlink()
    with pytest.raises(StoreError, match=rf"^cannot read the goals in .*: {MISSING}$"):
        anyio.run(stored_goals, str(left))


def test_an_empty_log_says_to_go_on_without_the_newest_goals(left: Path) -> None:
    log_of(left).write_bytes(b"")
    assert stamps(left) == []
    assert stamps(left) == []


# What is not a missing log


def test_a_store_that_was_closed_has_no_log_and_needs_none(path: Path) -> None:
    for number in (1, 2):
        with closing(JournalFile(str(path), "full")) as file:
            add(file, number)
        assert not log_of(path).exists()
    assert stamps(path) == [1, 2]


def test_another_program_may_read_the_file_after_a_kill(left: Path) -> None:
    with closing(sqlite3.connect(left)) as db:
        assert db.execute("select count(*) from log").fetchone() == (21,)
    assert not log_of(left).exists()  # it has copied the log to the file
    assert stamps(left) == [*range(1, 21)]


class Moment(NamedTuple):
    """The bytes of the file and of its log, and the goals that were told by then."""

    file: bytes
    log: bytes | None
    told: int

    def put(self, path: Path, *, with_log: bool) -> None:
        """Write the bytes to this path."""
        path.write_bytes(self.file)
        log_of(path).unlink(missing_ok=True)
        if with_log and self.log is not None:
            log_of(path).write_bytes(self.log)


@pytest.fixture
def moments(path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Moment]:
    """The moments before each statement in the lives of a store, each of them that of a kill."""
    moments: list[Moment] = []
    told: list[int] = []
    real: Callable[..., sqlite3.Connection] = sqlite3.connect

    def note(_statement: str) -> None:
        log = log_of(path).read_bytes() if log_of(path).exists() else None
        moments.append(Moment(path.read_bytes(), log, len(told)))

    def connect(*args: Any, **settings: Any) -> sqlite3.Connection:
        db = real(*args, **settings)
        db.set_trace_callback(note)
        return db

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", connect)
        for _ in range(3):
            with closing(JournalFile(str(path), "normal", largest_log=20_000)) as file:
                for _ in range(10):
                    add(file, len(told) + 1)
                    told.append(len(told) + 1)
                file.replace(file.goals().rows(file.next_number))
    return moments


@pytest.mark.promise("KEEP-1")
def test_what_was_told_is_there_after_a_kill_at_any_moment(
    moments: list[Moment], tmp_path: Path
) -> None:
    path = tmp_path / "left.db"
    for moment in moments:
        moment.put(path, with_log=True)
        assert len(stamps(path)) >= moment.told
    assert len(moments) > 100


@pytest.mark.promise("KEEP-10")
def test_a_store_without_its_log_is_refused_or_has_all_that_was_told(
    moments: list[Moment], tmp_path: Path
) -> None:
    path = tmp_path / "left.db"
    refused = 0
    for moment in moments:
        moment.put(path, with_log=False)
        if is_refused(path):
            refused += 1
        else:
            assert len(stamps(path)) >= moment.told
    assert len(moments) // 2 < refused < len(moments)


def test_sqlite_does_not_copy_the_log_to_the_file_by_itself(path: Path, tmp_path: Path) -> None:
    copied = tmp_path / "copied.db"
    with closing(JournalFile(str(path), "normal", largest_log=10**9)) as file:
        for number in range(1, 1100):  # more than the pages after which it would
            file.add(encode_row(file.next_number, [WholeRecord("paint", a_goal(number))]))
        copied.write_bytes(path.read_bytes())
    assert is_refused(copied)
