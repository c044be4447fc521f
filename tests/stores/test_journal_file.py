"""The file of a journal: which files can be used, and what is said about the others."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from fibaction.stores import _wal
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.testing.contract.stores import a_goal
from fibaction.words.errors import StoreError
from tests.stores.journals import add, stamps


def write(path: Path, count: int) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        for number in range(1, count + 1):
            add(file, number)


def why_not(path: Path) -> str:
    """Return the error of opening the file and reading its goals."""
    with pytest.raises(StoreError) as caught:
        stamps(path)
    text = str(caught.value)
    assert text.startswith(f"cannot keep goals in {path}: ")
    return text.removeprefix(f"cannot keep goals in {path}: ")


@pytest.mark.parametrize("count", [1, 100, 4120, 5000])
def test_the_torn_end_of_the_last_commit_is_as_if_it_had_not_begun(left: Path, count: int) -> None:
    log = left.with_name("goals.db-wal")
    os.truncate(log, log.stat().st_size - count)
    assert stamps(left) in (list(range(1, 20)), list(range(1, 19)))


def test_a_log_that_has_only_begun_is_read_as_none(path: Path) -> None:
    write(path, 3)
    path.with_name("goals.db-wal").write_bytes(b"\x37\x7f")
    assert stamps(path) == [1, 2, 3]


def test_rows_can_be_replaced(path: Path) -> None:
    with closing(JournalFile(str(path), "normal")) as file:
        for number in range(1, 11):
            add(file, number)
        before = file.size
        goals = file.goals()
        goals.of("paint").active.clear()
        file.replace(goals.rows(file.next_number))
        assert file.size == file.first_size < before
        add(file, 11)
    assert stamps(path) == [11]


def test_the_log_is_copied_to_the_file_before_it_becomes_large(path: Path) -> None:
    with closing(JournalFile(str(path), "normal", largest_log=50_000)) as file:
        for number in range(1, 200):
            add(file, number)
        assert path.with_name("goals.db-wal").stat().st_size < 150_000
        assert path.stat().st_size > 500_000


# Files that cannot be used


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    assert why_not(tmp_path) == "it is a folder; name a file in it"


def test_the_folder_must_be_there(tmp_path: Path) -> None:
    path = tmp_path / "none" / "goals.db"
    assert why_not(path) == f"there is no folder {path.parent}; make it first"


def test_a_device_is_not_a_file() -> None:
    assert why_not(Path("/dev/null")) == "it is not a regular file; name another one"


def test_text_is_not_a_store(path: Path) -> None:
    path.write_text("goals: none\n" * 1000)
    assert why_not(path) == "it is not a store of goals; use another file"
    assert path.read_text() == "goals: none\n" * 1000


def test_a_database_of_another_program_is_not_a_store(path: Path) -> None:
    with closing(sqlite3.connect(path)) as db:
        db.execute("create table songs(name)")
    before = path.read_bytes()
    assert why_not(path) == "it is a database of another program; use another file"
    assert path.read_bytes() == before


@pytest.mark.parametrize("version", [0, 2])
def test_a_store_of_another_version_is_left_as_it_is(path: Path, version: int) -> None:
    write(path, 1)
    with closing(sqlite3.connect(path)) as db:
        db.execute(f"pragma user_version={version}")
    assert why_not(path) == (
        f"it is of version {version}, and this release of fibaction knows version 1; use the"
        " release that wrote it, or another file"
    )


ANOTHER = """
import sqlite3, sys
sqlite3.connect(sys.argv[1], timeout=0).execute('select 1 from log')
"""


def test_a_file_in_use_is_not_opened_again(path: Path) -> None:
    expected = (
        "it is in use by another process or another SqliteStore; stop that one, use another file,"
        " or give the servers of one process one SqliteStore"
    )
    with closing(JournalFile(str(path), "full")) as file:
        assert why_not(path) == expected
        child = subprocess.run(
            [sys.executable, "-c", ANOTHER, str(path)], capture_output=True, text=True
        )
        assert "database is locked" in child.stderr
        add(file, 1)
    assert stamps(path) == [1]


def test_a_full_disk_is_an_error(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        file._db.execute("pragma max_page_count=20")
        with pytest.raises(StoreError, match="the disk is full; make room on it and start"):
            for number in range(1, 100):
                add(file, number)
    assert stamps(path) == list(range(1, number))


NOTES = "create table notes(text text not null)"


def note(text: str, db: sqlite3.Connection) -> int:
    db.execute("insert into notes values (?)", (text,))
    return len(text)


def notes(db: sqlite3.Connection) -> list[str]:
    return [text for (text,) in db.execute("select text from notes order by rowid")]


@pytest.fixture
def noting(path: Path) -> Generator[JournalFile, None, None]:
    """A file with a table beside the journal."""
    with closing(JournalFile(str(path), "full")) as file:
        assert file.write(lambda db: db.execute(NOTES).rowcount)
        yield file


def with_note(file: JournalFile, number: int, text: str) -> bool:
    row = encode_row(file.next_number, [WholeRecord("paint", a_goal(number))])
    return file.add_with(row, partial(note, text))


def test_a_row_and_what_another_table_gets_are_one_commit(noting: JournalFile, path: Path) -> None:
    before = noting.size
    assert with_note(noting, 1, "one")
    assert noting.size > before

    def fail(db: sqlite3.Connection) -> int:
        raise sqlite3.IntegrityError("wrong")

    with pytest.raises(StoreError, match="wrong"):
        noting.add_with(b"row", fail)
    assert with_note(noting, 2, "two")
    assert noting.look(notes) == ["one", "two"]
    noting.close()
    assert stamps(path) == [1, 2]


def test_without_room_for_another_table_the_row_alone_is_added(
    noting: JournalFile, path: Path
) -> None:
    used = noting.look(lambda db: db.execute("pragma page_count").fetchone()[0])
    noting.look(lambda db: db.execute(f"pragma max_page_count={used + 2}"))
    assert not with_note(noting, 1, "x" * 100_000)
    assert not noting.write(partial(note, "y" * 100_000))
    assert with_note(noting, 2, "short")
    assert noting.look(notes) == ["short"]
    noting.close()
    assert stamps(path) == [1, 2]


def test_a_file_that_is_removed_is_an_error(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        path.unlink()
        with pytest.raises(StoreError, match="the file was removed or replaced while it was in us"):
            add(file, 1)


def test_a_log_that_is_removed_before_the_first_write_is_an_error(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        path.with_name("goals.db-wal").unlink()
        with pytest.raises(StoreError, match=r"-wal was removed or replaced while it was in use"):
            add(file, 1)


def test_a_damaged_log_without_its_file_does_not_hinder_a_new_start(path: Path) -> None:
    path.with_name("goals.db-wal").write_bytes(b"\1" * 9000)
    with closing(JournalFile(str(path), "full")) as file:
        add(file, 1)
    assert stamps(path) == [1]


def test_any_other_error_is_one_sentence(path: Path) -> None:
    with closing(JournalFile(str(path), "full")) as file:
        with pytest.raises(StoreError, match=r"TypeError: 'int' object is not iterable$"):
            file.replace(5)  # type: ignore[arg-type]  # that is the point
    with closing(JournalFile(str(path), "full")) as file:
        file._db.close()
        with pytest.raises(StoreError, match="Cannot operate on a closed database"):
            add(file, 1)


# Permissions, in a process that has fewer of them

OPEN = """
import os, sys
from fibaction.stores._journal_file import JournalFile
if os.getuid() == 0:
    os.setgid(65534)
    os.setuid(65534)
