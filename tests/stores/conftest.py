"""The file of a store, and one that a killed process has left."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import pytest

from fibaction.stores._journal_file import JournalFile
from tests.stores.journals import add


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "goals.db"


@pytest.fixture
def left(path: Path, tmp_path: Path) -> Path:
    """A file with 20 commits, as a killed process leaves it: all of them are in the log."""
    left = tmp_path / "left" / "goals.db"
    left.parent.mkdir()
    with closing(JournalFile(str(path), "full")) as file:
        for number in range(1, 21):
            add(file, number)
        for name in ("goals.db", "goals.db-wal"):
            shutil.copy(path.with_name(name), left.with_name(name))
    return left
