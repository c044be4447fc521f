"""`SqliteStore`, in files of its own, on both event loops."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import GoalID, GoalStatus, SqliteStore, StoreError
from fibaction.goals import Sender
from fibaction.stores.goal_store import GoalJournal, StoredGoal

pytestmark = pytest.mark.anyio

FAR = 2**62


def a_goal(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal whose ID and stamp are the number."""
    goal_id = GoalID(number.to_bytes(16, "big"))
    return StoredGoal(
        goal_id, number, Sender("robot", b"owner", "here"), b"digest", b"goal", **fields
    )


def ended(goal: StoredGoal, **fields: Any) -> StoredGoal:
    """Return the goal after its end."""
    goal.status, goal.is_running, goal.ended_at = GoalStatus.SUCCEEDED, False, 5
    goal.result = b"result"
    for name, value in fields.items():
        setattr(goal, name, value)
    return goal


class Kept:
    """An open journal whose writes are waited for."""

    def __init__(self, journal: GoalJournal, found: list[StoredGoal]) -> None:
        self.journal = journal
        self.found = found

    async def __call__(self, write: Callable[..., None], goal: StoredGoal) -> None:
        told = anyio.Event()
        errors: list[StoreError | None] = []

        def then(error: StoreError | None) -> None:
            errors.append(error)
            told.set()

        write(goal, then)
        assert not errors  # it returns before anything is written
        await told.wait()
        if errors[0] is not None:
            raise errors[0]


@asynccontextmanager
async def opened(
    store: SqliteStore, action: str = "paint", max_results: int = 100
) -> AsyncIterator[Kept]:
    found: list[StoredGoal] = []
    async with store.open(
        action, max_results=max_results, claim=found.append, lose=lambda goal_id: None
    ) as journal:
        yield Kept(journal, found)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "goals.db"


async def test_a_goal_is_there_at_the_next_start(path: Path) -> None:
    async with opened(SqliteStore(path)) as kept:
        assert kept.found == []
        await kept(kept.journal.accept, a_goal())
    async with opened(SqliteStore(path)) as kept:
        assert kept.found == [a_goal()]


async def test_each_step_is_kept(path: Path) -> None:
    goal = a_goal()
    store = SqliteStore(path)
    async with opened(store) as kept:
        await kept(kept.journal.accept, goal)
        goal.status, goal.is_running, goal.attempt = GoalStatus.EXECUTING, True, 1
        await kept(kept.journal.begin, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        goal.checkpoint = b"half"
        await kept(kept.journal.checkpoint, goal)
        goal.status = GoalStatus.CANCELING
        await kept(kept.journal.cancel, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        goal.is_running = False
        await kept(kept.journal.release, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        await kept(kept.journal.end, ended(goal, reason="done ü"))
    goal.goal, goal.checkpoint = b"", None
    async with opened(store) as kept:
        assert kept.found == [goal]


async def test_a_second_store_cannot_use_the_file(path: Path) -> None:
    async with opened(SqliteStore(path)):
        with pytest.raises(StoreError, match="it is in use by another process or another Sqlite"):
            async with opened(SqliteStore(path)):
                pass
    async with opened(SqliteStore(path)):
        pass