try:
    JournalFile(sys.argv[1], "full").replace([])
except Exception as exc:
    print(exc)
"""


def without_rights(path: Path) -> str:
    """Return the error of a process that is not the owner of everything."""
    child = subprocess.run(
        [sys.executable, "-c", OPEN, str(path)], capture_output=True, text=True, check=True
    )
    return child.stdout.strip().removeprefix(f"cannot keep goals in {path}: ")


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that every user can reach, unlike the one of `tmp_path`."""
    folder = Path("/tmp") / f"fibaction-{os.getpid()}"
    folder.mkdir(mode=0o777)
    yield folder
    folder.chmod(0o777)
    shutil.rmtree(folder)


def test_a_folder_that_is_read_only_is_an_error(open_folder: Path) -> None:
    open_folder.chmod(0o555)
    assert without_rights(open_folder / "goals.db") == (
        "this process may not write to the folder; use another one, or allow it"
    )


def test_permissions_are_looked_at_before_the_file_is_opened(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.X_OK)
    assert why_not(path).startswith("this process may not write to the folder; use another")
    path.touch()
    monkeypatch.setattr(os, "access", lambda path, mode: mode & os.X_OK)
    assert why_not(path).startswith("this process may not read and write the file; use another")


# Damage


def flipped(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x55
    path.write_bytes(data)


def test_damage_in_any_page_is_found_or_does_no_harm(path: Path) -> None:
    write(path, 20)
    whole = path.read_bytes()
    found = 0
    for place in [*range(0, 120, 7), *range(120, len(whole), 613)]:
        path.write_bytes(whole)
        flipped(path, place)
        try:
            assert stamps(path) == list(range(1, 21))
        except StoreError:
            found += 1
    assert found > 50


def test_a_row_that_has_changed_is_damage(path: Path) -> None:
    write(path, 3)
    flipped(path, path.read_bytes().index(b"\x02" * 100))
    assert why_not(path) == (
        "the file is damaged; restore it and the files next to it from a copy, or remove all of"
        " them to start without its goals (row 3 is not what was written)"
    )


def test_a_table_without_rows_is_damage(path: Path) -> None:
    write(path, 3)
    with closing(sqlite3.connect(path)) as db:
        db.execute("delete from log")
        db.commit()
    assert why_not(path).endswith("(all rows are missing)")


def test_pages_that_do_not_fit_together_are_damage(path: Path) -> None:
    write(path, 20)
    with closing(sqlite3.connect(path)) as db:
        db.execute("pragma writable_schema=1")
        db.execute("create table other(x)")
        db.execute("update sqlite_master set rootpage=2 where name='other'")
        db.commit()
    assert why_not(path).startswith("the file is damaged; restore")


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.8])
def test_damage_in_the_log_of_a_killed_process_is_found_at_each_start(
    left: Path, part: float
) -> None:
    log = left.with_name("goals.db-wal")
    for place in (20, 40, 2000):
        flipped(log, int(part * log.stat().st_size) + place)
        for _ in range(2):
            assert why_not(left).endswith("(its write-ahead log has changed)")
        flipped(log, int(part * log.stat().st_size) + place)
    assert stamps(left) == list(range(1, 21))


