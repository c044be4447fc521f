"""The contract of goal stores, for a file, for a file with a history, and for the tests' own."""

from __future__ import annotations

from pathlib import Path

import pytest

from fibaction import GoalHistory, SqliteStore
from fibaction.border.goal_store import GoalStore
from fibaction.testing.contract.stores import *  # noqa: F403
from tests.support.memory_store import MemoryStore


@pytest.fixture(params=["file", "file with a history", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> GoalStore:
    if request.param == "memory":
        return MemoryStore()
    history = None if request.param == "file" else GoalHistory()
    return SqliteStore(tmp_path / "goals.db", history=history)
