"""The history of a `SqliteStore`: goals that have ended, beyond the life of their outcomes."""

from __future__ import annotations

import logging
import math
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.to_thread
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fibaction import GoalHistory, GoalStatus, Sender, SqliteStore, StoreError
from fibaction.border.goal_store import StoredGoal
from fibaction.stores import _history
from fibaction.stores._copy import stored_goals
from fibaction.stores._history import HistoryTable
from fibaction.stores._journal_file import JournalFile
from fibaction.testing.contract.stores import Kept, a_goal, after_end, opened
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID, GoalInfo, Parent
from tests.stores.record_goals import RECORDED
from tests.stores.test_sqlite_store import KILLED, KILLS, killed

pytestmark = pytest.mark.anyio

FOREVER = GoalHistory(seconds=math.inf, goals=10**6)
SECOND = 10**9


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock that the history reads, which stands at 100 s."""
    clock = SimpleNamespace(now=100 * SECOND)
    clock.time_ns = lambda: clock.now
    monkeypatch.setattr(_history, "time", clock)
    return clock


async def run(kept: Kept, number: int, **fields: Any) -> StoredGoal:
    """Let a goal be accepted and end, and return it as it was sent."""
    goal = a_goal(number)
    sent = a_goal(number)
    await kept(kept.journal.accept, goal)
    await kept(kept.journal.end, after_end(goal, **fields))
    return sent


async def stamps(kept: Kept, **fields: Any) -> list[int]:
    return [info.stamp for info in await kept.journal.past_goals(PastPage(**fields))]


def rows_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as db:
        count: int = db.execute("select count(*) from history").fetchone()[0]
        return count


async def test_a_goal_that_has_ended_stays_whole_when_its_outcome_is_forgotten(path: Path) -> None:
    store = SqliteStore(path, history=FOREVER)
    parent = Parent(GoalID(bytes(15) + b"\7"), "third")
    meta = {"parent": str(parent.goal_id), "step": parent.step, "traceparent": "00-1"}
    meta["order"] = "17"
    async with opened(store, max_results=0) as kept:
        goal = a_goal(1, meta=dict(meta), is_running=True, attempt=2, began_at=3)
        await kept(kept.journal.accept, goal)
        await kept(kept.journal.end, after_end(goal, reason="lo\ud800st", feedback_count=4))
    async with opened(store, max_results=0) as kept:
        assert kept.found == []
        [info] = await kept.journal.past_goals(PastPage())
        past = await kept.journal.past_goal(info.goal_id)
    assert info == GoalInfo(
        a_goal(1).goal_id,
        1,
        GoalStatus.SUCCEEDED,
        4,
        "robot at here",
        attempt=2,
        parent=parent,
        began_at=3,
        ended_at=5,
        reason="lo?st",
        labels={"order": "17"},
    )
    assert past is not None
    assert (past.goal, past.result, past.meta, past.reason) == (b"goal", b"result", meta, "lo?st")
    assert (past.sender, past.digest) == (Sender("robot", b"owner", "here"), b"digest")


async def test_a_goal_that_an_earlier_process_has_accepted_has_its_request(path: Path) -> None:
    async with opened(SqliteStore(path)) as kept:
        await kept(kept.journal.accept, a_goal(1))
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        assert await stamps(kept) == []
        await kept(kept.journal.end, after_end(kept.found[0]))
        past = await kept.journal.past_goal(a_goal(1).goal_id)
    assert past is not None
    assert (past.goal, past.meta) == (b"goal", a_goal(1).meta)


async def test_goals_are_not_found_by_the_id_of_another_one_or_at_another_action(
    path: Path,
) -> None:
    store = SqliteStore(path, history=FOREVER)
    async with opened(store) as kept, opened(store, "drive") as other:
        goal = await run(kept, 1)
        assert await kept.journal.past_goal(goal.goal_id) is not None
        assert await kept.journal.past_goal(a_goal(2).goal_id) is None
        assert await other.journal.past_goal(goal.goal_id) is None
        assert await stamps(other) == []


async def test_the_history_of_a_file_is_read_without_its_server(path: Path) -> None:
    aborted, forgotten = GoalStatus.ABORTED, {"keep_until": 1}
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        await run(kept, 1, **forgotten)
        await run(kept, 2, status=aborted, **forgotten)
        await run(kept, 3)

    async def found(past: GoalQuery | None) -> list[int]:
        return [goal.stamp for goal in (await stored_goals(str(path), past))["paint"]]

    assert await found(None) == [3]
    assert await found(GoalQuery()) == [1, 2, 3]
    assert await found(GoalQuery(frozenset([aborted]))) == [2, 3]
    goal = (await stored_goals(str(path), GoalQuery()))["paint"][0]
    assert (goal.goal, goal.result) == (b"", b"result")
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("update history set whole = x'00' where stamp = 1")
    assert await found(GoalQuery()) == [2, 3]


async def test_a_file_without_a_history_has_no_past(path: Path) -> None:
    async with opened(SqliteStore(path)) as kept:
        await run(kept, 1)
    goals = await stored_goals(str(path), GoalQuery())
    assert [goal.stamp for goal in goals["paint"]] == [1]


# Bounds


async def test_many_ends_in_one_commit_do_not_stay_beyond_the_number(path: Path) -> None:
    store = SqliteStore(path, history=GoalHistory(seconds=math.inf, goals=10))
    async with opened(store) as kept:
        for first in (1, 101, 201):
            goals = [a_goal(number) for number in range(first, first + 100)]
            for goal in goals:
                kept.journal.accept(goal, lambda error: None)
            for goal in goals:
                kept.journal.end(after_end(goal), lambda error: None)
            await stamps(kept)  # it comes after them
        assert await stamps(kept) == list(range(300, 290, -1))
    assert rows_of(path) == 10


async def test_goals_whose_time_is_over_are_not_shown_and_then_deleted(
    path: Path, clock: SimpleNamespace
) -> None:
    store = SqliteStore(path, history=GoalHistory(seconds=10, goals=100))
    async with opened(store) as kept:
        await run(kept, 1, ended_at=92 * SECOND)
        await run(kept, 2, ended_at=95 * SECOND)
        assert await stamps(kept) == [2, 1]
        clock.now = 102 * SECOND
        assert await stamps(kept) == [2]
        assert await kept.journal.past_goal(a_goal(1).goal_id) is None
        assert await kept.journal.past_goal(a_goal(2).goal_id) is not None
        await run(kept, 3, ended_at=102 * SECOND)
    assert rows_of(path) == 2


@pytest.mark.parametrize("bounds", [GoalHistory(seconds=1), GoalHistory(goals=2)])
async def test_what_is_out_of_new_bounds_is_deleted_at_the_start(
    path: Path, clock: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, bounds: GoalHistory
) -> None:
    monkeypatch.setattr(_history, "DELETED", 3)
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        for number in range(1, 21):
            await run(kept, number, ended_at=(80 + number) * SECOND - 1)
    async with opened(SqliteStore(path, history=bounds)) as kept:
        left = [20, 19] if bounds.goals == 2 else [20]
        assert await stamps(kept) == left
    assert rows_of(path) == len(left)


# Pages

CLIENTS = ("robot", "arm")
ENDS = (GoalStatus.SUCCEEDED, GoalStatus.ABORTED)


@st.composite
def pasts(draw: st.DrawFn) -> list[StoredGoal]:
    """Draw goals that have ended, in the order of their ends; some have the same stamp."""
    numbers = draw(st.lists(st.integers(1, 30), max_size=12, unique=True))
    return [
        StoredGoal(
            GoalID(number.to_bytes(16, "big")),
            draw(st.integers(1, 4)),
            Sender(draw(st.sampled_from(CLIENTS))),
            b"",
            b"goal",
            status=draw(st.sampled_from(ENDS)),
            ended_at=10,
            meta=draw(st.sampled_from([None, {"site": "north"}, {"site": "south"}])),
        )
        for number in numbers
    ]


times = st.none() | st.integers(-1, 6) | st.just(2**70)
queries = st.builds(
    GoalQuery,
    st.sampled_from([frozenset[GoalStatus](), frozenset([GoalStatus.ABORTED])]),
    st.sampled_from(["", "arm"]),
    times,
    times,
    st.sampled_from([(), (("site", "north"),)]),
)


@settings(deadline=None, max_examples=60)
@given(pasts(), queries, st.booleans(), st.integers(1, 5), st.integers(1, 4))
def test_the_pages_of_a_list_are_those_of_all_goals_that_are_wanted(
    tmp_path_factory: pytest.TempPathFactory,
    goals: list[StoredGoal],
    wanted: GoalQuery,
    newest_first: bool,
    limit: int,
    scanned: int,
) -> None:
    path = tmp_path_factory.mktemp("pages") / "goals.db"
    found: list[GoalInfo] = []
    after = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_history, "SCANNED", scanned)
        with closing(JournalFile(str(path), "normal")) as file:
            table = HistoryTable(file, FOREVER)
            if goals:
                assert table.add(b"row", [("paint", goal) for goal in goals])
            while True:
                page = PastPage(wanted, limit, after, newest_first)
                part, after = table.part("paint", page)
                assert len(part) <= limit
                found += part
                if after is None:
                    break
    expected = sorted(
        (goal.info for goal in goals if wanted.has(goal.info)),
        key=lambda info: (info.stamp, info.goal_id),
        reverse=newest_first,
    )
    assert found == expected


async def test_a_page_is_filled_from_several_parts(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_history, "SCANNED", 2)
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        for number in range(1, 10):
            await run(kept, number, status=ENDS[number % 3 == 0])
        aborted = GoalQuery(frozenset([GoalStatus.ABORTED]))
        assert await stamps(kept, wanted=aborted) == [9, 6, 3]
        assert await stamps(kept, wanted=aborted, limit=2) == [9, 6]
        assert await stamps(kept, limit=0) == []
        last = (6, a_goal(6).goal_id)
        assert await stamps(kept, wanted=aborted, limit=2, after=last) == [3]
        assert await stamps(kept, limit=3, newest_first=False) == [1, 2, 3]
        after = (3, a_goal(3).goal_id)
        assert await stamps(kept, limit=3, newest_first=False, after=after) == [4, 5, 6]
        assert await stamps(kept, after=(10**19, b""), newest_first=False) == []


async def test_a_list_reads_no_requests_and_a_damaged_row_is_left_out(path: Path) -> None:
    store = SqliteStore(path, history=FOREVER)
    async with opened(store) as kept:
        for number in (1, 2):
            await run(kept, number)
    with closing(sqlite3.connect(path)) as db:
        db.execute("update history set whole = x'00' where n = 1")
        db.execute("update history set line = x'00' where n = 2")
        db.commit()
    async with opened(store) as kept:
        assert await stamps(kept) == [1]
        assert await kept.journal.past_goal(a_goal(1).goal_id) is None
        assert await kept.journal.past_goal(a_goal(2).goal_id) is not None


# Harm


async def test_a_disk_without_room_for_the_history_does_not_stop_the_server(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = SqliteStore(path, history=FOREVER)
    async with opened(store) as kept:
        goals = [a_goal(number) for number in (1, 2)]
        for goal in goals:
            goal.goal = bytes(100_000)
            await kept(kept.journal.accept, goal)

        def fill() -> None:  # the records of the ends have room, the requests do not
            used = database_of(store).execute("pragma page_count").fetchone()[0]
            database_of(store).execute(f"pragma max_page_count={used + 6}")

        await in_thread(store, fill)
        with caplog.at_level(logging.WARNING, "fibaction.server"):
            for goal in goals:
                await kept(kept.journal.end, after_end(goal))
        assert await stamps(kept) == []
    assert [record.message.split(" in ")[0] for record in caplog.records] == [
        "the disk has no room for the history"
    ]
    async with opened(SqliteStore(path)) as kept:
        assert [goal.status for goal in kept.found] == [GoalStatus.SUCCEEDED] * 2


def test_what_a_full_disk_does_not_delete_is_deleted_later(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(JournalFile(str(path), "normal")) as file:
        table = HistoryTable(file, GoalHistory(seconds=math.inf, goals=1))
        goals = [after_end(a_goal(number)) for number in (1, 2)]
        assert table.add(b"row", [("paint", goal) for goal in goals])
        with monkeypatch.context() as patch:
            patch.setattr(file, "write", lambda work: False)
            table.prune()
        assert len(table.part("paint", PastPage())[0]) == 2
        table.prune()
        assert [info.stamp for info in table.part("paint", PastPage())[0]] == [2]


def database_of(store: SqliteStore) -> sqlite3.Connection:
    """Return the database of an open store, for its thread."""
    assert store._writer is not None
    assert store._writer._file is not None
    return store._writer._file._db


async def in_thread(store: SqliteStore, work: Callable[[], object]) -> None:
    assert store._writer is not None
    assert await store._writer._do(work) == ""


async def test_a_history_that_cannot_be_read_is_an_error_for_those_who_ask(path: Path) -> None:
    store = SqliteStore(path, history=FOREVER)
    async with opened(store) as kept:
        await run(kept, 1)
        rename = "alter table {} rename to {}"
        db = database_of(store)
        await in_thread(store, lambda: db.execute(rename.format("history", "other")))
        with pytest.raises(StoreError, match="no such table: history"):
            await stamps(kept)
        await in_thread(store, lambda: db.execute(rename.format("other", "history")))
        await run(kept, 2)
        assert await stamps(kept) == [2, 1]


async def test_a_history_is_not_asked_after_a_failed_write_or_the_end_of_the_block(
    path: Path,
) -> None:
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        with pytest.raises(StoreError, match="OverflowError"):
            await kept(kept.journal.accept, a_goal(1, deadline=2**64))
        with pytest.raises(StoreError, match="OverflowError"):
            await stamps(kept)
    with pytest.raises(StoreError, match=r"the store .* is closed"):
        await stamps(kept)


# Files of other settings and releases


def restore(record: Path, path: Path) -> None:
    with closing(sqlite3.connect(path)) as db:
        db.executescript(record.read_text())


@pytest.mark.parametrize("record", sorted(RECORDED.iterdir()), ids=lambda record: record.stem)
async def test_a_file_of_an_earlier_release_gets_a_history(path: Path, record: Path) -> None:
    restore(record, path)
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        assert len(kept.found) == 3
        await kept(kept.journal.end, after_end(kept.found[1]))
        assert await stamps(kept) == [kept.found[1].stamp]


async def test_a_history_stays_as_it_is_while_the_store_is_used_without_it(path: Path) -> None:
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        await run(kept, 1)
    async with opened(SqliteStore(path)) as kept:
        await run(kept, 2)
        assert await stamps(kept) == []
        assert await kept.journal.past_goal(a_goal(1).goal_id) is None
    async with opened(SqliteStore(path, history=FOREVER)) as kept:
        assert await stamps(kept) == [1]


# Processes

KILLED_WITH_HISTORY = KILLED.replace(
    "import SqliteStore", "import GoalHistory, SqliteStore"
).replace(
    "SqliteStore(sys.argv[1], sys.argv[2])",
    "SqliteStore(sys.argv[1], sys.argv[2], history=GoalHistory(seconds=float('inf'), goals=10**6))",
)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # it is about the file
async def test_every_end_that_was_told_is_in_the_history_after_kills(path: Path) -> None:
    assert KILLED_WITH_HISTORY.count("GoalHistory") == 2
    told: set[int] = set()
    for kill in range(KILLS // 2):
        sync = "full" if kill % 2 else "normal"
        last = await anyio.to_thread.run_sync(killed, path, sync, KILLED_WITH_HISTORY)
        told |= {number for number, what in last.items() if what == "ended"}
        async with opened(SqliteStore(path, history=FOREVER), "a", 10**6) as kept:
            in_journal = {goal.stamp for goal in kept.found if goal.status.is_terminal}
            in_history: set[int] = set()
            after = None
            while infos := await kept.journal.past_goals(PastPage(after=after)):
                in_history |= {info.stamp for info in infos}
                after = infos[-1].stamp, infos[-1].goal_id
        assert in_history == in_journal
        assert told <= in_history
    assert len(told) > KILLS