def test_a_log_of_a_machine_with_another_byte_order_is_read(left: Path) -> None:
    log = left.with_name("goals.db-wal")
    log.write_bytes(with_other_sums(log.read_bytes()))
    assert stamps(left) == list(range(1, 21))


def with_other_sums(data: bytes) -> bytes:
    """Return the log with checksums that a machine of the other byte order would make."""
    result = bytearray(data)
    result[3] ^= 1
    order = "big" if result[3] & 1 else "little"
    sums = _wal._summed(bytes(result[:24]), (0, 0), order)
    result[24:32] = struct.pack(">II", *sums)
    for start in range(32, len(data), 24 + 4096):
        sums = _wal._summed(bytes(result[start : start + 8]), sums, order)
        sums = _wal._summed(bytes(result[start + 24 : start + 24 + 4096]), sums, order)
        result[start + 16 : start + 24] = struct.pack(">II", *sums)
    return bytes(result)


def test_a_new_file_and_its_log_are_for_their_owner_only(path: Path) -> None:
    before = os.umask(0o022)
    try:
        with closing(JournalFile(str(path), "full")) as file:
            add(file, 1)
            modes = {one.name: one.stat().st_mode & 0o777 for one in path.parent.iterdir()}
    finally:
        os.umask(before)
    assert modes == {"goals.db": 0o600, "goals.db-wal": 0o600}
