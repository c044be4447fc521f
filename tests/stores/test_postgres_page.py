"""docs/howto/write_a_store.md: its store passes the contract, in a PostgreSQL of its own."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.pages import blocks_of
from tests.support.walks import file_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "write_a_store.md"
PROGRAMS = [shutil.which("pg_ctl"), *Path("/usr/lib/postgresql").glob("*/bin/pg_ctl")]
PG_CTL = next((str(path) for path in PROGRAMS if path is not None), None)
USER = "postgres" if os.geteuid() == 0 else None
"""The user of the server, which does not run as root."""
IS_HERE = (
    PG_CTL is not None
    and find_spec("psycopg") is not None
    and (USER is None or USER in {each.pw_name for each in pwd.getpwall()})
)


@pytest.fixture
def postgres() -> Iterator[str]:
    """Return the address of a server without goals, which listens at no port."""
    assert PG_CTL is not None
    with tempfile.TemporaryDirectory() as folder:
        if USER is not None:
            shutil.chown(folder, USER)

        def run(*arguments: str) -> None:
            subprocess.run([PG_CTL, "-D", f"{folder}/data", *arguments], check=True, user=USER)

        run("initdb", "-o", "-A trust -U postgres")
        run("start", "-w", "-l", f"{folder}/log", "-o", f"-k {folder} -h ''")
        try:
            yield f"postgresql://postgres@/postgres?host={folder}"
        finally:
            run("stop", "-m", "immediate")


@pytest.mark.skipif(not IS_HERE, reason="PostgreSQL and psycopg are not installed")
def test_the_store_of_the_page_passes_the_contract(postgres: str, tmp_path: Path) -> None:
    for block in blocks_of(PAGE.read_text(encoding="utf-8")):
        if (marked := file_of(block)) is not None:
            (tmp_path / marked["path"]).write_text(block.code, encoding="utf-8")

    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "test_postgres_store.py"],
        cwd=tmp_path,
        env={**os.environ, "POSTGRES": postgres},
        capture_output=True,
        text=True,
        check=False,
    )

    assert ran.returncode == 0, ran.stdout
