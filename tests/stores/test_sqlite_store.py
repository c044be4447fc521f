"""`SqliteStore`, in files of its own, on both event loops."""

from __future__ import annotations

import os
import random
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from copy import copy
from functools import partial
from pathlib import Path

import anyio
import anyio.to_thread
import pytest

from fibaction import GoalHistory, GoalStatus, SqliteStore, StoreError
from fibaction.stores import _writer
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import Record, StartRecord, encode_row
from fibaction.testing.contract.stores import a_goal, after_end, opened
from fibaction.words.goal_query import PastPage

pytestmark = pytest.mark.anyio


async def test_an_action_is_served_once(path: Path) -> None:
    store = SqliteStore(path)
    async with opened(store) as kept:
        with pytest.raises(StoreError, match="a server of the action 'paint' uses it already"):
            async with opened(store):
                pass
        await kept(kept.journal.accept, a_goal())


async def test_a_store_belongs_to_one_event_loop_at_a_time(
    path: Path, anyio_backend_name: str
) -> None:
    store = SqliteStore(path)

    async def use(action: str) -> None:
        async with opened(store, action) as kept:
            await kept(kept.journal.accept, a_goal())

    run = partial(anyio.run, use, "drive", backend=anyio_backend_name)
    async with opened(store):
        with pytest.raises(
            StoreError, match=r": it is in use by the event loop of another thread$"
        ):
            await anyio.to_thread.run_sync(run)
    await anyio.to_thread.run_sync(run)


async def test_goals_of_actions_that_are_not_served_stay_when_the_file_is_compacted(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_writer, "COMPACT_FROM", 10_000)
    store = SqliteStore(path)
    async with opened(store, "drive") as drive:
        await drive(drive.journal.accept, a_goal())
        await drive(drive.journal.accept, a_goal(2))
        await drive(drive.journal.end, after_end(a_goal(2), keep_until=1))
    async with opened(store, "paint", max_results=2) as paint:
        for number in range(1, 300):
            await paint(paint.journal.accept, a_goal(number))
            await paint(paint.journal.end, after_end(a_goal(number)))
    with sqlite3.connect(path) as db:
        assert db.execute("select sum(length(data)) from log").fetchone()[0] < 11_000
        assert db.execute("select min(n) from log").fetchone()[0] > 10
    db.close()
    async with opened(store, "paint") as paint:
        assert [goal.stamp for goal in paint.found] in ([298, 299], list(range(297, 300)))[:1] or (
            paint.found[-1].stamp == 299
        )
    async with opened(store, "drive") as drive:
        assert [goal.stamp for goal in drive.found] == [1]


async def test_large_records_are_written_in_several_rows(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_writer, "LARGEST_ROW", 1000)
    async with opened(SqliteStore(path)) as kept:
        for number in range(1, 10):
            kept.journal.accept(a_goal(number, result=bytes(600)), lambda error: None)
    async with opened(SqliteStore(path)) as kept:
        assert len(kept.found) == 9


# Errors


async def test_a_file_that_cannot_be_opened_is_an_error_for_each_action(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "none" / "goals.db")
    for _ in range(2):
        with pytest.raises(StoreError, match="there is no folder"):
            async with opened(store):
                pass
    (tmp_path / "none").mkdir()
    async with opened(store):
        pass


async def test_what_sync_can_be_is_checked(path: Path) -> None:
    with pytest.raises(ValueError, match="sync must be 'full' or 'normal', not 'off'"):
        SqliteStore(path, sync="off")  # type: ignore[arg-type]  # that is the point
    assert repr(SqliteStore(path, "normal")) == f"SqliteStore({str(path)!r}, sync='normal')"


async def test_a_store_keeps_goals_that_have_ended_for_a_history(path: Path) -> None:
    history = GoalHistory(goals=5)
    store = SqliteStore(path, history=history)
    assert repr(store) == f"SqliteStore({str(path)!r}, sync='full', history={history!r})"
    async with opened(store) as kept:
        await kept(kept.journal.accept, a_goal(1))
        await kept(kept.journal.end, after_end(a_goal(1), ended_at=time.time_ns()))
        assert [info.stamp for info in await kept.journal.past_goals(PastPage())] == [1]
    with pytest.raises(TypeError, match="history must be a GoalHistory, not 5"):
        SqliteStore(path, history=5)  # type: ignore[arg-type]  # that is the point


