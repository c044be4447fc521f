"""`store backup`: a copy of the file in which a server keeps its goals."""

from __future__ import annotations

import re
import shutil
from contextlib import closing
from pathlib import Path
from signal import SIGINT
from typing import Any

import anyio
import pytest

from fibaction.stores._journal_file import JournalFile
from tests.cli.conftest import Run, Start
from tests.cli.test_stored_goals import fill
from tests.support.processes import ended, lines_until


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