async def test_the_intake_of_each_action_is_kept_and_changed_as_a_whole(path: Path) -> None:
    store = SqliteStore(path)
    async with opened(store) as kept, opened(store, "drive") as other:
        assert await kept.journal.intake() == b""
        await kept.journal.change_intake(lambda before: before + b"1")
        await kept.journal.change_intake(lambda before: before + b"2")
        assert await other.journal.intake() == b""
    async with opened(SqliteStore(path, history=GoalHistory())) as kept:
        assert await kept.journal.intake() == b"12"


async def test_an_intake_for_which_the_disk_has_no_room_is_refused_and_goals_are_kept(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened(SqliteStore(path)) as kept:
        with monkeypatch.context() as full:
            full.setattr(JournalFile, "write", lambda *_: False)
            with pytest.raises(StoreError, match="no room for the intake"):
                await kept.journal.change_intake(lambda _: b"1")
        await kept(kept.journal.accept, a_goal(1))
        await kept.journal.change_intake(lambda _: b"1")


async def test_a_store_that_has_failed_changes_no_intake_and_runs_no_goal_again(
    path: Path,
) -> None:
    async with opened(SqliteStore(path)) as kept:

        def fail(_before: bytes) -> bytes:
            raise StoreError("the disk is gone")

        for change in (fail, bytes):
            with pytest.raises(StoreError, match="the disk is gone"):
                await kept.journal.change_intake(change)
        with pytest.raises(StoreError, match="the disk is gone"):
            await kept.journal.rerun(a_goal().goal_id)


@pytest.mark.parametrize("history", [None, GoalHistory()], ids=["alone", "with a history"])
async def test_a_goal_that_was_given_up_comes_back_once_as_a_new_one(
    path: Path, history: GoalHistory | None
) -> None:
    old = after_end(a_goal(), status=GoalStatus.ABORTED, goal=b"goal", checkpoint=b"half")
    async with opened(SqliteStore(path, history=history)) as kept:
        await kept(kept.journal.accept, a_goal(checkpoint=b"half"))
        await kept(kept.journal.end, old)
        found = await kept.journal.given_up(old.goal_id)
        assert found is not None
        assert (found.goal, found.checkpoint) == (b"goal", b"half")
        assert await kept.journal.given_up(a_goal(2).goal_id) is None
        new_id = await kept.journal.rerun(old.goal_id)
        [new] = kept.found
        assert (new.goal_id, new.goal, new.checkpoint) == (new_id, b"goal", b"half")
        assert await kept.journal.rerun(old.goal_id) is None
        assert await kept.journal.rerun(new.goal_id) is None
        assert [await kept.journal.given_up(old.goal_id) for _ in "12"] == [None, None]
        if history is not None:
            await kept(kept.journal.end, after_end(copy(new), ended_at=time.time_ns()))
            past = await kept.journal.past_goal(new.goal_id)
            assert past is not None
            assert (past.goal, past.meta) == (b"goal", new.meta)
    async with opened(SqliteStore(path, history=history)) as kept:
        assert [goal.is_given_up for goal in kept.found] == [False, False]


@pytest.mark.parametrize("history", [None, GoalHistory()], ids=["alone", "with a history"])
async def test_a_goal_that_was_given_up_before_a_restart_is_found_until_its_time_is_over(
    path: Path, history: GoalHistory | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    until = time.time_ns() + 10**12
    gone = {"status": GoalStatus.ABORTED, "goal": b"goal", "keep_until": until}
    async with opened(SqliteStore(path, history=history)) as kept:
        await kept(kept.journal.accept, a_goal())
        await kept(kept.journal.end, after_end(a_goal(), **gone))
    async with opened(SqliteStore(path, history=history)) as kept:
        found = await kept.journal.given_up(a_goal().goal_id)
        assert found is not None
        assert found.checkpoint is None
        monkeypatch.setattr(time, "time_ns", lambda: until)
        assert await kept.journal.given_up(a_goal().goal_id) is None


async def test_a_file_that_cannot_be_read_is_an_error_of_the_request_only(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened(SqliteStore(path)) as kept:
        await kept(kept.journal.accept, a_goal())
        await kept(kept.journal.end, after_end(a_goal(), status=GoalStatus.ABORTED, goal=b"goal"))

        def fail(*_: object) -> None:
            raise StoreError("the disk is gone")

        with monkeypatch.context() as broken:
            broken.setattr(JournalFile, "goals", fail)
            with pytest.raises(StoreError, match="the disk is gone"):
                await kept.journal.given_up(a_goal().goal_id)
        assert await kept.journal.given_up(a_goal().goal_id) is not None


async def test_after_a_failed_write_all_others_fail_in_order(path: Path) -> None:
    store = SqliteStore(path)
    told: list[tuple[int, str]] = []

    def note(number: int, error: StoreError | None) -> None:
        told.append((number, str(error)))

    async with opened(store) as kept:
        await kept(kept.journal.accept, a_goal(1))
        await anyio.Path(path).unlink()
        for number in range(2, 10):
            kept.journal.accept(a_goal(number), partial(note, number))
        with pytest.raises(StoreError, match="was removed or replaced"):
            await kept(kept.journal.accept, a_goal(10))
        await anyio.Path(path).touch()
        with pytest.raises(StoreError, match="was removed or replaced"):
            await kept(kept.journal.accept, a_goal(11))
        with pytest.raises(StoreError, match="was removed or replaced"):
            async with opened(store, "drive"):
                pass
    error = f"cannot keep goals in {path}: the file was removed or replaced while it was in use"
    assert told == [(number, error) for number in range(2, 10)]


async def test_a_store_behind_a_link_is_the_file_itself(path: Path) -> None:
    link = path.with_name("link.db")
    await anyio.Path(link).symlink_to(path)
    async with opened(SqliteStore(link)) as kept:
        await kept(kept.journal.accept, a_goal(1))
        assert await anyio.Path(f"{path}-wal").exists()
        with pytest.raises(StoreError, match="in use by another process or another SqliteStore"):
            async with opened(SqliteStore(path)):
                pass


def test_a_store_is_a_file() -> None:
    with pytest.raises(
        ValueError, match=r"^a store is a file: leave `store` out to keep goals in memory$"
    ):
        SqliteStore(":memory:")


async def test_a_write_after_the_end_of_the_block_is_an_error(path: Path) -> None:
    async with opened(SqliteStore(path)) as kept:
        pass
    with pytest.raises(StoreError, match=r"the store .* is closed"):
        await kept(kept.journal.accept, a_goal())


async def test_a_block_that_is_canceled_waits_for_its_writes(path: Path) -> None:
    told: list[object] = []
    with anyio.CancelScope() as scope:
        async with opened(SqliteStore(path)) as kept:
            kept.journal.accept(a_goal(), told.append)
            scope.cancel()
            await anyio.sleep_forever()
    assert told == [None]
    assert not [thread for thread in threading.enumerate() if thread.name == "fibaction store"]


# Processes

ABANDON = """
import asyncio
import sys
import trio
from fibaction import SqliteStore
from fibaction.words.goals import GoalID, Sender
from fibaction.border.goal_store import StoredGoal

async def use():
    block = SqliteStore(sys.argv[2]).open("a", max_results=1, claim=print, lose=print)
    journal = await block.__aenter__()
    told = []
    journal.accept(StoredGoal(GoalID.random(), 1, Sender(), b"", b""), told.append)
    return block, journal

if sys.argv[1] == "trio":
    kept = trio.run(use)
else:
    kept = asyncio.run(use())
print("ended")
"""


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_a_program_that_leaves_its_store_open_ends(path: Path, backend: str) -> None:
    child = subprocess.run(
        [sys.executable, "-c", ABANDON, backend, str(path)],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert (child.stdout, child.returncode) == ("ended\n", 0), child.stderr


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_thread_ends_with_a_write_that_outlives_the_event_loop(
    path: Path, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    has_ended = threading.Event()

    def late(number: int, records: list[Record]) -> bytes:
        has_ended.wait()
        return encode_row(number, records)

    async def begin() -> None:
        writer = _writer.Writer(str(path), "full")
        await writer.load("paint", 0)
        monkeypatch.setattr(_writer, "encode_row", late)
        writer.write(StartRecord(), lambda error: None)
        await anyio.wait_all_tasks_blocked()

    anyio.run(begin, backend=backend)
    [thread] = [thread for thread in threading.enumerate() if thread.name == "fibaction store"]
    has_ended.set()

    thread.join(10)
    assert not thread.is_alive()


async def test_what_one_turn_of_the_event_loop_writes_is_one_commit(path: Path) -> None:
    async with opened(SqliteStore(path)) as kept:
        for number in range(1, 100):
            kept.journal.accept(a_goal(number), lambda error: None)
        await kept(kept.journal.accept, a_goal(100))
    with closing(JournalFile(str(path), "full")) as file:
        assert [number for number, _ in file.rows()] == [2, 3]  # the start, and a commit


KILLED = """
import itertools, sys, time
import anyio
from fibaction import SqliteStore
from fibaction.words.goals import GoalID, Sender
from fibaction.words.statuses import GoalStatus
from fibaction.border.goal_store import StoredGoal

def tell(what, goal, error):
    assert error is None
    print(what, goal.stamp, flush=True)

async def live(journal, first):
    for number in itertools.count(first, 20):
        goal = StoredGoal(GoalID(number.to_bytes(16, "big")), number, Sender(), b"", b"goal")
        for what, write in ("accepted", journal.accept), ("ended", journal.end):
            told = anyio.Event()
            def then(error, what=what, told=told):
                tell(what, goal, error)
                told.set()
            if what == "ended":
                goal.status, goal.result = GoalStatus.SUCCEEDED, b"x" * (number % 5000)
            write(goal, then)
            await told.wait()

async def main():
    store = SqliteStore(sys.argv[1], sys.argv[2])
    async with store.open("a", max_results=10**6, claim=id, lose=id) as journal:
        start = time.time_ns() >> 16 << 8
        async with anyio.create_task_group() as tasks:
            for number in range(20):
                tasks.start_soon(live, journal, start + number)

anyio.run(main)
"""


KILLS = int(os.environ.get("FIBACTION_KILLS", "8"))
"""Kills of a program that writes; `make kills` asks for many."""


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # it is about the file
async def test_everything_that_was_told_is_there_after_kills(path: Path) -> None:
    told: dict[int, str] = {}
    for kill in range(KILLS):
        told |= await anyio.to_thread.run_sync(killed, path, "full" if kill % 2 else "normal")
        async with opened(SqliteStore(path), "a", 10**6) as kept:
            found = {goal.stamp: goal.status for goal in kept.found}
            for goal in kept.found:
                if goal.status.is_terminal:
                    assert goal.result == b"x" * (goal.stamp % 5000)
        for number, what in told.items():
            assert found[number] == GoalStatus.SUCCEEDED or what == "accepted"
            assert found[number] in (GoalStatus.ACCEPTED, GoalStatus.SUCCEEDED)
    assert len(told) > 5 * KILLS


def killed(path: Path, sync: str, program: str = KILLED) -> dict[int, str]:
    """Run a program until it has told enough, kill it, and return what it has told."""
    command = [sys.executable, "-c", program, str(path), sync]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    lines = [child.stdout.readline() for _ in range(random.randrange(1, 100))]
    child.kill()
    lines += child.stdout.read().splitlines(keepends=True)
    child.wait()
    child.stdout.close()
    words = (line.split() for line in lines if line.endswith("\n"))
    return {int(number): what for what, number in words}
